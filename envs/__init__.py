"""Simulation of growth, dilution, sensors, plants and environments, in NumPy, with the batch axis first.

Importing this package registers its environments (`gym_adapter.REGISTERED`) with Gymnasium.
"""

from conf import guests
from envs.gym_adapter import register

guests.load("envs")
register()
