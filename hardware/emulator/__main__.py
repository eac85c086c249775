"""`python -m hardware.emulator`: an emulated Chi.Bio as a separate process."""

import sys

from hardware.emulator.server import main

if __name__ == "__main__":
    sys.exit(main())
