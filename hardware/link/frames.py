"""Frames of the serial line, this computer's side: protocol 1, described in `hardware/board/board_agent.py`."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass

__all__ = ["MAX_REQUEST", "ReplyHeader", "decode_header", "encode_request"]

MAX_REQUEST = 512  # bytes of a request line with its newline
_HEADER = re.compile(rb"^<(\d{1,10}) (\d{1,3}) (\d{1,6}) ([0-9a-f]{8})$")


@dataclass(frozen=True)
class ReplyHeader:
    """What comes before the body of a reply: ID of the request (0: it was unreadable), status, bytes of body, CRC."""

    number: int
    status: int
    length: int
    crc: int

    def fits(self, body: bytes) -> bool:
        """Whether this header and `body` came undamaged."""
        return zlib.crc32(b"<%d %d %d" % (self.number, self.status, self.length) + body) == self.crc


def encode_request(number: int, method: str, path: str) -> bytes:
    """A request line with its newline."""
    head = f">{number} {method} {path}".encode("ascii")
    return head + b" %08x\n" % zlib.crc32(head)


def decode_header(line: bytes) -> ReplyHeader | None:
    """The header at the end of a line without its newline, whatever stands before it; None if there is none."""
    match = _HEADER.match(line[line.rfind(b"<") :]) if b"<" in line else None
    return ReplyHeader(int(match[1]), int(match[2]), int(match[3]), int(match[4], 16)) if match else None
