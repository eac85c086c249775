"""Growth rate and pump constant from a recording: screening, choice of a window, fit with intervals. Reads no file.

Calibrate and benchmark import it."""
