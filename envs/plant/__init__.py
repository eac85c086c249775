"""The simulated vial: culture, vessel, heat, pump, sensor. Batch first, NumPy only.

Simulated reactors, the emulator, the oracle controller and the configs of deploy and benchmark use this package."""
