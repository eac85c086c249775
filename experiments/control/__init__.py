"""The closed loop of the program and what it leaves behind: one assembly for simulation, emulator and device.

Entered by deploy through `assemble`, by the rehearsals of reliability likewise, by commands at the device through
`device` and `rig_files`, and by comparison for loop and metrics. Free of torch.
"""
