"""Reader of recordings of this program, of devices and of other labs.

`calibrate`, `replay` and the report of a run use this package.
"""
