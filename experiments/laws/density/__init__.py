"""Density controllers and their estimator: from readings to pump rates, batch first, without PyTorch and files.

Closed loops import this package through `experiments.laws.registry`."""
