"""The simulated vial: culture, vessel, heat, pump, sensor. Batch first, NumPy only.

Simulated reactors, emulator, oracle and the configs of deploy and benchmark import it."""
