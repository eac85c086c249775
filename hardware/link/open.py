"""The configured link to a device, for one client per device on this computer."""

import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from hardware.errors import DeviceStateError
from hardware.link.http import HttpTransport
from hardware.link.serial import SerialTransport
from hardware.link.transport import Transport, TransportConfig, new_session

__all__ = ["DeviceLock", "open_transport"]


class DeviceLock:
    """A locked file for a device; the kernel frees it when it is closed or the process ends.

    The file keeps the session under which this computer is known to a board agent: who takes over from a client that
    was killed goes on under its name and is in charge at once.

    Args: device: its address, or what else names it: one device may have several names, each is locked.
    Raises: DeviceStateError if another process holds it.
    """

    def __init__(self, device: str) -> None:
        name = hashlib.sha256(device.encode()).hexdigest()[:16]
        self._file = open(Path(tempfile.gettempdir()) / f"chibio-{name}.lock", "a+")  # noqa: SIM115 (held)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = self._read().get("process", "unknown")
            self.close()
            raise DeviceStateError(
                f"{device} is already controlled by process {holder}: one client per device"
            ) from error
        session = self._read().get("session")
        self.session = session if isinstance(session, int) and 0 < session < 2**16 else new_session()
        self._file.truncate(0)
        json.dump({"process": os.getpid(), "session": self.session}, self._file)
        self._file.flush()

    def _read(self) -> dict[str, object]:
        self._file.seek(0)
        try:
            found = json.load(self._file)
        except ValueError:
            return {}
        return found if isinstance(found, dict) else {}

    def close(self) -> None:
        """Free it. Idempotent."""
        self._file.close()


@contextmanager
def open_transport(config: TransportConfig, url: str, speed: float = 1.0) -> Iterator[Transport]:
    """Open the configured link, owned exclusively on this computer as long as it is open.

    Raises: ValueError for a malformed address, LinkError if a serial line cannot be opened, its agent does not answer
      or the token of an agent cannot be read, DeviceStateError if another process holds the device.
    """
    serial = config.kind == "serial"
    with closing(DeviceLock(config.port if serial else url.rstrip("/"))) as lock:
        make, address = (SerialTransport, config.port) if serial else (HttpTransport, url)
        with closing(make(address, speed, config, session=lock.session)) as link:
            yield link
