"""A client of its own: `python -m experiments.deploy` as a process that is resumed, ended or killed."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["Client"]


class Client:
    """A deployment as a process, in a session of its own, so that nobody else's Ctrl-C reaches it.

    Args: words: of its command line. log: file that takes what it says.
    """

    def __init__(self, words: Sequence[str], log: Path) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "experiments.deploy", *words]
        with log.open("ab") as out:
            self._process = subprocess.Popen(command, stdout=out, stderr=out, env=environment, start_new_session=True)

    @property
    def status(self) -> int | None:
        """With which it ended; None while it runs."""
        return self._process.poll()

    def kill(self) -> None:
        """kill -9."""
        self._process.kill()
        self._process.wait()

    def end(self, seconds: float, number: int = signal.SIGTERM) -> int | None:
        """Ask it to end, real time given; its status, None if it did not and was killed.

        A shell may have told us, and so it, to ignore Ctrl-C.
        """
        if self.status is None:
            self._process.send_signal(number)
        return self.wait(seconds)

    def wait(self, seconds: float) -> int | None:
        """Its status, None if it did not end and was killed."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return None
        except BaseException:
            self.kill()
            raise
