"""Laws of the share of two species: an estimate in, targets of the thermostat out; the estimator, and the program.

Entered through `experiments.laws.registry`. Nothing in here knows a clock, a file or a device.
"""
