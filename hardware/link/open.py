"""The configured link to a device, for one client per device on this computer."""

import fcntl
import hashlib
import os
import tempfile
from pathlib import Path
from typing import IO

from hardware.errors import DeviceStateError
from hardware.link.http import HttpTransport
from hardware.link.serial import SerialTransport
from hardware.link.transport import Transport, TransportConfig

__all__ = ["lock", "open_transport"]


def lock(device: str) -> IO[str]:
    """A locked file for a device; the kernel frees it when it is closed or the process ends.

    Args: device: its address, or what else names it: one device may have several names, each is locked.
    Raises: DeviceStateError if another process holds it.
    """
    name = hashlib.sha256(device.encode()).hexdigest()[:16]
    file: IO[str] = open(Path(tempfile.gettempdir()) / f"chibio-{name}.lock", "a+")  # noqa: SIM115 (held)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.seek(0)
        holder = file.read().strip() or "unknown"
        file.close()
        raise DeviceStateError(f"{device} is already controlled by process {holder}: one client per device") from error
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()
    return file


class _OwnedHttp(HttpTransport):
    """HTTP with the device's lock held as long as the transport is open."""

    def __init__(self, url: str, speed: float, config: TransportConfig) -> None:
        super().__init__(url, speed, config)
        self._owner = lock(self.url)

    def close(self) -> None:
        super().close()
        self._owner.close()


def open_transport(config: TransportConfig, url: str, speed: float = 1.0) -> Transport:
    """The configured link, owned exclusively on this computer.

    Raises: ValueError for a malformed address, LinkError if a serial line cannot be opened or its agent does not
      answer, DeviceStateError if another process holds the device.
    """
    if config.kind == "serial":
        return SerialTransport(config.port, speed, config)
    return _OwnedHttp(url, speed, config)
