"""One training run: agents, evaluation against the optimum, checkpoints, the exported policy.

`train` and `benchmark` import this package with torch. `control` imports only `config`, which does not load torch.
"""
