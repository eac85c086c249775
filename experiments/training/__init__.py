"""One training run: agents, evaluation against the optimum, checkpoints, the exported policy.

Entered by commands that train (train, benchmark, ablate, degradation, speed). Loads torch."""
