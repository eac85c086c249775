"""Density controllers: from readings to pump rates, batch first, free of torch and files; and their estimator.

Closed loops import it through `experiments.laws.registry`."""
