"""The simulated vial: culture, vessel, heat, pump, sensor. Batch first, NumPy only.

Entered by the simulated reactors, the emulator, the oracle and the configs of deploy and benchmark."""
