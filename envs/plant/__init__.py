"""The simulated vial: culture, vessel, heat, pump, sensor. Batch first, NumPy only.

Entered by the vector environment, the simulated reactors, the emulator and the oracle."""
