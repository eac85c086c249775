"""The simulated world: growth, dilution, sensors, plants and environments; NumPy only, batch axis first.

Importing this package registers `Bioreactor-v0` for `gymnasium.make` and `gymnasium.make_vec`.
"""

from envs.gym_adapter import register

register()
