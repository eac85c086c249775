"""The closed loop of the program and what it leaves behind: one assembly for simulation, emulator and device.

Entered by deploy through `config` and `run`, by rehearsals through `assemble`, by commands at the
device through `device`, and by comparison for loop and metrics. Free of torch.
"""
