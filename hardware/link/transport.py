"""How requests travel to a device: `Transport` is all a driver knows of HTTP, serial line or emulator.

HTTP goes straight to the device's server. The serial line needs its peer, `board_agent.py`, on the board; the frames
are described there (protocol 1). Both raise `LinkError` when no answer came and `ProtocolError` when it was garbage.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import random
import re
import tempfile
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

import httpx

from conf.schema import check, setting
from hardware.errors import DeviceStateError, LinkError, ProtocolError

if TYPE_CHECKING:
    import serial

__all__ = ["HttpTransport", "Reply", "SerialTransport", "Transport", "TransportConfig", "open_transport"]

MAX_BODY = 262_144  # bytes; a full state is 36 KB (chibio.md section 2), the serial agent carries no more than this


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
    baud: int = setting(115200, "irrelevant on the USB gadget, right for the debug header", at_least=9600)

    def __post_init__(self) -> None:
        check(self, "transport")

    def timeout(self, seconds: float, speed: float) -> float:
        """Real seconds to wait for what takes `seconds` on a device that runs `speed` times faster."""
        return max(seconds / speed, self.floor_s)


class HttpTransport:
    """HTTP to a Chi.Bio server, one connection per request (its gunicorn worker closes each one anyway).

    Proxies of the environment are ignored, redirects are not followed, compression is not asked for, and the whole
    answer must come within `read_s`, so that a server that dribbles bytes cannot hold the control loop.

    Args:
      url: http://host:port of the device.
      speed: device seconds per real second (1 on the bench).
      config: time-outs.
    Raises: ValueError for a malformed address; LinkError, ProtocolError from the calls.
    """

    def __init__(self, url: str, speed: float = 1.0, config: TransportConfig | None = None) -> None:
        config = config or TransportConfig()
        try:
            parts = urlsplit(url)
            valid = parts.scheme in ("http", "https") and parts.hostname and parts.path in ("", "/")
            _ = parts.port
        except ValueError:
            valid = False
        if not valid:
            raise ValueError(f"url = {url!r}: allowed http://host:port, for instance http://192.168.7.2:5000")
        self.url = url.rstrip("/")
        self._read_s = config.timeout(config.read_s, speed)
        self._client = httpx.Client(
            timeout=httpx.Timeout(self._read_s, connect=config.timeout(config.connect_s, speed)),
            limits=httpx.Limits(max_connections=1, max_keepalive_connections=0),
            headers={"X-Requested-With": "XMLHttpRequest", "Accept-Encoding": "identity", "Connection": "close"},
            trust_env=False,
        )

    def get(self, path: str) -> Reply:
        """GET `path`. Raises: LinkError, ProtocolError."""
        return self._request("GET", path)

    def post(self, path: str) -> Reply:
        """POST `path` without a body. Raises: LinkError (the device may have acted), ProtocolError."""
        return self._request("POST", path)

    def disarm(self) -> None:
        """Nothing: no switch on this way."""

    def close(self) -> None:
        """Close the client. Idempotent."""
        self._client.close()

    def _request(self, method: str, path: str) -> Reply:
        deadline = time.monotonic() + self._read_s
        body = bytearray()
        try:
            with self._client.stream(method, self.url + path) as answer:
                for chunk in answer.iter_raw():
                    body += chunk
                    if len(body) > MAX_BODY:
                        raise ProtocolError(f"{method} {path}: the answer is longer than {MAX_BODY} bytes")
                    if time.monotonic() > deadline:
                        raise LinkError(f"{method} {path}: the answer was not complete after {self._read_s:.1f} s")
                return Reply(answer.status_code, bytes(body), answer.headers.get("date", ""))
        except (httpx.RemoteProtocolError, httpx.DecodingError) as error:
            if "without sending" in str(error):  # closed before the answer was whole: a dying server, not a strange one
                raise LinkError(f"{method} {path}: {self.url} closed the connection without a whole answer") from error
            raise ProtocolError(f"{method} {path}: not an HTTP answer ({error})") from error
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            reason = str(error) or type(error).__name__
            raise LinkError(f"{method} {path}: no answer from {self.url} ({reason}); check cable and server") from error


_HEADER = re.compile(rb"^<(\d{1,10}) (\d{1,3}) (\d{1,6}) ([0-9a-f]{8})$")


class SerialTransport:
    """Framed requests over a serial line to `board_agent.py`; a line that was unplugged is reopened on the next call.

    The very same request line is repeated when its reply is lost or damaged: the agent answers a repeated ID from
    memory, so nothing is carried out twice. Opened exclusively, so that no second client can speak in between.

    Args:
      port: serial device or pyserial URL.
      speed: device seconds per real second.
      config: line rate and time-outs.
      attempts: times one request line is sent before the link counts as lost.
      rng: draws the first request ID of a session.
    Raises: LinkError when the line cannot be opened or nothing comes back, ProtocolError when only garbage does.
    """

    def __init__(
        self,
        port: str,
        speed: float = 1.0,
        config: TransportConfig | None = None,
        attempts: int = 5,
        rng: random.Random | None = None,
    ) -> None:
        self.port = port
        self._config = config or TransportConfig(kind="serial")
        self._speed = speed
        self._attempts = attempts
        self._rng = rng or random.Random()  # repetition of an ID is all that matters, so system entropy is right
        self._line: serial.Serial | None = None
        self._id = 0
        self.hello: dict[str, Any] = {}
        self._open()

    def get(self, path: str) -> Reply:
        """GET `path`; /getSysdata/ comes reduced (see `board_agent.py`). Raises: LinkError, ProtocolError."""
        return self._request("GET", path)

    def post(self, path: str) -> Reply:
        """POST `path`. Raises: LinkError (the device may have acted), ProtocolError."""
        return self._request("POST", path)

    def disarm(self) -> None:
        """BYE to the agent, whose switch then rests until the next request."""
        if self._line is not None:
            with contextlib.suppress(LinkError, ProtocolError):
                self._exchange("BYE", "/")

    def close(self) -> None:
        """Release the port; the agent's switch stays as it is. Idempotent."""
        self._drop()

    def _open(self) -> None:
        import serial  # only users of the serial link need pyserial

        connect_s = self._config.timeout(self._config.connect_s, self._speed)
        try:
            self._line = serial.serial_for_url(
                self.port, baudrate=self._config.baud, timeout=connect_s, write_timeout=connect_s, exclusive=True
            )
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise LinkError(
                f"serial port {self.port}: {error}; check cable and port name, close other programs"
            ) from error
        self._id = self._rng.randrange(1, 2**31)
        try:
            self.hello = self._parse_hello(self._exchange("HELLO", "/"))
        except BaseException:
            self._drop()
            raise

    @staticmethod
    def _parse_hello(reply: Reply) -> dict[str, Any]:
        try:
            hello = json.loads(reply.body)
            protocol = hello["protocol"]
        except (ValueError, RecursionError, KeyError, TypeError) as error:
            raise ProtocolError(f"the board agent's greeting is not readable: {reply.body[:80]!r}") from error
        if protocol != 1:
            raise ProtocolError(f"the board agent speaks protocol {protocol}, this driver 1: install the same version")
        return dict(hello)

    def _drop(self) -> None:
        if self._line is not None:
            with contextlib.suppress(OSError):  # the device may be gone already
                self._line.close()
            self._line = None

    def _request(self, method: str, path: str) -> Reply:
        if self._line is None:
            self._open()
        reply = self._exchange(method, path)
        if reply.status >= 100:
            return reply
        text = reply.body[:120].decode("ascii", "replace")
        if reply.status in (10, 11):
            raise LinkError(f"{method} {path}: the board agent cannot reach the device ({text})")
        raise ProtocolError(f"{method} {path}: the board agent reports status {reply.status} ({text})")

    def _exchange(self, method: str, path: str) -> Reply:
        """One request, repeated under the same ID until a whole reply came. Raises: LinkError, ProtocolError."""
        assert self._line is not None
        self._id = self._id % 4294967295 + 1
        head = f">{self._id} {method} {path}".encode("ascii")
        frame = head + b" %08x\n" % zlib.crc32(head)
        if len(frame) > 512:
            raise ProtocolError(f"{method} {path[:40]}...: request of {len(frame)} bytes, allowed 512")
        seconds = self._config.timeout(
            self._config.read_s if method in ("GET", "POST") else self._config.connect_s, self._speed
        )
        garbage, last_try = 0, time.monotonic() + 1.5 * seconds  # many damaged replies, but no third full time-out
        try:
            for attempt in range(self._attempts):
                if attempt:
                    self._line.reset_input_buffer()
                    if time.monotonic() > last_try:
                        break
                self._line.write(frame)
                reply, seen = self._await(time.monotonic() + seconds)
                garbage += seen
                if reply is not None:
                    return reply
        except OSError as error:
            self._drop()
            raise LinkError(f"serial port {self.port} was lost ({error}); reopened at the next request") from error
        self._drop()  # a fresh session cannot be answered by stale replies
        if garbage:
            raise ProtocolError(
                f"{method} {path}: {garbage} damaged frames on {self.port}, none whole in {self._attempts} tries"
            )
        raise LinkError(f"{method} {path}: no reply on {self.port} in {self._attempts} tries; is the agent running?")

    def _await(self, deadline: float) -> tuple[Reply | None, int]:
        """The reply to the request in flight, or None when it must be repeated, and how many frames were damaged."""
        damaged = 0
        while (line := self._until_newline(deadline)) is not None:
            match = _HEADER.match(line[line.rfind(b"<") :]) if b"<" in line else None
            if match is None:
                if b"<" in line:  # perhaps our reply, damaged: asking again is safe and quicker than waiting
                    return None, damaged + 1
                continue
            number, status, length, crc = int(match[1]), int(match[2]), int(match[3]), int(match[4], 16)
            body = self._read(length, deadline) if length <= MAX_BODY else None
            head = b"<%d %d %d" % (number, status, length)
            if body is None or zlib.crc32(head + body) != crc:
                return None, damaged + 1
            if number == 0:
                return None, damaged + 1  # the agent could not read the request
            if number == self._id:
                return Reply(status, body), damaged
        return None, damaged

    def _until_newline(self, deadline: float) -> bytes | None:
        line = bytearray()
        while len(line) < 4096:
            byte = self._read(1, deadline)
            if byte is None:
                return None
            if byte == b"\n":
                return bytes(line)
            line += byte
        return bytes(line)

    def _read(self, count: int, deadline: float) -> bytes | None:
        """Exactly `count` bytes, or None at the deadline."""
        assert self._line is not None
        data = bytearray()
        while len(data) < count:
            left = deadline - time.monotonic()
            if left <= 0.0:
                return None
            self._line.timeout = left
            data += self._line.read(count - len(data))
        return bytes(data)


class _Owner:
    """One client per device on this computer: a lock file that the kernel frees when the process ends."""

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
        self._file.close()


class _OwnedHttp(HttpTransport):
    """HTTP with the device's owner lock held as long as the transport is open."""

    def __init__(self, url: str, speed: float, config: TransportConfig) -> None:
        super().__init__(url, speed, config)
        self._owner = _Owner(self.url)

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
