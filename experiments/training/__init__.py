"""One training run: agents, evaluation against the optimum, checkpoints, the exported policy.

Entered by train and benchmark, which load torch with it, and by control for `config` alone, which is free of torch.
"""
