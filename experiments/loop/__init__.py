"""The closed loop (sample, schedule, controller, interlock, dose), and metrics of how well it held the setpoint."""
