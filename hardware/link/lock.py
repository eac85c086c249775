"""One client per device on this computer."""

from __future__ import annotations

import fcntl
import hashlib
import os
import tempfile
from pathlib import Path
from typing import IO

from hardware.errors import DeviceStateError

__all__ = ["OwnerLock"]


class OwnerLock:
    """A lock file for the device at `url`; the kernel frees it when the process ends.

    Raises: DeviceStateError if another process holds it.
    """

    def __init__(self, url: str) -> None:
        name = hashlib.sha256(url.encode()).hexdigest()[:16]
        self._file: IO[str] = open(Path(tempfile.gettempdir()) / f"chibio-{name}.lock", "a+")  # noqa: SIM115 (held)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.seek(0)
            holder = self._file.read().strip() or "unknown"
            self._file.close()
            raise DeviceStateError(f"{url} is already controlled by process {holder}: one client per device") from error
        self._file.truncate(0)
        self._file.write(str(os.getpid()))
        self._file.flush()

    def release(self) -> None:
        """Let others have the device. Idempotent."""
        self._file.close()
