"""How requests travel to a device: all that a driver knows of HTTP, serial line or emulator.

A transport raises `LinkError` when no answer came and `ProtocolError` when it was garbage.
"""

import random
from dataclasses import dataclass
from typing import Protocol

from conf.schema import check, setting

__all__ = ["MAX_BODY", "Reply", "Transport", "TransportConfig", "new_session"]

MAX_BODY = 262_144
"""Bytes of the longest answer; a full state is 36 KB (docs/device.md, Routes), the board agent carries at most this."""


def new_session() -> int:
    """A name for a client, 1 to 65535, by which a board agent knows it from a second one."""
    return random.SystemRandom().randrange(1, 2**16)


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
        return self._request("GET", path)

    def post(self, path: str) -> Reply:
        """POST without a body. Raises: LinkError when no answer came; the device may have acted all the same."""
        return self._request("POST", path)

    def _request(self, method: str, path: str) -> Reply:
        """One request over this link, GET or POST. Raises: as `get` and `post`."""
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
    """The link to a device. Times are device seconds and are divided by the backend's `speed`.

    The device's server kills a worker that takes 30 s. Prefer a port /dev/serial/by-id/..., which survives replugging.
    """

    kind: str = setting("http", "which link", choices=("http", "serial"))
    connect_s: float = setting(
        3.0, "to connect; on a serial line to write, and for the agent's own answers", "s", above=0.0, below=30.0
    )
    read_s: float = setting(20.0, "for a whole answer of the device", "s", above=0.0, below=30.0)
    floor_s: float = setting(
        1.0,
        "in real seconds no time-out is shorter than this, however fast an emulator runs",
        "s",
        above=0.0,
        below=30.0,
    )
    port: str = setting("/dev/ttyACM0", "serial device of this computer")
    token_file: str = setting(
        "", "over HTTP through the board agent: file with a copy of the board's token, mode 600; '' without an agent"
    )
    baud: int = setting(115200, "irrelevant on the USB gadget, right for the debug header", at_least=9600)

    def __post_init__(self) -> None:
        check(self, "transport")

    def timeout(self, seconds: float, speed: float) -> float:
        """Real seconds to wait for what takes `seconds` on a device that runs `speed` times faster."""
        return max(seconds / speed, self.floor_s)
