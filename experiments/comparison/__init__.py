"""Comparison of controllers on simulated plants: trials, statistics, the paper's numbers, figures and page.

The commands `benchmark` and `report` import it."""
