"""Parts of `calibrate` besides the estimate: config, report, study of the intervals.

Only the command may import it.
"""
