"""Parts of the command `calibrate`: config, output files, study of the intervals. The estimate is in envs.

Only commands import this package.
"""
