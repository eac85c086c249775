"""The closed loop of the program and what it leaves behind: one assembly for simulation, emulator and device.

Entered by deploy, by the bench commands and by comparison and reliability. Free of torch."""
