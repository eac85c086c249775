"""The configured link to a device."""

from __future__ import annotations

from hardware.link.http import HttpTransport
from hardware.link.lock import OwnerLock
from hardware.link.serial import SerialTransport
from hardware.link.transport import Transport, TransportConfig

__all__ = ["open_transport"]


class _OwnedHttp(HttpTransport):
    """HTTP with the device's owner lock held as long as the transport is open."""

    def __init__(self, url: str, speed: float, config: TransportConfig) -> None:
        super().__init__(url, speed, config)
        self._owner = OwnerLock(self.url)

    def close(self) -> None:
        super().close()
        self._owner.release()


def open_transport(config: TransportConfig, url: str, speed: float = 1.0) -> Transport:
    """The configured link, owned exclusively on this computer.

    Raises: ValueError for a malformed address, LinkError if a serial line cannot be opened or its agent does not
      answer, DeviceStateError if another process holds the device.
    """
    if config.kind == "serial":
        return SerialTransport(config.port, speed, config)
    return _OwnedHttp(url, speed, config)
