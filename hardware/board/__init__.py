"""What runs on the device's own board: one file, Python 3.7, standard library only.

Imported by nobody but tests; the serial link speaks its frames."""
