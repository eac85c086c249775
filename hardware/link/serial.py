"""The serial line to the board agent, which carries the requests to the device's server.

Frames are those of protocol 2, described in `hardware/board/board_agent.py`.
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import time
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hardware.clock import DeviceClock
from hardware.errors import LinkError, ProtocolError
from hardware.link import messages
from hardware.link.transport import MAX_BODY, Reply, SwitchedOff, Transport, TransportConfig, new_session, switched_off

if TYPE_CHECKING:
    import serial

NOT_IN_CHARGE = 21  # status of a request that the agent refuses, because another client is in charge
MAX_REQUEST = 512  # bytes of a request line with its newline
_HEADER = re.compile(rb"^<(\d{1,10}) (\d{1,3}) (\d{1,6}) ([0-9a-f]{8})$")


@dataclass(frozen=True)
class ReplyHeader:
    """Header of a reply: ID of the request (0: unreadable request), status, length of the body in bytes, CRC."""

    number: int
    status: int
    length: int
    crc: int

    def fits(self, body: bytes) -> bool:
        return zlib.crc32(b"<%d %d %d" % (self.number, self.status, self.length) + body) == self.crc


def encode_request(number: int, method: str, path: str) -> bytes:
    head = f">{number} {method} {path}".encode("ascii")
    return head + b" %08x\n" % zlib.crc32(head)


def decode_header(line: bytes) -> ReplyHeader | None:
    """Decode the header at the end of a line without its newline, whatever stands before it; None if there is none."""
    match = _HEADER.match(line[line.rfind(b"<") :]) if b"<" in line else None
    return ReplyHeader(int(match[1]), int(match[2]), int(match[3]), int(match[4], 16)) if match else None


def _text(reply: Reply) -> str:
    return reply.body[:300].decode("ascii", "replace")


class SerialTransport(Transport):
    """Framed requests over a serial line to `board_agent.py`; a line that was unplugged is reopened on the next call.

    If a reply is lost or damaged, the same request line is sent again: the agent answers a repeated ID from memory, so
    nothing is carried out twice. The port is opened exclusively, so that no second client can use it.
    Args: port: serial device or pyserial URL. attempts: times one request line is sent before the link counts as lost.
      session: number by which the agent recognizes this client; the upper half of every ID.
    Raises: LinkError if the line cannot be opened or no reply comes, ProtocolError if only damaged replies come.
    """

    def __init__(
        self,
        port: str,
        speed: float = 1.0,
        config: TransportConfig | None = None,
        attempts: int = 5,
        session: int | None = None,
    ) -> None:
        self.port, self._clock, self._attempts = port, DeviceClock(speed), attempts
        self._config = config or TransportConfig(kind="serial")
        self._line: serial.Serial | None = None
        self._session = session or new_session()
        self._count = 0
        self.hello: dict[str, Any] = {}
        self._open()

    def disarm(self) -> None:
        if self._line is not None:
            with contextlib.suppress(LinkError, ProtocolError):
                self._exchange("BYE", "/")

    def switched_off(self) -> SwitchedOff:
        return switched_off(self._exchange("PING", "/").body, self._clock)

    def _open(self) -> None:
        import serial  # only users of the serial link need pyserial

        connect_s = self._config.timeout(self._config.connect_s, self._clock)
        try:
            self._line = serial.serial_for_url(
                self.port, baudrate=self._config.baud, timeout=connect_s, write_timeout=connect_s, exclusive=True
            )
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise messages.PortNotOpened(port=self.port, error=error) from error
        self._count = random.SystemRandom().randrange(2**15)  # late replies to an earlier client have other IDs
        try:
            self.hello = self._parse_hello(self._exchange("HELLO", "/"))
        except BaseException:
            self.close()
            raise

    @staticmethod
    def _parse_hello(reply: Reply) -> dict[str, Any]:
        try:
            hello = json.loads(reply.body)
            protocol = hello["protocol"]
        except (ValueError, RecursionError, KeyError, TypeError) as error:
            raise messages.AgentNotReadable(what="greeting", said=reply.body[:80]) from error
        if protocol != 2:
            raise messages.AgentOutdated(protocol=protocol)
        return dict(hello)

    def close(self) -> None:
        """Release the port; the agent's dead-man switch stays as it is. Idempotent."""
        if self._line is not None:
            with contextlib.suppress(OSError):  # the device may be gone already
                self._line.close()
            self._line = None

    def _request(self, method: str, path: str) -> Reply:
        reply = self._exchange(method, path)
        if reply.status >= 100:
            return reply
        request, text = f"{method} {path}", _text(reply)
        if reply.status in (10, 11):
            raise messages.AgentReachesNobody(request=request, why=text)
        raise messages.AgentReports(request=request, status=reply.status, why=text)

    def _exchange(self, method: str, path: str) -> Reply:
        """Send one request, repeated with the same ID until a whole reply comes. Raises: LinkError, ProtocolError."""
        if self._line is None:
            self._open()
        assert self._line is not None
        self._count = (self._count + 1) % 2**16
        number = self._session << 16 | self._count
        frame = encode_request(number, method, path)
        if len(frame) > MAX_REQUEST:
            raise messages.RequestTooLong(request=f"{method} {path[:40]}...", length=len(frame), most=MAX_REQUEST)
        wait_s = self._config.read_s if method in ("GET", "POST") else self._config.connect_s
        seconds = self._config.timeout(wait_s, self._clock)
        garbage = 0
        last_try = time.monotonic() + 1.5 * seconds  # no third full time-out, even if many replies are damaged
        try:
            for attempt in range(self._attempts):
                if attempt:
                    self._line.reset_input_buffer()
                    if time.monotonic() > last_try:
                        break
                self._line.write(frame)
                reply, seen = self._await(number, time.monotonic() + seconds)
                garbage += seen
                if reply is not None and reply.status == NOT_IN_CHARGE:
                    raise messages.AgentRefuses(request=f"{method} {path}", why=_text(reply))
                if reply is not None:
                    return reply
        except OSError as error:
            self.close()
            raise messages.PortLost(port=self.port, error=error) from error
        self.close()  # a reopened port brings no stale replies
        tried = {"request": f"{method} {path}", "port": self.port, "tries": self._attempts}
        raise messages.DamagedFrames(**tried, count=garbage) if garbage else messages.AgentSilent(**tried)

    def _await(self, number: int, deadline: float) -> tuple[Reply | None, int]:
        """Await the reply to the request `number`, or None when it must be repeated, and count damaged frames."""
        damaged = 0
        while (line := self._until_newline(deadline)) is not None:
            header = decode_header(line)
            if header is None:
                if b"<" in line:  # perhaps our reply, damaged: asking again is safe and quicker than waiting
                    return None, damaged + 1
                continue
            body = self._read(header.length, deadline) if header.length <= MAX_BODY else None
            if body is None or not header.fits(body):
                return None, damaged + 1
            if header.number == 0:
                return None, damaged + 1  # the agent could not read the request
            if header.number == number:
                return Reply(header.status, body), damaged
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
        assert self._line is not None
        data = bytearray()
        while len(data) < count:
            left = deadline - time.monotonic()
            if left <= 0.0:
                return None
            self._line.timeout = left
            data += self._line.read(count - len(data))
        return bytes(data)
