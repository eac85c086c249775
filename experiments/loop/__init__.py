"""The closed loop: sample, schedule, law, interlock, dose; and how well it held."""
