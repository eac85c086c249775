"""Replay of a recording as if it were a run: estimates, decisions, alarms, and quality of the predictions.

The command `replay` uses this package.
"""
