"""Two vials and three flows: the composition of a fast and a slow strain, held by dosing the slow one.

Pure numerics, simulation only: plant, task, optimum, laws and estimator; no device driver knows this rig.
"""
