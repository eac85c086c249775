"""Laws of the density: readings in, pump rates out, batch first, free of torch and files; and their estimator.

Entered through `experiments.laws.registry`, by whatever closes a loop."""
