"""One training run: agents, evaluation against the optimum, checkpoints, the exported policy.

Train and benchmark import it with torch; control imports only `config`, which is free of torch.
"""
