"""From a checked config to a run of `deploy`: the same code for simulation, emulator and device.

`run` runs the loop and writes the output files; `assemble` builds the loop, also for tests. Imports no PyTorch.
"""
