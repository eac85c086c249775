"""Transport of requests to a device, by HTTP, serial line or to an emulator: the interface that drivers use.

A transport raises `LinkError` if no answer came and `ProtocolError` if the answer was unreadable.
"""

import json
import math
import random
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from conf.schema import check, require, setting
from hardware.clock import Clock, DeviceClock
from hardware.errors import LinkError
from hardware.link import messages

SwitchedOff = Mapping[str, Mapping[str, float]]
"""By reactor and pump: how many device seconds ago a dead-man switch on the link switched the pump off."""

MAX_BODY = 262_144
"""Bytes of the longest answer; a full state is 36 KB (docs/device.md, Routes), the board agent carries at most this."""


def require_web_address(key: str, url: str) -> None:
    """Check an http or https address of a host, without a path. Raises: ValueError naming the config's key."""
    try:
        parts = urlsplit(url)
        _, good = parts.port, parts.scheme in ("http", "https") and bool(parts.hostname) and parts.path in ("", "/")
    except ValueError:
        good = False
    require(good, key, repr(url), "http://host:port, for instance http://192.168.7.2:5000")


def new_session() -> int:
    """Draw a random client number, 1 to 65535, by which a board agent distinguishes its clients."""
    return random.SystemRandom().randrange(1, 2**16)


@dataclass(frozen=True)
class Reply:
    """An answer: HTTP status and body; `date` is the server's clock as an HTTP date, "" if unknown."""

    status: int
    body: bytes
    date: str = ""


class Transport(Protocol):
    """Carrier of one request at a time; a driver never repeats a request blindly unless it is idempotent."""

    def get(self, path: str) -> Reply:
        """Send a GET. Raises: LinkError if no answer came."""
        return self._request("GET", path)

    def post(self, path: str) -> Reply:
        """Send a POST without a body. Raises: LinkError if no answer came; the device may still have acted."""
        return self._request("POST", path)

    def _request(self, method: str, path: str) -> Reply: ...

    def disarm(self) -> None:
        """Disarm a dead-man switch, as all pumps are verified off; the next request arms it again. Raises: nothing."""
        return

    def switched_off(self) -> SwitchedOff:
        """Return what a dead-man switch on the link, if there is one, has switched off. Raises: as `get`."""
        return {}

    def close(self) -> None:
        """Release the line, if there is one. Idempotent."""
        return


class SharedLink(Transport):
    """One link for all reactors of a device: after a time-out of one reactor, the others do not wait for another one.

    After a request that took longer than `SILENT_S` without an answer, every request within the next `PAUSE_S` fails at
    once, so a silent server costs all reactors together one time-out. If other reactors are answered between two
    time-outs of one reactor, only the requests about this reactor fail at once, for `REST_S`, so that it does not take
    the time of the others. heard_s: clock time of the newest answer.
    """

    SILENT_S, PAUSE_S, REST_S = 1.0, 2.0, 40.0

    def __init__(self, link: Transport, clock: Clock) -> None:
        self._link, self._clock = link, clock
        self.heard_s, self._again_s, self._silence = -math.inf, -math.inf, ""
        self._silent: dict[str, tuple[float, float]] = {}  # reactor: last time-out, end of its pause

    def _request(self, method: str, path: str) -> Reply:
        asked_s, about = self._clock.now(), path.rpartition("/")[2]
        silent_s, rests_s = self._silent.get(about, (math.inf, -math.inf))
        if asked_s < max(self._again_s, rests_s):
            raise messages.NotYetSent(request=f"{method} {path}", error=self._silence)
        try:
            reply = self._link.get(path) if method == "GET" else self._link.post(path)
        except LinkError as error:
            now = self._clock.now()
            if now - asked_s > self.SILENT_S:
                alone = bool(about) and self.heard_s > silent_s
                self._silent[about] = now, now + self.REST_S * alone
                self._again_s, self._silence = now + self.PAUSE_S * (not alone), str(error)
            raise
        self.heard_s = self._clock.now()
        self._silent.pop(about, None)
        return reply

    def switched_off(self) -> SwitchedOff:
        """Return what the board agent switched off."""
        return self._link.switched_off()

    def disarm(self) -> None:
        """Release the board agent."""
        self._link.disarm()

    def close(self) -> None:
        """Close the link."""
        self._link.close()


def switched_off(status: bytes, clock: DeviceClock) -> SwitchedOff:
    """Parse the status of an agent: what it has switched off, in device seconds. Raises: ProtocolError."""
    try:
        found = json.loads(status)["switched_off"]
        return {m: {pump: clock.of_real(float(ago)) for pump, ago in pumps.items()} for m, pumps in found.items()}
    except (ValueError, RecursionError, TypeError, AttributeError, KeyError) as error:
        raise messages.AgentNotReadable(what="status", said=status[:80]) from error


@dataclass(frozen=True)
class TransportConfig:
    """The link to a device. Times are device seconds.

    The device's server kills a worker that takes 30 s. Prefer a port /dev/serial/by-id/..., which survives replugging.
    """

    kind: str = setting("http", "kind of link", choices=("http", "serial"))
    connect_s: float = setting(
        3.0, "time-out to connect; on a serial line to write, and for replies of the agent", "s", above=0.0, below=30.0
    )
    read_s: float = setting(20.0, "time-out for a whole reply of the device", "s", above=0.0, below=30.0)
    floor_s: float = setting(
        1.0, "shortest time-out in real seconds at any speed of an emulator", "s", above=0.0, below=30.0
    )
    port: str = setting("/dev/ttyACM0", "serial port of this computer")
    token_file: str = setting(
        "", "HTTP through the board agent: file with a copy of the board's token, mode 600; '': no agent"
    )
    baud: int = setting(115200, "baud rate; no effect on the USB gadget, correct for the debug header", at_least=9600)

    def __post_init__(self) -> None:
        check(self, "transport")

    def timeout(self, seconds: float, clock: DeviceClock) -> float:
        """Return the time-out in real seconds for `seconds` of device time."""
        return max(clock.to_real(seconds), self.floor_s)


def read_secret(key: str, path: str, least: int, remedy: str, printable: str = r"[!-~]") -> str:
    """Read a secret of `least` to 256 characters for the config's `key`. Raises: LinkError, never with the secret."""
    file = Path(path).expanduser()
    try:
        mode, secret = file.stat().st_mode, file.read_bytes()[:2048].decode("utf-8", "replace").strip()
    except OSError as error:
        raise messages.SecretUnusable(key=key, path=path, why=error.strerror, help=remedy) from None
    if mode & 0o077:
        why = f"others may use it (mode {mode & 0o777:o})"
        raise messages.SecretUnusable(key=key, path=path, why=why, help=f"chmod 600 {path}")
    if not re.fullmatch(f"{printable}{{{least},256}}", secret):
        why = f"not one line of {least} to 256 characters"
        raise messages.SecretUnusable(key=key, path=path, why=why, help=remedy)
    return secret
