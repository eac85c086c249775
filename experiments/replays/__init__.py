"""Replay of a recording as if it were a run: estimates, decisions, alarms, and how well it predicts.

Entered by `replay`.
"""
