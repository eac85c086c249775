"""What `calibrate` does around the estimate: its config, its report, the study of its intervals.

May be entered by the command alone.
"""
