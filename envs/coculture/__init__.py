"""Two species in one vial, whose composition follows the temperature: rates, task, optimum.

Pure numerics; anybody may enter. The plant is in `envs/plant`, what decides on a reactor in `experiments/laws/density`.
"""
