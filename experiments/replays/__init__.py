"""A recording gone through as by a run: what is estimated, decided and stopped, and how well it predicts.

Entered by `replay`.
"""
