"""Growth rate and pump constant from a recording: screening, choice of a window, fit with intervals.

The commands calibrate and benchmark use this package. It reads no files."""
