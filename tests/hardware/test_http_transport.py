"""The HTTP link over real sockets: answers, silence, garbage.

FUZZ_CASES=10000 python -m pytest tests/hardware/test_http_transport.py -k fuzz     the long version
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hardware.chibio.connection import Connection
from hardware.chibio.protocol import Permitted
from hardware.clock import DeviceClock, VirtualClock
from hardware.emulator.process import EmulatorProcess
from hardware.errors import LinkError, ProtocolError, ReactorError
from hardware.link.http import HttpTransport
from hardware.link.messages import DeviceTaken
from hardware.link.open import open_transport
from hardware.link.transport import Reply, TransportConfig
from hardware.logbook import no_log
from tests.hardware.script import answer, state

FUZZ_CASES = int(os.environ.get("FUZZ_CASES", "30"))
QUICK = TransportConfig(connect_s=0.4, read_s=0.4, floor_s=0.1)
OK = b"HTTP/1.1 204 NO CONTENT\r\nDate: Mon, 05 Jan 2026 10:00:00 GMT\r\nConnection: close\r\n\r\n"


class Server:
    """Accepts connections one by one; `behave` gets the connection and the request, its socket is closed after."""

    def __init__(self) -> None:
        self.behave: Callable[[socket.socket, bytes], None] = lambda c, _: c.sendall(OK)
        self.requests: list[bytes] = []
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                request = b""
                while b"\r\n\r\n" not in request and (more := connection.recv(4096)):
                    request += more
                self.requests.append(request)
                self.behave(connection, request)

    def close(self) -> None:
        if self._socket.fileno() >= 0:
            self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            self._thread.join(5.0)


@pytest.fixture
def server() -> Iterator[Server]:
    found = Server()
    yield found
    found.close()


@contextlib.contextmanager
def link(url: str) -> Iterator[HttpTransport]:
    transport = HttpTransport(url, config=QUICK)
    yield transport
    transport.close()


def test_requests_carry_what_forks_want_and_answers_their_date(server: Server) -> None:
    with link(server.url) as transport:
        assert transport.post("/Experiment/1/M0") == Reply(204, b"", "Mon, 05 Jan 2026 10:00:00 GMT")
    request = server.requests[0].lower()
    assert request.startswith(b"post /experiment/1/m0 http/1.1\r\n")
    assert b"x-requested-with: xmlhttprequest" in request
    assert b"connection: close" in request
    assert b"accept-encoding: identity" in request


def test_a_status_is_handed_on_and_a_redirect_not_followed(server: Server) -> None:
    server.behave = lambda c, _: c.sendall(b"HTTP/1.1 308 X\r\nLocation: /getSysdata/\r\nContent-Length: 2\r\n\r\nno")
    with link(server.url) as transport:
        assert transport.get("/getSysdata") == Reply(308, b"no")
    assert len(server.requests) == 1


def silent(c: socket.socket, _: bytes) -> None:
    c.recv(1)  # until the client has had enough


def dribble(c: socket.socket, _: bytes, head: bytes = b"HTTP/1.1 200 OK\r\nContent-Length: 100000000\r\n\r\n") -> None:
    c.sendall(head)
    while True:  # until the client has gone
        c.sendall(b"x")
        time.sleep(0.05)


def dribble_head(c: socket.socket, _: bytes) -> None:
    dribble(c, _, OK[:-4])


def reset(c: socket.socket, _: bytes) -> None:
    c.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")


def half(c: socket.socket, _: bytes) -> None:
    c.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 10\r\n\r\n123")


@pytest.mark.parametrize("behave", [silent, dribble, dribble_head, reset, half, lambda c, _: None, None])
def test_no_answer_is_a_link_error_within_the_time_out(server: Server, behave: Callable[..., None] | None) -> None:
    if behave is None:  # nobody listens
        server.close()
    else:
        server.behave = behave
    with link(server.url) as transport, pytest.raises(LinkError, match="/changeDevice/M0") as told:
        transport.post("/changeDevice/M0")
    assert ("cable" in str(told.value)) == (behave is None), "nobody was reached"


@pytest.mark.parametrize(
    "garbage",
    [
        b"SSH-2.0-OpenSSH\r\n\r\n",
        b"HTTP/1.1 abc\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"HTTP/1.1 200 OK\r\n\r\n" + 300_000 * b"x",
        b"\0" * 100,
    ],
)
def test_what_is_not_http_is_a_protocol_error(server: Server, garbage: bytes) -> None:
    server.behave = lambda c, _: c.sendall(garbage)
    with link(server.url) as transport, pytest.raises(ProtocolError):
        transport.get("/getSysdata/")


def test_an_environment_proxy_is_ignored(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    monkeypatch.setenv("ALL_PROXY", "http://127.0.0.1:9")
    with link(server.url) as transport:
        assert transport.post("/changeDevice/M0").status == 204


@pytest.mark.parametrize(
    "url", ["192.168.7.2:5000", "ftp://x", "http://", "http://x:99999", "http://x/a/", "", "http://[::"]
)
def test_a_malformed_address_says_what_is_allowed(url: str) -> None:
    with pytest.raises(ValueError, match=r"allowed http://host:port"):
        HttpTransport(url)


def test_one_client_per_device(server: Server) -> None:
    with (
        open_transport(TransportConfig(), server.url),
        pytest.raises(DeviceTaken),
        open_transport(TransportConfig(), server.url),
    ):
        pass
    with open_transport(TransportConfig(), server.url):
        pass


def test_an_answer_is_waited_for_as_long_as_the_device_may_take_and_an_agent_tells_in_its_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Twenty seconds of a device at four times real time; what its agent switched off two real seconds ago."""
    asked: list[tuple[str, str, float]] = []

    def fetch(_client: Any, method: str, url: str, wait_s: float, body: bytes | None = None) -> Any:
        asked.append((method, url, wait_s))
        return 200, b'{"switched_off": {"M0": {"Pump1": 2.0}, "M1": {"Pump2": 0.5}}}', {}

    monkeypatch.setattr("hardware.link.http.fetch", fetch)
    token = tmp_path / "token"
    token.write_text("t" * 40)
    token.chmod(0o600)
    config = TransportConfig(connect_s=3.0, read_s=20.0, floor_s=0.5, token_file=str(token))
    link = HttpTransport("http://board:5000/", 4.0, config)
    link.get("/getSysdata/")
    assert link.switched_off() == {"M0": {"Pump1": 8.0}, "M1": {"Pump2": 2.0}}
    link.disarm()
    board = "http://board:5000"
    assert asked == [
        ("GET", f"{board}/getSysdata/", 5.0),
        ("GET", f"{board}/_agent/status", 5.0),
        ("POST", f"{board}/_agent/bye", 5.0),
    ]
    plain = HttpTransport(board, 100.0, TransportConfig(read_s=20.0, floor_s=0.5))
    plain.get("/x")
    assert plain.switched_off() == {}
    plain.disarm()
    assert asked[3:] == [("GET", f"{board}/x", 0.5)]
    plain.close()
    link.close()


def test_time_outs_shrink_with_speed_down_to_a_floor() -> None:
    assert TransportConfig().timeout(20.0, DeviceClock()) == 20.0
    assert TransportConfig().timeout(20.0, DeviceClock(10.0)) == 2.0
    assert TransportConfig().timeout(20.0, DeviceClock(1000.0)) == 1.0


# -- garbage of every kind -------------------------------------------------------------------------------------------

STATE = answer(state()).body
PIECES = st.one_of(
    st.binary(max_size=60),
    st.sampled_from(
        [b"HTTP/1.1 200 OK\r\n", b"HTTP/1.0 204 X\r\n", b"HTTP/1.1 500 E\r\n", b"Content-Length: 5\r\n", b"\r\n", STATE,
         b"Content-Length: 99999999999999999999\r\n", b"Transfer-Encoding: chunked\r\n", b"Content-Encoding: gzip\r\n",
         b"5\r\nabcde\r\n", b"0\r\n\r\n", b"{", b"NaN", STATE[: len(STATE) // 2], b"HTTP/1.1 100 Continue\r\n\r\n",
         b"Content-Length: %d\r\n\r\n" % len(STATE) + STATE]
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def fuzzed() -> Iterator[Server]:
    found = Server()
    yield found
    found.close()


@settings(max_examples=FUZZ_CASES, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pieces=st.lists(PIECES, max_size=6), whole=st.booleans())
def test_fuzz_whatever_comes_back_is_an_answer_or_our_error(fuzzed: Server, pieces: list[bytes], whole: bool) -> None:
    """A read of a device that answers anything: a verified state or a ReactorError, never another exception."""
    garbage = (b"HTTP/1.1 200 OK\r\n" if whole else b"") + b"".join(pieces)
    fuzzed.behave = lambda c, request: c.sendall(OK if request.startswith(b"POST /changeDevice") else garbage)
    fuzzed.requests.clear()
    with link(fuzzed.url) as transport:
        connection = Connection("M0", Permitted(("M0",)), transport, VirtualClock(), no_log)
        with contextlib.suppress(ReactorError):
            assert connection.read().selected == "M0"
    assert all(r.startswith((b"GET", b"POST /changeDevice")) for r in fuzzed.requests)


# -- the whole driver over real HTTP ---------------------------------------------------------------------------------


def test_an_emulator_that_cannot_start_says_why() -> None:
    with pytest.raises(LinkError, match="allowed a list of different names"):
        EmulatorProcess(["--reactors", "M0,M0"])


@pytest.mark.parametrize(
    ("code", "step", "least"), [("site-packages/http", 29, 1000), ("hardware/link/http.py", 1, 30)]
)
def test_ctrl_c_at_any_line_of_a_request_leaves_nothing_taken(code: str, step: int, least: int, server: Server) -> None:
    """Each line of a request is a place at which a signal can come: of the library every 29th is tried, all of ours.

    And another signal behind it is heard, whichever handler was being put back then.
    """
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)

    def request_stopped_at(line: int) -> int:
        seen = 0

        def each(frame: FrameType, event: str, given: Any) -> Any:
            nonlocal seen
            seen += event == "line"
            if event == "line" and seen == line:
                signal.raise_signal(signal.SIGINT)
            return each

        sys.settrace(lambda frame, event, given: each if code in frame.f_code.co_filename else None)
        try:
            transport.post("/SetOutputOn/Pump1/1/M0")
        finally:
            sys.settrace(None)
        return seen

    try:
        with link(server.url) as transport:
            for line in count(1, step):
                try:
                    assert request_stopped_at(line) < line
                    break  # the request is over before
                except KeyboardInterrupt:
                    pass
                assert transport.post("/SetOutputOn/Pump1/0/M0").status == 204, line
                for number in (signal.SIGINT, signal.SIGTERM):
                    with pytest.raises(KeyboardInterrupt):
                        signal.raise_signal(number)
        assert line > least
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_second_ctrl_c_that_its_handler_takes_does_not_cut_the_request_that_switches_off(server: Server) -> None:
    told: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, stack: told.append(number))
    try:
        server.behave = lambda c, _: (signal.raise_signal(signal.SIGTERM), time.sleep(0.2), c.sendall(OK))
        with link(server.url) as transport:
            assert transport.post("/SetOutputOn/Pump1/0/M0").status == 204
        assert told == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)
