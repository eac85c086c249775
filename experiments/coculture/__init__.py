"""Two species in one vial: estimator, controllers, learning task and comparison of their composition.

This package is a guest: it registers itself as any extension can (docs/extending.md); the core does not import it.
"""
