"""The simulated world: growth, dilution, sensors, plants and environments; NumPy only, batch axis first.

Importing this package registers its environments (`gym_adapter.REGISTERED`) with Gymnasium.
"""

from envs.gym_adapter import register

register()
