"""Comparison of controllers on simulated plants: trials, statistics, the paper's numbers, figures and page.

Benchmark and report import it."""
