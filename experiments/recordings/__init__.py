"""Recordings of this program, of devices and of other labs, read from files: text, columns, doses, and what is refused.

Entered by `calibrate`, `replay` and the report of a run.
"""
