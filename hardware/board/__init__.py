"""Software for the device's own board: one file, Python 3.7, standard library only.

Only tests import it; the serial link uses its frames."""
