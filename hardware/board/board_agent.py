"""Board agent: carries requests by serial line or HTTP to the Chi.Bio server, and is the pumps' dead-man switch.

One file with the standard library of Python 3.7, copied to the BeagleBone unchanged (docs/board_agent.md).

Frames (protocol 2, ASCII, one request at a time on the line)
-------------------------------------------------------------
Request, PC to board, one line of at most 512 bytes including the newline:

    >ID METHOD PATH CRC\\n          >17 POST /SetOutputOn/Pump1/0/M0 7b0c9a3e\\n

  ID      decimal, 1 to 4294967295, no sign, no leading zero. 0 is reserved for replies to unreadable requests. The
          upper 16 bits name the client's session, the lower 16 count its requests and start again at 0.
  METHOD  GET or POST (carried to the device), RAW (GET without reduction of the answer), HELLO, PING, BYE (agent).
  PATH    starts with "/", printable ASCII without space and without ">". "/" for HELLO, PING and BYE.
  CRC     8 lower-case hexadecimal digits: zlib.crc32 of the line from ">" up to, not including, the space before CRC.

Reply, board to PC, a header line, LENGTH bytes of body and one newline:

    <ID STATUS LENGTH CRC\\nBODY\\n

  ID      ID of the request; 0 if the request could not be read.
  STATUS  decimal. 100 to 599: the device's own HTTP status (HELLO, PING, BYE: 200). Under 100: the agent's own status,
            10  the device refused the connection: the request was not carried out;
            11  the device was reached but no complete answer came: it may have acted;
            12  the answer was longer than 262144 bytes;
            20  unreadable request (CRC, form or length), with ID 0: not carried out, send it again,
            21  another client is in charge: not carried out.
  LENGTH  decimal number of body bytes, 0 to 262144.
  CRC     8 lower-case hexadecimal digits: zlib.crc32 of b"<ID STATUS LENGTH" + BODY (no newline, no space before CRC).
  BODY    the device's body; a line of text for status under 100; JSON for HELLO, PING, BYE.

Both sides ignore bytes that belong to no frame: the agent looks for the last ">" of a line, the PC for a line that
starts with "<". The reply to an earlier request may arrive after its time-out: the PC drops every reply whose ID is not
that of the current request (ID 0 counts as a reply to the current request).

Repeating a request is safe: the agent answers a request equal to the previous one (same ID, METHOD, PATH) from memory
and does not carry it out again. A PC that got no reply, a damaged reply or ID 0 therefore sends the same line again. It
takes a new ID for every new request and starts with HELLO. HELLO and a trip of the dead-man switch clear the memory.

HELLO, PING and BYE answer {"agent": "board_agent", "protocol": 2, "version": "2.1", "deadman_s": 120.0, "silent_s":
0.0, "armed": true, "trips": 0, "last_trip": "", "switched_off": {"M0": {"Pump1": 12.5}}, "url":
"http://192.168.7.2:5000"}. silent_s is the silence before this request; switched_off says how many seconds ago the
dead-man switch last found a pump on and switched it off.

The agent reduces the answer to GET /getSysdata/ to the fields that a client needs (under 1 KB): the same JSON with
fewer keys. `record` lists have only their last value; "_records" {"time": n, "OD": n, "ThermometerIR": n} has their
lengths, which differ for an instant while the device appends. "Terminal.text" has its newest 80 characters.

Dead-man switch, one client, HTTP
---------------------------------
docs/board_agent.md says what the switch does, which client is in charge and what is refused. The agent identifies a
client by its line and session, so a killed client that starts again with the same session continues at once.

`--http ADDRESS:PORT` carries HTTP requests to the device. A request needs a Host that is this board, no Origin,
Authorization: Bearer TOKEN (--token-file), and may name its session, X-Session: 0 to 65535. No route of the device
takes a body, so a POST needs Content-Length: 0. The agent's own routes: GET /_agent/status (the JSON of HELLO; no
heartbeat, from any session), POST /_agent/heartbeat (204) for a client that talks to the device directly, and POST
/_agent/bye (204). 502: the device refused the connection; 504: no usable answer came.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import fcntl
import hmac
import http.client
import json
import logging
import os
import re
import select
import signal
import socket
import socketserver
import sys
import termios
import threading
import time
import tty
import urllib.parse
import zlib
from collections.abc import Iterable
from typing import Any

VERSION = "2.1"
PROTOCOL = 2
MAX_LINE = 512
MAX_BODY = 262144
REFUSED, NO_ANSWER, TOO_LONG, UNREADABLE, NOT_IN_CHARGE = 10, 11, 12, 20, 21
DEVICE_METHODS = ("GET", "POST", "RAW")
AGENT_METHODS = ("HELLO", "PING", "BYE")
PUMPS = ("Pump1", "Pump2", "Pump3", "Pump4")
PROBE_TIMEOUT_S = 40.0  # longer than the 30 s after which the device's server kills a hung worker
RETRY_S = (2.0, 60.0)  # first and longest pause between passes of the dead-man switch that were not verified
WRITE_TIMEOUT_S = 5.0  # without a byte sent
BACKOFF_S = (0.2, 5.0)  # first and longest pause before the line is opened again
HEAD_S, MAX_HEAD, MAX_FIELDS = 5.0, 8192, 64  # most of an HTTP request's head: time to send it, bytes, fields
CONNECTIONS = 32  # most connections at a time without the token

log = logging.getLogger("board_agent")


# -- frames --------------------------------------------------------------------------------------------------------


def decode_request(line: bytes) -> tuple[int, str, str] | None:
    """Decode (ID, METHOD, PATH) of a line without its newline; None if it is not a valid request. Never raises."""
    start = line.rfind(b">")
    parts = line[start:].split(b" ") if start >= 0 and len(line) - start < MAX_LINE else []
    if len(parts) != 4 or parts[3] != b"%08x" % zlib.crc32(b" ".join(parts[:3])):
        return None
    number, method, path = parts[0][1:], parts[1].decode("latin-1"), parts[2]
    if not number.isdigit() or number.startswith(b"0") or len(number) > 10 or int(number) > 0xFFFFFFFF:
        return None
    if method not in DEVICE_METHODS + AGENT_METHODS or (method in AGENT_METHODS and path != b"/"):
        return None
    if not path.startswith(b"/") or any(not 33 <= byte <= 126 for byte in path):
        return None
    return int(number), method, path.decode("ascii")


def encode_reply(number: int, status: int, body: bytes) -> bytes:
    """Encode header line, body and closing newline."""
    head = b"<%d %d %d" % (number, status, len(body))
    return head + b" %08x\n" % zlib.crc32(head + body) + body + b"\n"


SLOT = ("ON", "LED", "BaseBand", "Emit1Band", "Gain", "Base", "Emit1")
KEPT = {  # None = the whole field
    "UIDevice": None, "presentDevices": None, "DeviceID": None, "Version": ("value",),
    "Experiment": ("ON", "cycles", "startTime"),
    "time": ("record",), "OD": ("ON", "current", "target", "Measuring", "record"), "OD0": ("raw", "target"),
    "Pump1": ("ON", "target"), "Pump2": ("ON", "target"), "Pump3": ("ON", "target"), "Pump4": ("ON", "target"),
    "Stir": ("ON", "target"), "Heat": ("ON", "target"), "Thermostat": ("ON", "target"),
    "ThermometerIR": ("current", "record"), "Volume": ("target",),
    "Zigzag": ("ON",), "Custom": ("ON",), "Chemostat": ("ON",), "Light": ("ON",), "FP1": SLOT, "FP2": SLOT,
    "FP3": SLOT, "Terminal": ("text",),
}  # fmt: skip


def reduce_sysdata(body: bytes) -> bytes:
    """Reduce the answer to GET /getSysdata/ to the fields a client needs; leave an unexpected answer unchanged."""
    try:
        data = json.loads(body.decode("utf-8"))
        small = {}
        for name, keys in KEPT.items():
            if name in data:
                entry = data[name]
                small[name] = entry if keys is None else {key: entry[key] for key in keys if key in entry}
        for name in ("FP1", "FP2", "FP3"):
            if name in small and small[name].get("ON") == 0:
                small[name] = {"ON": 0}
        lengths = {}
        for name in ("time", "OD", "ThermometerIR"):
            lengths[name] = len(small[name]["record"])
            small[name]["record"] = small[name]["record"][-1:]
        small["_records"] = lengths
        if "Terminal" in small and "text" in small["Terminal"]:
            text = small["Terminal"]["text"]
            small["Terminal"]["text"] = text[:80] if isinstance(text, str) else text[:2]
        return json.dumps(small, separators=(",", ":")).encode("utf-8")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return body


# -- the device ----------------------------------------------------------------------------------------------------


class Failure(Exception):
    """A request that failed: a status and one line of text."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class Unanswered(Failure):
    """The device gave no answer; `status` tells whether it may have received the request."""


def hang_up(line: socket.socket) -> None:
    """Shut a connection down in both directions; a thread that waits on it wakes up."""
    with contextlib.suppress(OSError):
        line.shutdown(socket.SHUT_RDWR)


class Device:
    """The device's HTTP server.

    Args: url: e.g. http://192.168.7.2:5000. timeout_s: longest wait for an answer, s.
    Raises: ValueError for an address that is not http://HOST[:PORT].
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        parts = urllib.parse.urlsplit(url)
        if parts.scheme != "http" or not parts.hostname or parts.path not in ("", "/"):
            raise ValueError(f"url = {url}: allowed http://HOST:PORT, e.g. http://192.168.7.2:5000")
        self.url, self.timeout_s = url, timeout_s
        self._host, self._port = parts.hostname, parts.port or 80

    def request(self, method: str, path: str, timeout_s: float | None = None) -> tuple[int, bytes, str]:
        """Return (status, body, content type) of an answer within the time-out. Raises: Unanswered."""
        wait_s = timeout_s or self.timeout_s
        deadline = time.monotonic() + wait_s
        connection = http.client.HTTPConnection(self._host, self._port, timeout=wait_s)
        try:
            connection.connect()
        except OSError as problem:
            raise Unanswered(REFUSED, f"{self.url}: {problem}") from problem
        late = threading.Timer(wait_s, hang_up, [connection.sock])  # a slow device must not hold the agent
        late.daemon = True
        late.start()
        try:
            headers = {"X-Requested-With": "XMLHttpRequest", "Content-Length": "0", "Connection": "close"}
            connection.request(method, path, headers=headers)
            response = connection.getresponse()
            body = response.read(MAX_BODY + 1)
            left = response.length
        except (OSError, http.client.HTTPException) as problem:
            raise Unanswered(NO_ANSWER, f"{method} {path}: {type(problem).__name__} {problem}") from problem
        finally:
            late.cancel()
            connection.close()
        if len(body) > MAX_BODY:
            raise Unanswered(TOO_LONG, f"{method} {path}: more than {MAX_BODY} bytes")
        if left or time.monotonic() > deadline:
            raise Unanswered(NO_ANSWER, f"{method} {path}: not complete after {wait_s:g} s, {left} bytes missing")
        return response.status, body, " ".join((response.getheader("Content-Type") or "text/plain").split())


# -- the switch ----------------------------------------------------------------------------------------------------


class BoardAgent:
    """Carrier of one client's requests to the device; it switches the pumps off when no request comes.

    Args: device. deadman_s: allowed silence, s. probe: end a pass with a request that fails on a dead bus.
    `lock` is held for every request and for the whole pass of one reactor.
    """

    def __init__(self, device: Device, deadman_s: float, probe: bool = True) -> None:
        self.device, self.deadman_s, self.probe = device, deadman_s, probe
        self.lock = threading.RLock()
        self.armed, self.session, self.trips, self.last_trip = True, False, 0, ""
        self.silent_s = 0.0  # silence before the latest request
        self._switched_off: dict[str, dict[str, float]] = {}  # reactor, pump: time when last found on and stopped
        self._beat = time.monotonic()
        self._beats = 0
        self._settled = False  # the pumps were verified off in this silence
        self._master: tuple[str, int] | None = None  # line and session of the client in charge
        self._door = threading.Lock()  # held while the client in charge is decided
        self._memory: tuple[tuple[int, str, str], bytes] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def claim(self, line: str, session: int, arm: bool = True) -> str:
        """Note a request of the client in charge and return ""; for any other client return the reason of the refusal.

        Args: line, session: the client. arm: False ends the watch until the next request, whose client is in charge.
        """
        with self._door:
            now = time.monotonic()
            if self._master not in (None, (line, session)):
                return (
                    f"another client is in charge (on {self._master[0]}, {now - self._beat:.0f} s ago): not carried "
                    f"out; end it, or wait for {self.deadman_s:g} s of its silence, after which its pumps go off"
                )
            self.silent_s, self._beat = now - self._beat, now
            self._beats += 1
            self._master = (line, session) if arm else None
            self.armed = self.session = arm
            self._settled = False
        return ""

    def status(self) -> bytes:
        """Return the JSON of HELLO, PING and BYE."""
        now, off = time.monotonic(), self._switched_off.items()
        answer = {
            "agent": "board_agent", "protocol": PROTOCOL, "version": VERSION, "deadman_s": self.deadman_s,
            "silent_s": round(self.silent_s, 3), "armed": self.armed, "trips": self.trips,
            "last_trip": self.last_trip, "url": self.device.url,
            "switched_off": {m: {pump: round(now - at, 3) for pump, at in pumps.items()} for m, pumps in off},
        }  # fmt: skip
        return json.dumps(answer).encode("ascii")

    def answer_line(self, line: bytes) -> bytes:
        """Return the reply frame for one received line; b"" for a line that is no frame."""
        if b">" not in line:
            return b""
        request = decode_request(line)
        if request is None:
            return encode_reply(0, UNREADABLE, b"unreadable request, not carried out")
        number, method, path = request
        refusal = self.claim("the serial line", number >> 16, arm=method != "BYE")
        if refusal:
            return encode_reply(number, NOT_IN_CHARGE, refusal.encode("ascii"))
        if method == "HELLO":
            self._memory = None
        if self._memory is not None and self._memory[0] == request:
            return self._memory[1]
        if method in AGENT_METHODS:
            reply = encode_reply(number, 200, self.status())
        else:
            reply = encode_reply(number, *self._carry(method, path))
        self._memory = request, reply
        return reply

    def _carry(self, method: str, path: str) -> tuple[int, bytes]:
        try:
            with self.lock:
                status, body, _ = self.device.request("GET" if method == "RAW" else method, path)
        except Unanswered as problem:
            return problem.status, str(problem).encode("ascii", "replace")[:200]
        if method == "GET" and path == "/getSysdata/" and status == 200:
            body = reduce_sysdata(body)
        return status, body

    def _watch(self) -> None:
        while not self._stop.wait(min(0.5, self.deadman_s / 10.0)):
            if self.armed and not self._settled and time.monotonic() - self._beat > self.deadman_s:
                self._trip()

    def _trip(self) -> None:
        """Repeat passes until all pumps are verified off or a client is back."""
        beats = self._beats
        self.trips += 1
        self.last_trip = time.strftime("%Y-%m-%dT%H:%M:%S")
        self._memory = None
        log.warning("no valid request for %.0f s: switching all pumps off", self.deadman_s)
        pause = RETRY_S[0]
        while not self._stop.is_set():
            problems = self.sweep(beats)
            with self._door:
                back = self._beats != beats
                if not back:
                    self._master, self._settled = None, not problems
            if back or not problems:
                log.warning("a client is back, dead-man pass ended" if back else "pumps verified off")
                return
            log.error("not verified: %s; next try in %.0f s", "; ".join(problems), pause)
            self._stop.wait(pause)
            pause = min(2.0 * pause, RETRY_S[1])

    def sweep(self, beats: int) -> list[str]:
        """Switch off the pumps of all present reactors; return what was not verified. End early if a client is back."""
        problems = []
        try:
            with self.lock:
                present = self._state()["presentDevices"]
            for name in sorted(present):
                if present[name] == 1 and self._beats == beats:
                    with self.lock:
                        problems += self._switch_off(name)
        except Exception as problem:  # the watch continues, whatever a device answers
            problems.append(f"{type(problem).__name__}: {str(problem)[:200]}")
        return problems

    def _state(self) -> dict:  # type: ignore[type-arg]
        status, body, _ = self.device.request("GET", "/getSysdata/")
        if status != 200:
            raise ValueError(f"getSysdata answered {status}")
        return dict(json.loads(body.decode("utf-8")))

    def _switch_off(self, name: str) -> list[str]:
        self.device.request("POST", "/changeDevice/" + name)
        state = self._state()
        if state["UIDevice"] != name or state["presentDevices"][name] != 1:
            return [name + " cannot be selected"]
        if state["OD"]["ON"] == 1:
            log.warning("%s: pumps left on, because the device regulates the OD (OD.ON = 1)", name)
            return []
        for pump in PUMPS:
            status, _, _ = self.device.request("POST", f"/SetOutputOn/{pump}/0/{name}")
            if status != 204:
                return [f"{pump} of {name}: status {status}"]
            if state[pump]["ON"] != 0:
                mine = {**self._switched_off.get(name, {}), pump: time.monotonic()}
                self._switched_off = {
                    **self._switched_off,
                    name: mine,
                }  # a new dict, for another thread that reads
        state = self._state()
        running = [pump for pump in PUMPS if state[pump]["ON"] != 0]
        if state["UIDevice"] != name or running:
            return [f"{name}: still on: " + (", ".join(running) or "unknown, another reactor was selected")]
        if self.probe:
            self.device.request("POST", "/MeasureTemp/IR/" + name, PROBE_TIMEOUT_S)
        return []

    def stop(self) -> None:
        """End the watch; in an open session, switch the pumps off."""
        self._stop.set()
        if self.session and not self._settled:
            problems = self.sweep(self._beats)
            log.warning("agent ends: pumps %s", "; ".join(problems) if problems else "verified off")


# -- serial line ---------------------------------------------------------------------------------------------------


class SerialPort:
    """A tty in raw mode, and the answers to its requests; a line that hangs up is opened again.

    Args: path: e.g. /dev/ttyGS0. baud: line rate, without effect on USB. agent.
    Raises: ValueError for a rate that the system does not have.
    """

    def __init__(self, path: str, baud: int, agent: BoardAgent) -> None:
        if not hasattr(termios, f"B{baud}"):
            raise ValueError(f"baud = {baud}: allowed the usual rates, e.g. 115200")
        self._path, self._agent = path, agent
        self._speed = getattr(termios, f"B{baud}")
        self._stop = threading.Event()

    def stop(self) -> None:
        """End `run` within a second."""
        self._stop.set()

    def run(self) -> None:
        pause = BACKOFF_S[0]
        while not self._stop.is_set():
            try:
                descriptor = self._open()
            except (OSError, termios.error) as problem:
                log.warning("%s: %s; next try in %.1f s", self._path, problem, pause)
                self._stop.wait(pause)
                pause = min(2.0 * pause, BACKOFF_S[1])
                continue
            log.info("%s open", self._path)
            began = time.monotonic()
            try:
                self._serve(descriptor)
            except (OSError, termios.error) as problem:
                log.warning("%s: line lost (%s)", self._path, problem)
            finally:
                os.close(descriptor)
            pause = BACKOFF_S[0] if time.monotonic() - began > BACKOFF_S[1] else min(2.0 * pause, BACKOFF_S[1])
            self._stop.wait(pause)

    def _open(self) -> int:
        descriptor = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.ioctl(descriptor, termios.TIOCEXCL)
            tty.setraw(descriptor)
            mode = termios.tcgetattr(descriptor)
            mode[2] |= termios.CLOCAL | termios.CREAD
            mode[4] = mode[5] = self._speed
            termios.tcsetattr(descriptor, termios.TCSANOW, mode)
            termios.tcflush(descriptor, termios.TCIOFLUSH)
        except (OSError, termios.error):
            os.close(descriptor)
            raise
        return descriptor

    def _serve(self, descriptor: int) -> None:
        waiting = b""
        while not self._stop.is_set():
            if not select.select([descriptor], [], [], 0.5)[0]:
                continue
            try:
                chunk = os.read(descriptor, 4096)
            except BlockingIOError:
                continue
            if not chunk:
                raise OSError(errno.EIO, "hung up")
            *lines, waiting = (waiting + chunk).split(b"\n")
            waiting = waiting[-2 * MAX_LINE :]  # endless garbage is cut; it makes one bad line
            for line in lines:
                reply = self._agent.answer_line(line)
                if reply:
                    self._write(descriptor, reply)

    def _write(self, descriptor: int, data: bytes) -> None:
        """Send a reply; drop it if nobody reads, because a full line must not stop the agent."""
        while data:
            if not select.select([], [descriptor], [], WRITE_TIMEOUT_S)[1]:
                termios.tcflush(descriptor, termios.TCOFLUSH)
                log.warning("%s: nobody reads, reply dropped", self._path)
                return
            try:
                data = data[os.write(descriptor, data) :]
            except BlockingIOError:
                continue


# -- HTTP ----------------------------------------------------------------------------------------------------------


class Refusal(Failure):
    """A request that is not carried out; `status` is the HTTP status, the message a line for the client."""


REASONS = {
    400: "Bad Request", 401: "Unauthorized", 403: "Forbidden", 404: "Not Found", 405: "Method Not Allowed",
    408: "Request Timeout", 409: "Conflict", 411: "Length Required", 413: "Payload Too Large",
    431: "Request Header Fields Too Large", 502: "Bad Gateway", 504: "Gateway Timeout",
}  # fmt: skip
REQUEST = re.compile(rb"([A-Z]{1,16}) (/[!-~]{0,511}) HTTP/1\.[01]")
FIELD = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t -~\x80-\xff]*)")
OWN_POSTS = ("/_agent/heartbeat", "/_agent/bye")


def parse_head(head: bytes) -> tuple[str, str, dict[str, str]]:
    """Parse METHOD, PATH and fields (names in lower case) of an HTTP request's head, without the empty line after it.

    Raises: Refusal unless it is one GET or POST without a body and without a repeated field.
    """
    first, *lines = head.split(b"\r\n")
    request = REQUEST.fullmatch(first)
    if request is None:
        raise Refusal(400, "unreadable request line: allowed METHOD /PATH HTTP/1.1, a path of 1 to 512 characters")
    if len(lines) > MAX_FIELDS:
        raise Refusal(431, f"{len(lines)} header fields: allowed {MAX_FIELDS}")
    fields: dict[str, str] = {}
    for line in lines:
        found = FIELD.fullmatch(line)
        name = found.group(1).decode("ascii").lower() if found else ""
        if found is None or name in fields:
            raise Refusal(400, f"header field {name or 'unreadable'}: allowed NAME: VALUE, each name once")
        fields[name] = found.group(2).decode("latin-1").strip(" \t")
    method = request.group(1).decode("ascii")
    if method not in ("GET", "POST"):
        raise Refusal(405, f"method {method}: allowed GET and POST")
    length = fields.get("content-length", "0" if method == "GET" else "")
    if "transfer-encoding" in fields or not length:
        raise Refusal(411, "no length: allowed Content-Length: 0 (curl: -d '')")
    if not re.fullmatch("[0-9]+", length):
        raise Refusal(400, "unreadable length: allowed Content-Length: 0")
    if length.strip("0"):
        raise Refusal(413, "a body: allowed none, Content-Length: 0")
    return method, request.group(2).decode("ascii"), fields


def read_token(path: str | None) -> bytes:
    """Read the token from a file. Raises: ValueError if it is missing, readable by others or too short."""
    if not path:
        raise ValueError("http without token-file: give --token-file FILE (docs/board_agent.md, The token)")
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            mode, token = os.fstat(file.fileno()).st_mode, (file.read(1024) or b"").strip()
    except OSError as problem:
        raise ValueError(
            f"token-file = {path}: {problem.strerror}; make it (docs/board_agent.md, The token)"
        ) from problem
    if mode & 0o077:
        raise ValueError(f"token-file = {path}: others may use it (mode {mode & 0o777:o}); chmod 600 {path}")
    if not re.fullmatch(rb"[!-~]{32,256}", token):
        raise ValueError(f"token-file = {path}: allowed one line of 32 to 256 characters without spaces; make it anew")
    return token


class Proxy(socketserver.ThreadingTCPServer):
    """HTTP server of the agent; see the module's docstring.

    Args: address: where to listen. agent. token: secret of its clients. names: names of this board in a Host field.
    """

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = CONNECTIONS

    def __init__(self, address: tuple[str, int], agent: BoardAgent, token: bytes, names: Iterable[str]) -> None:
        self.agent, self.token = agent, token
        self.names = {"localhost", "127.0.0.1", address[0].lower(), *(name.lower() for name in names)}
        self._strangers: dict[socket.socket, None] = {}  # connections without the token, oldest first
        self._list = threading.Lock()
        super().__init__(address, ProxyHandler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Process a request in a new thread; if too many lack the token, close the oldest connection."""
        with self._list:
            if len(self._strangers) >= CONNECTIONS:
                oldest = next(iter(self._strangers))
                del self._strangers[oldest]
                hang_up(oldest)
            self._strangers[request] = None
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.let_in(request)

    def let_in(self, request: socket.socket) -> None:
        """Stop counting a connection that has shown the token, or has ended. Idempotent."""
        with self._list:
            self._strangers.pop(request, None)


def encode_answer(status: int, body: bytes, kind: str) -> bytes:
    """Encode an HTTP answer, without a header that would permit web pages of other origins."""
    lines = [f"HTTP/1.1 {status} {REASONS.get(status, 'OK')}", f"Server: board_agent/{VERSION}", "Connection: close"]
    lines += [f"Content-Type: {kind}", "X-Content-Type-Options: nosniff", "Cache-Control: no-store"]
    lines += [f"Content-Length: {len(body)}"] * (status not in (204, 304))
    lines += ["WWW-Authenticate: Bearer"] * (status == 401)
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + body


class ProxyHandler(socketserver.BaseRequestHandler):
    server: Proxy

    def handle(self) -> None:
        with contextlib.suppress(OSError):  # the client is gone
            try:
                answer = self._answer(*parse_head(self._head()))
            except Refusal as refusal:
                answer = refusal.status, f"{refusal}\n".encode("ascii", "replace"), "text/plain"
            self.request.settimeout(WRITE_TIMEOUT_S)
            self.request.sendall(encode_answer(*answer))
            self.request.shutdown(socket.SHUT_WR)
            self.request.settimeout(0.2)
            deadline = time.monotonic() + 1.0  # read a refused body, else a reset would overtake the answer
            while self.request.recv(65536) and time.monotonic() < deadline:
                pass

    def _head(self) -> bytes:
        """Read the head, up to the empty line. Raises: Refusal if it does not come in time or is too long."""
        deadline, data = time.monotonic() + HEAD_S, b""
        while b"\r\n\r\n" not in data:
            left = deadline - time.monotonic()
            self.request.settimeout(max(left, 0.001))
            try:
                chunk = self.request.recv(4096)
            except socket.timeout:  # noqa: UP041 (another class in Python 3.7)
                left = 0.0
            if left <= 0.0:
                raise Refusal(408, f"no whole request within {HEAD_S:g} s")
            if not chunk:
                raise Refusal(400, "no whole request")
            data += chunk
            if len(data) > MAX_HEAD:
                raise Refusal(431, f"request head too long: allowed {MAX_HEAD} bytes")
        return bytes(data.partition(b"\r\n\r\n")[0])

    def _answer(self, method: str, path: str, fields: dict[str, str]) -> tuple[int, bytes, str]:
        agent, session = self.server.agent, self._admit(fields)
        if (method, path) == ("GET", "/_agent/status"):
            return 200, agent.status(), "application/json"
        own = path.startswith("/_agent")
        if own and (method != "POST" or path not in OWN_POSTS):
            raise Refusal(404, "allowed: GET /_agent/status, POST /_agent/heartbeat, POST /_agent/bye")
        refusal = agent.claim("HTTP", session, arm=path != "/_agent/bye")
        if refusal:
            raise Refusal(409, refusal)
        if own:
            return 204, b"", "text/plain"
        try:
            with agent.lock:
                return agent.device.request(method, path)
        except Unanswered as problem:
            raise Refusal(502 if problem.status == REFUSED else 504, str(problem)) from problem

    def _admit(self, fields: dict[str, str]) -> int:
        """Admit a client and return its session. Raises: Refusal for a web page and for a client without the token."""
        host = re.sub(r":[0-9]{1,5}$", "", fields.get("host", "")).lower()
        if host not in self.server.names and host != self.request.getsockname()[0]:
            raise Refusal(403, f"Host {host[:80]!r} is not this agent: use its address, or start it with --host NAME")
        if "origin" in fields:
            raise Refusal(403, "a request of a web page (it has an Origin) is refused; use a program")
        given = fields.get("authorization", "").encode("latin-1")
        if not hmac.compare_digest(given, b"Bearer " + self.server.token):
            raise Refusal(
                401,
                "no or wrong token: send Authorization: Bearer TOKEN with the board's (backend.transport.token_file)",
            )
        session = fields.get("x-session", "0")
        if not re.fullmatch("[0-9]{1,5}", session) or int(session) > 0xFFFF:
            raise Refusal(400, "X-Session: allowed 0 to 65535")
        self.server.let_in(self.request)
        return int(session)


# -- program -------------------------------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(description="Carries requests to the Chi.Bio server; turns pumps off in silence.")
    p.add_argument("--tty", help="serial line to serve, e.g. /dev/ttyGS0")
    p.add_argument("--baud", type=int, default=115200, help="line rate (default %(default)s)")
    p.add_argument("--http", metavar="ADDRESS:PORT", help="listen here for HTTP requests, e.g. 192.168.7.2:5001")
    p.add_argument("--token-file", metavar="FILE", help="secret of HTTP clients, mode 600 (needed by --http)")
    p.add_argument("--host", action="append", default=[], metavar="NAME", help="a further name of this board")
    p.add_argument("--url", default="http://192.168.7.2:5000", help="the device's server (default %(default)s)")
    p.add_argument("--deadman", type=float, default=120.0, help="allowed silence, s (default %(default)s)")
    p.add_argument("--http-timeout", type=float, default=18.0, help="wait for the device, s (default %(default)s)")
    p.add_argument("--no-probe", action="store_true", help="do not test the bus with MeasureTemp")
    return p


def main(argv: list[str] | None = None) -> int:
    """Run until SIGTERM or SIGINT; return the exit status."""
    arguments = parser().parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    proxy = None
    try:
        if not arguments.tty and not arguments.http:
            raise ValueError("neither --tty nor --http is given: allowed one or both")
        for key, value in (("deadman", arguments.deadman), ("http-timeout", arguments.http_timeout)):
            if not 0.0 < value <= 86400.0:
                raise ValueError(f"{key} = {value:g} s: allowed more than 0, up to 86400")
        agent = BoardAgent(Device(arguments.url, arguments.http_timeout), arguments.deadman, not arguments.no_probe)
        port = SerialPort(arguments.tty, arguments.baud, agent) if arguments.tty else None
        if arguments.http:
            host, _, number = arguments.http.rpartition(":")
            if not host or not number.isdigit():
                raise ValueError(f"http = {arguments.http}: allowed ADDRESS:PORT, e.g. 192.168.7.2:5001")
            proxy = Proxy((host, int(number)), agent, read_token(arguments.token_file), arguments.host)
    except (ValueError, OSError, OverflowError) as problem:
        print(f"board_agent: {problem}", file=sys.stderr)
        return 2
    ends = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # in all threads; sigwait below takes them
    agent.start()
    if port is not None:
        threading.Thread(target=port.run, daemon=True).start()
    if proxy is not None:
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
    where = [arguments.tty] if arguments.tty else []
    where += [f"http://{arguments.http.rpartition(':')[0]}:{proxy.server_address[1]}"] if proxy else []
    log.info("board_agent %s ready on %s, dead-man %.6g s", VERSION, " and ".join(where), agent.deadman_s)
    signal.sigwait(ends)
    if port is not None:
        port.stop()
    if proxy is not None:
        proxy.shutdown()
    agent.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
