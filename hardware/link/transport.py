"""How requests travel to a device: all that a driver knows of HTTP, serial line or emulator.

A transport raises `LinkError` when no answer came and `ProtocolError` when it was garbage.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

__all__ = ["MAX_BODY", "Reply", "Transport", "TransportConfig"]

MAX_BODY = 262_144
"""Bytes of the longest answer; a full state is 36 KB (docs/device.md, Routes), the board agent carries at most this."""


@dataclass(frozen=True)
class Reply:
    """An answer as it came: HTTP status and body; `date` is the server's clock as an HTTP date, "" where unknown."""

    status: int
    body: bytes
    date: str = ""


class Transport(Protocol):
    """Carries one request at a time; a driver never retries blindly what is not idempotent."""

    def get(self, path: str) -> Reply:
        """Raises: LinkError when no answer came."""
        ...

    def post(self, path: str) -> Reply:
        """POST without a body. Raises: LinkError when no answer came; the device may have acted all the same."""
        ...

    def disarm(self) -> None:
        """Tell a dead-man switch on the way, if there is one, that all pumps were left verified off.

        The next request arms it again. Raises: nothing; an armed switch is the safe side.
        """
        return

    def close(self) -> None:
        """Release the line, if there is one. Idempotent."""
        return


@dataclass(frozen=True)
class TransportConfig:
    """The link to a device. Times are device seconds and are divided by the backend's `speed`, floored at `floor_s`.

    kind: http | serial.
    connect_s, read_s: time-outs; read_s stays below the 30 s after which the device's server kills a worker.
    floor_s: no time-out is shorter than this in real seconds, whatever the speed: this computer may be busy.
    port, baud: serial device of the PC (prefer /dev/serial/by-id/...) and line rate (irrelevant on USB).
    """

    kind: str = "http"
    connect_s: float = 3.0
    read_s: float = 20.0
    floor_s: float = 1.0
    port: str = "/dev/ttyACM0"
    baud: int = 115200

    def __post_init__(self) -> None:
        if self.kind not in ("http", "serial"):
            raise ValueError(f"transport.kind = {self.kind}: allowed http, serial")
        for key in ("connect_s", "read_s", "floor_s"):
            value = getattr(self, key)
            if not 0.0 < value < 30.0:
                raise ValueError(
                    f"transport.{key} = {value} s: allowed over 0 and under 30 (the device's server gives up at 30 s)"
                )
        if self.baud < 9600:
            raise ValueError(f"transport.baud = {self.baud}: allowed >= 9600 (a state of 1 KB must pass in a second)")

    def timeout(self, seconds: float, speed: float) -> float:
        """Real seconds to wait for what takes `seconds` on a device that runs `speed` times faster."""
        return max(seconds / speed, self.floor_s)
