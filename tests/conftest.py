"""What holds for every test."""

import os
import signal

from hypothesis import settings

settings.register_profile("busy", deadline=None)  # a machine may be busy with other things; the mutants have their own
settings.load_profile("busy")

for _number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:  # a suite in the background; programs started by it would be deaf
        signal.signal(_number, signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL)


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: a quarter of the tests' time is waiting, for a device or for another process."""
    return (os.cpu_count() or 1) + 1
