"""The board agent's HTTP door over real sockets, and its dead-man switch on a clock that moves only while it waits.

BOARD_PYTHON=python3.7 runs the agent under the interpreter of the board.
"""

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hardware.board import board_agent
from hardware.board.board_agent import BoardAgent, Device, Proxy
from hardware.emulator.faults import inject
from hardware.errors import LinkError
from hardware.link.http import HttpTransport
from hardware.link.messages import AgentNotReadable, AgentRefuses, SecretUnusable
from hardware.link.open import open_transport
from hardware.link.serial import encode_request
from hardware.link.transport import TransportConfig, switched_off
from tests.hardware.emulator_lab import Lab
from tests.hardware.test_board_agent import TOKEN, AgentLab, Recorder, make_token
from tests.hardware.test_http_transport import Server
from tests.patience import PATIENCE_S

Door, Linked = tuple[Proxy, Recorder], tuple[str, TransportConfig]
PUMP = "/SetOutputOn/Pump1/1/M0"
BEARER = f"Authorization: Bearer {TOKEN}"


def talk(port: int, data: bytes) -> tuple[int, str, bytes]:
    """(status, head, body) that a connection which sends `data` gets; status 0 if nothing comes."""
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as line:
        line.sendall(data)
        answer = b""
        while chunk := line.recv(65536):
            answer += chunk
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split(b" ")[1]) if head else 0, head.decode("latin-1").lower(), body


def request(port: int, method: str, path: str, *fields: str, host: str = "127.0.0.1:5001", body: str = "") -> bytes:
    lines = [f"{method} {path} HTTP/1.1", f"Host: {host}", *fields]
    lines += [f"Content-Length: {len(body)}"] * (method != "GET")
    return "\r\n".join([*lines, "", body]).encode("latin-1")


def ask(port: int, method: str, path: str, *fields: str, host: str = "127.0.0.1:5001") -> tuple[int, bytes]:
    status, _, body = talk(port, request(port, method, path, *fields, host=host))
    return status, body


# -- who may ask -----------------------------------------------------------------------------------------------------


class HttpLab(AgentLab):
    """Agent with a token before an emulator; `port` is its HTTP port."""

    def __init__(self, folder: Path, deadman_s: float, tty_line: bool = False) -> None:
        self.token = make_token(folder)
        words = ["--deadman", str(deadman_s), "--http-timeout", "1", "--http", "127.0.0.1:0"]
        super().__init__(folder, *words, "--token-file", str(self.token), tty_line=tty_line)
        self.port = int(self.log.read_text().rsplit("127.0.0.1:", 1)[1].split(",")[0])


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HttpLab]:
    """One whose client has set a pump's target and gone on living; its session is 1."""
    one = HttpLab(tmp_path_factory.mktemp("guarded"), 600.0)
    assert ask(one.port, "POST", "/SetOutputTarget/Pump1/M0/1", BEARER, "X-Session: 1")[0] == 204
    yield one
    one.end()


@pytest.mark.parametrize("path", [PUMP, "/changeDevice/M1", "/_agent/bye", "/_agent/heartbeat"])
@pytest.mark.parametrize(
    ("fields", "host", "status", "words"),
    [
        (["Origin: http://evil.example"], "127.0.0.1:5001", 403, b"web page"),
        (["Origin: null"], "127.0.0.1:5001", 403, b"web page"),
        (["Origin: http://127.0.0.1:5001", BEARER], "127.0.0.1:5001", 403, b"web page"),
        (["Origin: http://evil.example", BEARER], "127.0.0.1:5001", 403, b"web page"),
        ([BEARER], "evil.example", 403, b"evil.example"),
        ([BEARER], "evil.example:5001", 403, b"--host"),
        ([BEARER], "127.0.0.1.evil.example:5001", 403, b"--host"),
        ([BEARER], "127.0.0.1@evil.example", 403, b"--host"),
        ([BEARER], "", 403, b"--host"),
        ([], "127.0.0.1:5001", 401, b"token_file"),
        (["Content-Type: text/plain"], "127.0.0.1:5001", 401, b"token_file"),  # an old browser's page, without Origin
        (["X-Requested-With: XMLHttpRequest"], "127.0.0.1:5001", 401, b"token_file"),
        (["Authorization: Bearer "], "127.0.0.1:5001", 401, b"token_file"),
        ([f"Authorization: Bearer {TOKEN[:-1]}"], "127.0.0.1:5001", 401, b"token_file"),
        ([BEARER + "0"], "127.0.0.1:5001", 401, b"token_file"),
        ([f"Authorization: Basic {TOKEN}"], "127.0.0.1:5001", 401, b"token_file"),
        (["Authorization: Bearer \xb2\xff"], "127.0.0.1:5001", 401, b"token_file"),
        ([BEARER], "127.0.0.1:5001", 409, b"another client is in charge"),  # that of no session
        ([BEARER, "X-Session: 65536"], "127.0.0.1:5001", 400, b"0 to 65535"),
        ([BEARER, "X-Session: \xb2"], "127.0.0.1:5001", 400, b"0 to 65535"),
    ],
)
def test_who_may_not_ask_is_refused_in_one_line_and_nothing_runs(
    guarded: HttpLab, fields: list[str], host: str, status: int, words: bytes, path: str
) -> None:
    found, head, body = talk(guarded.port, request(guarded.port, "POST", path, *fields, host=host))
    assert found == status
    assert words in body
    assert body.count(b"\n") == 1
    assert "access-control" not in head
    state = json.loads(guarded.emulator.ask("GET", "/getSysdata/")[1])
    assert (state["UIDevice"], state["Pump1"]["ON"]) == ("M0", 0)
    assert guarded.motors() == set()
    assert json.loads(ask(guarded.port, "GET", "/_agent/status", BEARER)[1])["armed"] is True


@pytest.mark.parametrize("path", ["/", "/getSysdata/", "/_agent/status"])
def test_reading_needs_the_token_too_and_a_preflight_opens_nothing(guarded: HttpLab, path: str) -> None:
    """A read takes the device's only worker, and shows whichever reactor is selected."""
    assert ask(guarded.port, "GET", path)[0] == 401
    assert ask(guarded.port, "GET", path, BEARER, host="evil.example")[0] == 403
    assert ask(guarded.port, "GET", path, BEARER, "X-Session: 1")[0] == 200
    asks = ["Access-Control-Request-Method: POST", "Access-Control-Request-Private-Network: true"]
    status, head, _ = talk(guarded.port, request(guarded.port, "OPTIONS", path, "Origin: http://evil.example", *asks))
    assert (status, "access-control" in head) == (405, False)


def test_what_is_refused_is_no_sign_of_life(door: Door) -> None:
    proxy, _ = door
    port, agent = proxy.server_address[1], proxy.agent
    assert ask(port, "POST", "/x", BEARER, "X-Session: 1")[0] == 204
    heard = agent._beats
    assert ask(port, "POST", "/_agent/heartbeat")[0] == 401
    assert ask(port, "GET", "/getSysdata/")[0] == 401
    assert ask(port, "POST", "/_agent/bye", BEARER, "X-Session: 2")[0] == 409
    assert (agent._beats, agent.armed) == (heard, True)
    assert ask(port, "POST", "/_agent/heartbeat", BEARER, "X-Session: 1")[0] == 204
    assert agent._beats == heard + 1


def test_only_what_is_carried_gets_the_constant_header_and_the_token_stays_here() -> None:
    device = Server()
    proxy = serve(BoardAgent(Device(device.url, 2.0), 600.0))
    port = proxy.server_address[1]
    assert ask(port, "POST", PUMP, "X-Requested-With: XMLHttpRequest")[0] == 401
    assert ask(port, "POST", PUMP, "Origin: http://evil.example", BEARER)[0] == 403
    assert device.requests == []
    assert ask(port, "POST", PUMP, BEARER, host="localhost:5001")[0] == 204
    (sent,) = device.requests
    assert sent.startswith(b"POST /SetOutputOn/Pump1/1/M0 HTTP/1.1\r\n")
    assert b"X-Requested-With: XMLHttpRequest\r\n" in sent
    assert b"uthorization" not in sent
    assert TOKEN.encode() not in sent
    close(proxy)
    device.close()


@pytest.mark.slow
def test_what_the_agent_answers_over_http(guarded: HttpLab) -> None:
    """A state is not reduced; a device that gives no answer is 504, one that refuses the connection 502."""

    def own(path: str, method: str = "POST") -> tuple[int, bytes]:
        return ask(guarded.port, method, path, BEARER, "X-Session: 1")

    assert "AS7341" in json.loads(own("/getSysdata/", "GET")[1])
    for path, status in (("/SetOutputTarget/Pump1/M0/1", 204), ("/changeDevice/M9", 500), ("/_agent/heartbeat", 204)):
        assert own(path)[0] == status
    assert [own(f"/_agent/{name}", "GET")[0] for name in ("other", "bye")] == [404, 404]
    guarded.emulator.fault("lost_reply/all/1")
    assert own("/changeDevice/M0")[0] == 504
    guarded.emulator.fault("crash")
    guarded.until(lambda: guarded.emulator.server._web is None)
    assert own("/getSysdata/", "GET")[0] == 502
    guarded.emulator.fault("restart")
    guarded.until(lambda: guarded.emulator.server._web is not None)


# -- what a request looks like ---------------------------------------------------------------------------------------


def serve(agent: BoardAgent) -> Proxy:
    proxy = Proxy(("127.0.0.1", 0), agent, TOKEN.encode(), ["board.local"])
    threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    return proxy


def close(proxy: Proxy) -> None:
    proxy.shutdown()
    proxy.server_close()


@pytest.fixture
def door() -> Iterator[Door]:
    device = Recorder()
    proxy = serve(BoardAgent(device, 600.0))
    yield proxy, device
    close(proxy)


GOOD = f"Host: 127.0.0.1\r\n{BEARER}\r\n".encode()
POST = b"POST /x HTTP/1.1\r\n" + GOOD


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (POST + "Content-Length: ²\r\n\r\n".encode(), 400),
        (POST + b"Content-Length: \xb2\r\n\r\n", 400),
        (POST + "Content-Length: ٣\r\n\r\n".encode(), 400),
        (POST + b"Content-Length: -1\r\n\r\n", 400),
        (POST + b"Content-Length: +0\r\n\r\n", 400),
        (POST + b"Content-Length: 0, 0\r\n\r\n", 400),
        (POST + b"Content-Length: 0x0\r\n\r\n", 400),
        (POST + b"Content-Length:\r\n\r\n", 411),
        (POST + b"\r\n", 411),
        (POST + b"Content-Length: 0\r\nContent-Length: 0\r\n\r\n", 400),
        (POST + b"Content-Length: 0\r\ncontent-length: 5\r\n\r\nabcde", 400),
        (POST + b"Transfer-Encoding: chunked\r\n\r\n5\r\nabcde\r\n0\r\n\r\n", 411),
        (POST + b"Content-Length: 0\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 411),
        (POST + b"Content-Length: 5\r\n\r\nabcde", 413),
        (POST + b"Content-Length: 5\r\n\r\n", 413),
        (POST + b"Content-Length: 300000\r\n\r\n" + 300_000 * b"x", 413),
        (POST + b"Content-Length: " + 5000 * b"9" + b"\r\n\r\n", 413),
        (b"GET /x HTTP/1.1\r\n" + GOOD + b"Content-Length: 3\r\n\r\nabc", 413),
        (POST + b"Host: 127.0.0.1\r\nContent-Length: 0\r\n\r\n", 400),
        (POST + BEARER.encode() + b"\r\nContent-Length: 0\r\n\r\n", 400),
        (POST + b" folded\r\nContent-Length: 0\r\n\r\n", 400),
        (POST + b"Content-Length : 0\r\n\r\n", 400),
        (POST + b"A\0: b\r\nContent-Length: 0\r\n\r\n", 400),
        (POST + b"A: b\nContent-Length: 0\r\n\r\n", 400),
        (POST + b"".join(b"A%d: b\r\n" % k for k in range(70)) + b"\r\n", 431),
        (POST + b"A: " + 9000 * b"b" + b"\r\n\r\n", 431),
        (b"GET /" + 600 * b"x" + b" HTTP/1.1\r\n" + GOOD + b"\r\n", 400),
        (b"GET /" + 20_000 * b"x", 431),
        (b"GET /x\r\n" + GOOD + b"\r\n", 400),
        (b"GET /x HTTP/3.0\r\n" + GOOD + b"\r\n", 400),
        (b"GET http://127.0.0.1/x HTTP/1.1\r\n" + GOOD + b"\r\n", 400),
        (b"GET /\xc2\xb2 HTTP/1.1\r\n" + GOOD + b"\r\n", 400),
        (b"GET /a b HTTP/1.1\r\n" + GOOD + b"\r\n", 400),
        (b"PUT /x HTTP/1.1\r\n" + GOOD + b"Content-Length: 0\r\n\r\n", 405),
        (b"TRACE /x HTTP/1.1\r\n" + GOOD + b"\r\n", 405),
        (b"CONNECT 127.0.0.1:22 HTTP/1.1\r\n" + GOOD + b"\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n", 400),
        (b"\r\n\r\n", 400),
    ],
)
def test_what_is_no_plain_request_gets_one_clean_answer(
    door: Door, data: bytes, status: int, capfd: pytest.CaptureFixture[str]
) -> None:
    proxy, device = door
    port = proxy.server_address[1]
    found, head, body = talk(port, data)
    assert (found, body.count(b"\n")) == (status, 1)
    assert f"content-length: {len(body)}" in head
    assert device.asked == []
    assert talk(port, POST + b"Content-Length: 0\r\n\r\n")[0] == 204
    assert device.asked == [("POST", "/x")]
    assert capfd.readouterr().err == ""


def test_names_and_addresses_of_the_board(door: Door) -> None:
    port = door[0].server_address[1]
    for host in ("localhost", "LOCALHOST:80", "127.0.0.1", "board.local:5001", "Board.Local"):
        assert ask(port, "GET", "/x", BEARER, host=host)[0] == 204, host
    for host in ("192.168.7.2", "board.local.evil.example", "board.local:99:5001", "board", "[::1"):
        assert ask(port, "GET", "/x", BEARER, host=host)[0] == 403, host


def test_who_dribbles_keeps_nobody_out(door: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    port = door[0].server_address[1]

    def dribbling(count: int, head_s: float) -> list[socket.socket]:
        monkeypatch.setattr(board_agent, "HEAD_S", head_s)
        lines = [open_.enter_context(socket.create_connection(("127.0.0.1", port), timeout=30.0)) for _ in range(count)]
        for line in lines:
            line.sendall(b"G")
        return lines

    with ExitStack() as open_:
        oldest = dribbling(board_agent.CONNECTIONS, 120.0)[0]
        assert ask(port, "GET", "/x", BEARER)[0] == 204  # in the place of the first of them
        assert oldest.recv(65536) == b""
    with ExitStack() as open_:
        slow, until = dribbling(4, 0.3), time.monotonic() + 60.0
        while slow:  # no pause between two bytes is as long as the time for all of them
            assert time.monotonic() < until
            for line in select.select(slow, [], [], 0.05)[0]:
                assert line.recv(65536).startswith(b"HTTP/1.1 408 ")
                slow.remove(line)
            for line in slow:
                line.sendall(b"E")
    AgentLab.until(lambda: ask(port, "GET", "/x", BEARER)[0] == 204)


def test_a_connection_that_is_cut_leaves_no_trace(door: Door, capfd: pytest.CaptureFixture[str]) -> None:
    port = door[0].server_address[1]
    whole = POST + b"Content-Length: 0\r\n\r\n"
    for end in (0, 1, 20, len(whole) - 1):
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.sendall(whole[:end])
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # ends with a reset
    assert talk(port, whole)[0] == 204
    assert door[1].asked == [("POST", "/x")]
    assert capfd.readouterr().err == ""


# -- one client in charge --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_after_silence_the_next_client_finds_the_pumps_off(tmp_path: Path) -> None:
    lab = HttpLab(tmp_path, 1.0)
    try:
        for path in ("/SetOutputTarget/Pump1/M0/1", PUMP):
            assert ask(lab.port, "POST", path, BEARER, "X-Session: 1")[0] == 204
        lab.until(lambda: lab.motors() == {"M0/Pump1"})
        lab.until(lambda: ask(lab.port, "POST", "/_agent/heartbeat", BEARER, "X-Session: 2")[0] == 204)
        assert lab.motors() == set()
        assert ask(lab.port, "POST", "/_agent/heartbeat", BEARER, "X-Session: 1")[0] == 409
        found = HttpTransport(f"http://127.0.0.1:{lab.port}", config=TransportConfig(token_file=str(lab.token)))
        assert {m: list(pumps) for m, pumps in found.switched_off().items()} == {"M0": ["Pump1"]}
    finally:
        lab.end()


@pytest.mark.parametrize(
    "body", [b"", b"[]", b"{", b"{}", b'{"switched_off": 3}', b'{"switched_off": {"M0": {"Pump1": "x"}}}']
)
def test_a_status_that_is_no_agent_s_is_told_as_that_and_one_without_a_record_says_nothing(body: bytes) -> None:
    with pytest.raises(AgentNotReadable):
        switched_off(body, 1.0)


def test_where_nothing_was_switched_off_nothing_is_said() -> None:
    assert switched_off(b'{"switched_off": {}}', 1.0) == {}
    assert HttpTransport("http://127.0.0.1:1").switched_off() == {}  # no agent, nothing that could have acted


@pytest.fixture
def linked(door: Door, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Linked:
    """The agent's address and the config of a client that knows its token, on a computer of its own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return f"http://127.0.0.1:{door[0].server_address[1]}", TransportConfig(token_file=str(make_token(tmp_path)))


def test_a_killed_client_goes_on_at_once_and_another_one_waits(door: Door, linked: Linked) -> None:
    """The other one has another name for the device, and so neither the lock nor the session of the first."""
    url, config = linked
    with open_transport(config, url) as first:
        assert first.post("/first").status == 204  # closed as the kernel does for a killed one: no BYE
    with open_transport(config, url.replace("127.0.0.1", "localhost")) as foreign:
        with pytest.raises(AgentRefuses):
            foreign.post("/foreign")
        with open_transport(config, url) as resumed:
            assert resumed.post("/resumed").status == 204
            resumed.disarm()
            assert door[0].agent.armed is False
            assert foreign.post("/foreign").status == 204
            assert [path for _, path in door[1].asked] == ["/first", "/resumed", "/foreign"]


# -- the client's side of the token ----------------------------------------------------------------------------------


def test_a_client_without_the_token_is_told_what_to_do(linked: Linked, tmp_path: Path) -> None:
    url, _ = linked
    bare = HttpTransport(url)
    with pytest.raises(AgentRefuses):
        bare.post("/changeDevice/M0")
    bare.disarm()
    bare.close()
    wrong = HttpTransport(url, config=TransportConfig(token_file=str(make_token(tmp_path, 64 * "f"))))
    with pytest.raises(AgentRefuses):
        wrong.get("/getSysdata/")
    wrong.close()
    for text, mode, words in (("x", 0o600, "32 to 256"), (TOKEN, 0o640, "chmod 600"), ("é" * 40, 0o600, "32 to 256")):
        with pytest.raises(LinkError, match=words) as caught:
            HttpTransport(url, config=TransportConfig(token_file=str(make_token(tmp_path, text, mode))))
        assert TOKEN not in str(caught.value)
    with pytest.raises(SecretUnusable):
        HttpTransport(url, config=TransportConfig(token_file=str(tmp_path / "nothing")))


@pytest.mark.slow
def test_a_run_through_the_agent_writes_the_token_nowhere(tmp_path: Path) -> None:
    lab = HttpLab(tmp_path, 60.0)
    run = tmp_path / "run"
    link = ["backend=chibio", f"backend.url=http://127.0.0.1:{lab.port}", f"backend.transport.token_file={lab.token}"]
    scenario = ["scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[2]", "controller=adaptive_inverse"]
    words = [*scenario, "backend.speed=60", "backend.reactors=[M0,M1]", f"hydra.run.dir={run}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-m", "experiments.deploy", *link, *words]
    try:
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert json.loads(ask(lab.port, "GET", "/_agent/status", BEARER)[1])["armed"] is False  # it said BYE
        written = [path for path in run.rglob("*") if path.is_file()]
        assert str(lab.token) in (run / "config.yaml").read_text()
        texts = [done.stdout, done.stderr, lab.log.read_text(), *(path.read_text(errors="replace") for path in written)]
        assert not any(TOKEN in text for text in texts)
    finally:
        lab.end()


class Wait(threading.Event):
    """An event whose `wait` passes the time by itself, until the end of the test."""

    def __init__(self, end_s: float, meanwhile: dict[float, str], agent: "BoardAgent") -> None:
        super().__init__()
        self.now, self._end_s, self._meanwhile, self._agent = 0.0, end_s, meanwhile, agent

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        until = self.now + timeout
        for at in sorted(t for t in self._meanwhile if self.now < t <= until):
            self.now = at
            assert not self._agent.claim("a line", 1, arm=self._meanwhile[at] == "request")
        self.now = until
        return self.now >= self._end_s


class Watched:
    """An agent and its clock. bad: of the passes, which one by one cannot be verified; all others are.

    Attributes: seen, when it made a pass.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, end_s: float, meanwhile: dict[float, str], bad: str = ""
    ) -> None:
        clock = SimpleNamespace(monotonic=lambda: 0.0, strftime=lambda form: "")
        monkeypatch.setattr(board_agent, "time", clock)
        self.agent, self.seen = BoardAgent(Recorder(), 120.0), list[float]()
        wait = Wait(end_s, meanwhile, self.agent)
        self.agent._stop, clock.monotonic = wait, lambda: wait.now

        def sweep(beats: int) -> list[str]:
            self.seen.append(wait.now)
            return ["M0: still on: Pump1"] if bad[len(self.seen) - 1 :][:1] == "x" else []

        monkeypatch.setattr(self.agent, "sweep", sweep)


@pytest.mark.parametrize(
    ("meanwhile", "trips"),
    [
        ({}, [120.0]),  # armed from the start
        ({100.0: "request"}, [220.0]),
        ({100.0: "request", 219.0: "request", 338.0: "request"}, [458.0]),
        ({100.0: "request", 300.0: "request"}, [220.0, 420.0]),
        ({100.0: "bye"}, []),
        ({100.0: "bye", 400.0: "request"}, [520.0]),
    ],
)
def test_it_trips_after_two_minutes_without_a_request_and_once_for_each_silence(
    meanwhile: dict[float, str], trips: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(monkeypatch, 600.0, meanwhile)
    watched.agent._watch()
    assert len(watched.seen) == len(trips)
    assert all(due < at <= due + 0.5 for at, due in zip(watched.seen, trips, strict=True))
    assert watched.agent.trips == len(trips)


def test_what_is_not_verified_off_is_tried_ever_later_up_to_a_minute_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pump that runs on empties a bottle in minutes: the first tries follow at once, and it is never given up."""
    watched = Watched(monkeypatch, 900.0, {700.0: "request"}, "xxxxxxxxx.xx.")
    watched.agent._watch()
    first, second = watched.seen[:10], watched.seen[10:]
    assert np.diff(first).tolist() == [2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0, 60.0]
    assert np.diff(second).tolist() == [2.0, 4.0]
    assert watched.agent.trips == 2


def test_a_client_that_comes_back_ends_the_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch, 240.0, {125.0: "request"}, "xxxxxx")
    watched.agent._watch()
    assert len(watched.seen) == 3  # at 120, 122 and 126 s; the last one finds it back
    assert watched.agent.trips == 1


def test_the_same_request_is_carried_out_again_after_a_trip_which_undid_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer from memory would tell a client that a pump runs which the switch has switched off."""
    watched = Watched(monkeypatch, 130.0, {})
    device = watched.agent.device
    assert isinstance(device, Recorder)
    line = encode_request(1 << 16 | 5, "POST", "/SetOutputOn/Pump1/1/M0")[:-1]
    answers = [watched.agent.answer_line(line) for _ in range(2)]
    assert len(device.asked) == 1  # a client that heard no answer asks the same again
    watched.agent._watch()
    assert watched.agent.trips == 1
    answers.append(watched.agent.answer_line(line))
    assert len(device.asked) == 2
    assert len(set(answers)) == 1


class Emulated(Device):
    """The requests of an agent, carried out on an emulated device."""

    def __init__(self, lab: Lab) -> None:
        super().__init__("http://127.0.0.1:9", 1.0)
        self.lab = lab

    def request(self, method: str, path: str, timeout_s: float | None = None) -> tuple[int, bytes, str]:
        return (*self.lab.device.handle(method, path), "")


def test_a_pass_switches_every_pump_off_and_remembers_each_that_it_found_on() -> None:
    lab = Lab()
    for pump, reactor in (("Pump1", "M0"), ("Pump2", "M0"), ("Pump4", "M1")):
        lab.pump(pump, 1.0, reactor=reactor)
    lab.wait(2.0)
    agent = BoardAgent(Emulated(lab), 120.0)
    inject(lab.device, "lying", "all", -1)
    assert agent.sweep(agent._beats) == ["M0: still on: Pump1, Pump2", "M1 cannot be selected"]
    inject(lab.device, "lying", "all", 0)
    assert agent.sweep(agent._beats) == []
    lab.wait(1.0)
    assert not any(any(lab.device.truth(m)["motors"].values()) for m in ("M0", "M1"))
    found = json.loads(agent.status())["switched_off"]
    assert {m: sorted(pumps) for m, pumps in found.items()} == {"M0": ["Pump1", "Pump2"], "M1": ["Pump4"]}


def test_the_allowed_silence_is_two_minutes_unless_said_otherwise() -> None:
    assert board_agent.parser().parse_args(["--tty", "x"]).deadman == 120.0
