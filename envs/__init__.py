"""The simulated world: growth, dilution, sensors, plants and environments; NumPy only, batch axis first."""
