"""The configured link to a device, for one client per device on this computer."""

import hashlib
import os
import socket
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from hardware.link.http import HttpTransport
from hardware.link.messages import DeviceTaken
from hardware.link.serial import SerialTransport
from hardware.link.transport import Transport, TransportConfig, new_session


class DeviceLock:
    """Lock on a device's name for all users of this computer; `close` or the end of the process releases it.

    A file keeps this user's session number at the board agent, so that a client that replaces a killed one is in charge
    at once. If a device has several names, each is locked.
    Raises: DeviceStateError if another process holds the lock.
    """

    def __init__(self, device: str) -> None:
        name = f"chibio-{hashlib.sha256(device.encode()).hexdigest()[:16]}"
        self._held, holder = socket.socket(socket.AF_UNIX), "unknown"
        try:
            self._held.bind(f"\0{name}")
            self._held.listen()
        except OSError as error:
            with closing(self._held), suppress(OSError):
                self._held.connect(f"\0{name}")
                holder = str(struct.unpack("3i", self._held.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0])
            raise DeviceTaken(device=device, holder=holder) from error
        kept = Path(tempfile.gettempdir()) / f"{name}.{os.getuid()}"
        try:
            self.session = int(kept.read_text()) % 2**16 or new_session()
        except (OSError, ValueError):
            self.session = new_session()
        with suppress(OSError):
            kept.write_text(str(self.session))

    def close(self) -> None:
        self._held.close()


@contextmanager
def open_transport(config: TransportConfig, url: str, speed: float = 1.0) -> Iterator[Transport]:
    """Open the configured link; while it is open, no other process of this computer can use the device.

    Raises: ValueError for a malformed address, LinkError, DeviceStateError if another process holds the device.
    """
    serial = config.kind == "serial"
    with closing(DeviceLock(config.port if serial else url.rstrip("/"))) as lock:
        make, address = (SerialTransport, config.port) if serial else (HttpTransport, url)
        with closing(make(address, speed, config, session=lock.session)) as link:
            yield link
