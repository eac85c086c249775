"""Two species in one vial whose composition depends on the temperature: rates, task, optimum.

The package contains pure numerics. The simulated vial is in `envs/plant`, controllers are in `experiments/coculture`.
"""
