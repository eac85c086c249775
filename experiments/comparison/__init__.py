"""Controllers side by side on simulated plants: trials, statistics, the paper's numbers, figures and page.

Entered by benchmark and report."""
