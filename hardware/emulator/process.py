"""Emulated device as a child process: `python -m hardware.emulator` on a free port."""

import re
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager

from hardware.errors import LinkError

START_S = 60.0


class EmulatorProcess(AbstractContextManager["EmulatorProcess"]):
    """A child process with an emulator, as a context manager; it ends with this process.

    Attributes: url: address of the device. control: address of its faults. Raises: LinkError if it does not start.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        command = [sys.executable, "-m", "hardware.emulator", "--port", "0", "--until-eof", *arguments]
        # in a new session, so that Ctrl-C ends the client first, while it can still switch the device off
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self.pid = self._process.pid
        assert self._process.stdout is not None
        late = threading.Timer(START_S, self._process.kill)
        late.start()
        line = self._process.stdout.readline()
        late.cancel()
        ready = re.match(r"emulator ready: (http://\S+) .* control (http://\S+)", line)
        if ready is None:
            self.close()
            raise LinkError(f"the emulator did not start: {line.strip() or 'no output'}")
        self.url, self.control = ready[1], ready[2]

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def __exit__(self, *raised: object) -> None:
        self.close()
