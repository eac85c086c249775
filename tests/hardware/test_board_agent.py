"""The board agent: frames, reduction, dead-man switch; on a real pty, before a real server, as a real process.

BOARD_PYTHON=python3.7 runs the agent under the interpreter of the board.
"""

import ast
import configparser
import contextlib
import json
import os
import pty
import re
import select
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.board import board_agent
from hardware.board.board_agent import BoardAgent, Device, decode_request, encode_reply, reduce_sysdata
from hardware.link.serial import decode_header, encode_request
from tests.hardware.emulator_lab import Lab
from tests.hardware.test_emulator_server import Served, until
from tests.patience import PATIENCE_S

SOURCE = Path(board_agent.__file__)
PYTHON = os.environ.get("BOARD_PYTHON", sys.executable)
TOKEN = "0123456789abcdef" * 4
PATHS = st.text(st.characters(min_codepoint=33, max_codepoint=126, exclude_characters=">"), max_size=60).map(
    "/".__add__
)


# -- what runs on the board ------------------------------------------------------------------------------------------


def test_python_3_7_suffices() -> None:
    command = [str(Path(sys.executable).with_name("vermin")), "-t=3.7-", "--no-tips", "--violations", str(SOURCE)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stdout + done.stderr


def test_only_the_standard_library_is_imported() -> None:
    tree = ast.parse(SOURCE.read_text(), feature_version=(3, 7))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(str(node.module).split(".")[0])
    assert names <= set(sys.stdlib_module_names)


def test_the_service_file_starts_it_with_arguments_it_understands() -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(SOURCE.with_name("board_agent.service"))
    command = shlex.split(unit["Service"]["ExecStart"])
    assert command[1].endswith("board_agent.py")
    arguments = board_agent.parser().parse_args(command[2:])
    assert arguments.tty == "/dev/ttyGS0"
    other = re.search(r"^# ExecStart=(.+)$", SOURCE.with_name("board_agent.service").read_text(), re.MULTILINE)
    assert other
    arguments = board_agent.parser().parse_args(shlex.split(other[1])[2:])
    assert (arguments.http, arguments.token_file) == ("192.168.7.2:5001", "/root/board_agent/token")
    assert unit["Service"]["Restart"] == "always"


# -- frames ----------------------------------------------------------------------------------------------------------


def test_a_frame_by_hand() -> None:
    head = b">17 POST /SetOutputOn/Pump1/0/M0"
    line = head + b" " + format(zlib.crc32(head), "08x").encode()
    assert encode_request(17, "POST", "/SetOutputOn/Pump1/0/M0") == line + b"\n"
    assert decode_request(line) == (17, "POST", "/SetOutputOn/Pump1/0/M0")
    body = b"abc\n<1 200"
    head = b"<17 200 10"
    assert encode_reply(17, 200, body) == head + format(zlib.crc32(head + body), " 08x").encode() + b"\n" + body + b"\n"


@given(st.integers(1, 2**32 - 1), st.sampled_from(["GET", "POST", "RAW"]), PATHS, st.binary(max_size=20))
def test_frames_survive_the_way_and_noise_before_them(number: int, method: str, path: str, noise: bytes) -> None:
    line = encode_request(number, method, path)[:-1]
    assert decode_request(line) == (number, method, path)
    assert decode_request(noise.replace(b"\n", b"") + line) == (number, method, path)


@given(st.integers(0, 2**32 - 1), st.integers(0, 599), st.binary(max_size=60), st.binary(max_size=20))
def test_a_reply_of_the_agent_is_read_by_the_driver(number: int, status: int, body: bytes, noise: bytes) -> None:
    line, _, rest = encode_reply(number, status, body).partition(b"\n")
    header = decode_header(noise.replace(b"\n", b"") + line)
    assert header is not None
    assert (header.number, header.status, header.length) == (number, status, len(body))
    assert rest == body + b"\n"
    assert header.fits(body)
    assert not header.fits(body + b"x")


@settings(max_examples=500, deadline=None)
@given(st.integers(1, 2**32 - 1), PATHS, st.data())
def test_a_damaged_frame_is_never_taken_for_another(number: int, path: str, data: st.DataObject) -> None:
    line = bytearray(encode_request(number, "POST", path)[:-1])
    for _ in range(data.draw(st.integers(1, 3))):
        line[data.draw(st.integers(0, len(line) - 1))] = data.draw(st.integers(0, 255))
    assert decode_request(bytes(line)) in (None, (number, "POST", path))


@pytest.mark.parametrize(
    ("number", "method", "path"),
    [
        *((n, "GET", "/") for n in (0, 2**32, -1)),
        (1, "PUT", "/"),
        (1, "get", "/"),
        (1, "PING", "/getSysdata/"),
        *((1, "GET", path) for path in ("getSysdata", "/a b", "/a\tb", "/" + "x" * 600)),
    ],
)
def test_well_summed_nonsense_is_refused(number: int, method: str, path: str) -> None:
    assert decode_request(encode_request(number, method, path)[:-1]) is None


def make_token(folder: Path, text: str = TOKEN, mode: int = 0o600) -> Path:
    """A token's file as the installation makes it."""
    path = folder / "token"
    path.write_text(text + "\n")
    path.chmod(mode)
    return path


class Recorder(Device):
    """A device that remembers what it was asked."""

    def __init__(self) -> None:
        super().__init__("http://127.0.0.1:9", 1.0)
        self.asked: list[tuple[str, str]] = []

    def request(self, method: str, path: str, timeout_s: float | None = None) -> tuple[int, bytes, str]:
        self.asked.append((method, path))
        return 204, b"", "text/html"


@settings(max_examples=300, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=80), st.just(b">")), max_size=8))
def test_nothing_is_carried_out_on_garbage(lines: list[bytes]) -> None:
    device = Recorder()
    agent = BoardAgent(device, 10.0)
    for line in lines:
        reply = agent.answer_line(line)
        assert reply == b"" or reply.startswith(b"<0 20 ")
    assert device.asked == []
    assert agent.session is False  # garbage is no heartbeat


def test_a_repeated_request_is_answered_from_memory_until_hello() -> None:
    device = Recorder()
    agent = BoardAgent(device, 10.0)
    line = encode_request(5, "POST", "/SetOutputOn/Pump3/2/M0")[:-1]
    assert agent.answer_line(line) == agent.answer_line(line) == encode_reply(5, 204, b"")
    assert len(device.asked) == 1
    agent.answer_line(encode_request(5, "POST", "/SetOutputOn/Pump4/2/M0")[:-1])  # same ID, another request
    assert len(device.asked) == 2
    agent.answer_line(line)
    assert len(device.asked) == 3
    agent.answer_line(encode_request(9, "HELLO", "/")[:-1])
    agent.answer_line(line)
    assert len(device.asked) == 4


def ask(agent: BoardAgent, session: int, method: str, path: str = "/", count: int = 7) -> bytes:
    return agent.answer_line(encode_request(session << 16 | count, method, path)[:-1])


def test_a_second_client_on_the_line_is_refused_until_the_first_says_bye() -> None:
    device = Recorder()
    agent = BoardAgent(device, 10.0)
    assert ask(agent, 3, "HELLO").split(b" ")[1] == b"200"
    for method, path in (("POST", "/x"), ("GET", "/x"), *((verb, "/") for verb in ("HELLO", "PING", "BYE"))):
        head, _, body = ask(agent, 4, method, path).partition(b"\n")
        assert head.split(b" ")[1] == b"21", method
        assert b"another client is in charge (on the serial line" in body
        assert body.count(b"\n") == 1
    assert device.asked == []
    assert agent.armed
    beats = agent._beats
    assert ask(agent, 3, "PING").split(b" ")[1] == b"200"
    assert ask(agent, 3, "POST", "/x", 8).startswith(b"<196616 204 ")  # 3 * 65536 + 8
    assert agent._beats == beats + 2  # each keeps the pumps running
    assert ask(agent, 3, "BYE").split(b" ")[1] == b"200"
    assert ask(agent, 4, "POST", "/y").split(b" ")[1] == b"204"
    assert ask(agent, 3, "PING").split(b" ")[1] == b"21"
    assert device.asked == [("POST", "/x"), ("POST", "/y")]


def test_serial_line_and_http_at_once_are_two_clients_even_under_one_session() -> None:
    agent = BoardAgent(Recorder(), 10.0)
    assert agent.claim("HTTP", 3) == ""
    assert ask(agent, 3, "HELLO").split(b" ")[1] == b"21"
    assert agent.claim("HTTP", 4, arm=False).startswith("another client is in charge (on HTTP")
    assert agent.claim("HTTP", 3, arm=False) == ""
    assert ask(agent, 3, "HELLO").split(b" ")[1] == b"200"


class Strange(Recorder):
    """Its first state is nested deeper than any parser goes."""

    def request(self, method: str, path: str, timeout_s: float | None = None) -> tuple[int, bytes, str]:
        super().request(method, path)
        if path != "/getSysdata/":
            return 204, b"", "text/html"
        first = len(self.asked) == 1
        return 200, b"[" * 200_000 if first else b'{"presentDevices": {"M0": 0}}', "application/json"


def test_a_state_that_cannot_be_parsed_is_a_pass_that_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board_agent, "RETRY_S", (0.01, 0.01))
    device = Strange()
    agent = BoardAgent(device, 0.05)
    assert agent.claim("HTTP", 3) == ""
    agent.start()
    AgentLab.until(lambda: len(device.asked) == 2)
    AgentLab.until(lambda: agent.claim("HTTP", 4) == "")  # the silent client has lost its charge
    agent.stop()


def test_a_device_that_dribbles_holds_nobody_longer_than_the_time_out() -> None:
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = listener.accept()
        with connection, contextlib.suppress(OSError):
            connection.recv(4096)
            for byte in b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok":
                connection.sendall(bytes([byte]))
                time.sleep(0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    device = Device(f"http://127.0.0.1:{listener.getsockname()[1]}", 0.2)
    with pytest.raises(board_agent.Unanswered) as caught:
        device.request("GET", "/getSysdata/")
    assert caught.value.status == board_agent.NO_ANSWER
    thread.join()
    listener.close()


# -- reduction -------------------------------------------------------------------------------------------------------


def test_reduced_state_is_small_and_says_the_same() -> None:
    lab = Lab(blanked=True, od=0.4)
    lab.post("/Experiment/1/M0")
    lab.wait(230 * 60.07)
    lab.post("/changeDevice/M0")
    body = lab.device.handle("GET", "/getSysdata/")[1]
    full, small_body = json.loads(body), reduce_sysdata(body)
    small = json.loads(small_body)
    assert len(body) > 20_000
    assert len(small_body) < 1024
    assert small["_records"] == {"time": 138, "OD": 138, "ThermometerIR": 138}
    for name, entry in small.items():
        if name in ("_records", "Terminal"):
            continue
        if not isinstance(entry, dict):
            assert entry == full[name]
            continue
        for key, value in entry.items():
            assert value == (full[name][key][-1:] if key == "record" else full[name][key]), f"{name}.{key}"
    assert full["Terminal"]["text"].startswith(small["Terminal"]["text"])


JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from([*board_agent.KEPT, "record", "text", "ON", "x"]), inner, max_size=6),
    ),
    max_leaves=20,
)


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.binary(max_size=200), JSON.map(lambda x: json.dumps(x).encode())))
def test_reduction_of_anything_else_leaves_it_alone_or_reduces_it(body: bytes) -> None:
    reduced = reduce_sysdata(body)
    assert reduced == body or "_records" in json.loads(reduced)


# -- the process -----------------------------------------------------------------------------------------------------


class AgentLab:
    """Emulator, agent and a pty between the agent and this test; `link` is where the agent finds its line."""

    def __init__(self, folder: Path, *arguments: str, tty_line: bool = True, speed: int = 60) -> None:
        self.emulator = Served("--reactors", "M0,M1", "--speed", str(speed))
        self.link = folder / "ttyGS0"
        self.master = -1
        self.number = 1000
        line = ["--tty", str(self.link)] if tty_line else []
        if tty_line:
            self.plug()
        command = [PYTHON, str(SOURCE), *line, "--url", f"http://127.0.0.1:{self.emulator.port}", *arguments]
        self.log = folder / "log"
        with self.log.open("w") as log:
            self.agent = subprocess.Popen(command, stderr=log, cwd=folder)
        words = ["ready", *([" open\n"] if tty_line else [])]
        self.until(lambda: all(word in self.log.read_text() for word in words))

    def plug(self) -> None:
        """A new line under the same name."""
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        self.slave = slave  # kept: a pty without any open slave reads as hung up

    def unplug(self) -> None:
        os.close(self.master)
        os.close(self.slave)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def receive(self, timeout: float = 20.0) -> tuple[int, int, bytes]:
        """(ID, status, body) of the next reply frame."""
        data, deadline = b"", time.monotonic() + timeout
        while True:
            head, newline, rest = data.partition(b"\n")
            if newline:
                assert head.startswith(b"<"), head
                number, status, length, crc = head[1:].split(b" ")
                if len(rest) > int(length):
                    body = rest[: int(length)]
                    assert rest[int(length) :] == b"\n"
                    assert int(crc, 16) == zlib.crc32(b"<%b %b %b" % (number, status, length) + body)
                    return int(number), int(status), body
            assert select.select([self.master], [], [], max(deadline - time.monotonic(), 0.0))[0], f"only {data!r}"
            data += os.read(self.master, 65536)

    def ask(self, method: str, path: str, timeout: float = 5.0) -> tuple[int, bytes]:
        """Status and body of a request over the line."""
        self.number += 1
        self.send(encode_request(self.number, method, path))
        number, status, body = self.receive(timeout)
        assert number == self.number
        return status, body

    def pump(self, pump: str, reactor: str, target: float = 0.5) -> None:
        assert self.ask("POST", f"/SetOutputTarget/{pump}/{reactor}/{target}")[0] == 204
        assert self.ask("POST", f"/SetOutputOn/{pump}/1/{reactor}")[0] == 204

    def motors(self) -> set[str]:
        """What really turns, e.g. {"M0/Pump1"}."""
        truth = self.emulator.truth()
        return {f"{m}/{pump}" for m in ("M0", "M1") for pump, on in truth[m]["motors"].items() if on}

    until = staticmethod(until)

    def end(self) -> None:
        if self.agent.poll() is None:
            self.agent.send_signal(signal.SIGTERM)
            assert self.agent.wait(timeout=30) == 0
        self.emulator.end()
        assert "Traceback" not in self.log.read_text()
        with contextlib.suppress(OSError):
            self.unplug()


@pytest.fixture(scope="module")
def _lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AgentLab]:
    one = AgentLab(tmp_path_factory.mktemp("agent"), "--deadman", "60", "--http-timeout", "1")
    yield one
    one.end()


@pytest.fixture
def lab(_lab: AgentLab) -> AgentLab:
    """One for all tests that leave it alive; it serves M0."""
    assert _lab.ask("POST", "/changeDevice/M0")[0] == 204
    return _lab


def test_conversation(lab: AgentLab) -> None:
    status, body = lab.ask("HELLO", "/")
    hello = json.loads(body)
    assert status == 200
    assert (hello["agent"], hello["protocol"], hello["deadman_s"], hello["trips"]) == ("board_agent", 2, 60.0, 0)
    assert lab.ask("PING", "/")[0] == 200
    assert lab.ask("POST", "/changeDevice/M1") == (204, b"")
    status, body = lab.ask("GET", "/getSysdata/")
    assert (status, json.loads(body)["UIDevice"]) == (200, "M1")
    assert len(body) < 1024
    status, whole = lab.ask("RAW", "/getSysdata/")
    assert "AS7341" in json.loads(whole)
    assert len(whole) > 4500
    assert lab.ask("POST", "/changeDevice/M9")[0] == 500
    assert lab.ask("POST", "/nonsense")[0] == 404
    assert lab.ask("GET", "/getSysdata")[0] == 308


def test_resynchronises_after_garbage_and_executes_nothing_of_it(lab: AgentLab) -> None:
    good = encode_request(7, "POST", "/SetOutputTarget/Stir/M0/0.7")
    bad = good[:-4] + b"0" + good[-3:] if good[-4:-3] != b"0" else good[:-4] + b"1" + good[-3:]
    lab.send(b"debian login: \r\nlast message repeated\n\x00\xff\xfe")
    lab.send(bad.replace(b"0.7", b"0.9"))
    assert lab.receive()[:2] == (0, 20)
    lab.send(b"x" * 5000 + b"\n" + good)
    assert lab.receive()[:2] == (7, 204)
    lab.send(good[:10])
    time.sleep(0.2)
    lab.send(good[10:])
    assert lab.receive()[:2] == (7, 204)
    assert json.loads(lab.ask("GET", "/getSysdata/")[1])["Stir"]["target"] == 0.7


@pytest.mark.slow
def test_what_became_of_a_request_without_answer(lab: AgentLab) -> None:
    lab.emulator.fault("reset_after/all/1")
    status, body = lab.ask("POST", "/SetOutputTarget/Stir/M0/0.7")
    assert status == 11
    assert b"/SetOutputTarget/Stir" in body
    lab.emulator.fault("truncated/all/1")
    assert lab.ask("RAW", "/getSysdata/")[0] == 11
    lab.emulator.fault("lost_reply/all/1")
    assert lab.ask("POST", "/changeDevice/M1", PATIENCE_S)[0] == 11  # after its own time-out
    lab.emulator.fault("malformed/all/1")
    status, body = lab.ask("GET", "/getSysdata/")
    assert status == 200  # passed on as it is: judging is the client's task
    with pytest.raises(json.JSONDecodeError):
        json.loads(body)
    lab.emulator.fault("crash")
    until(lambda: lab.emulator.server._web is None)
    assert lab.ask("GET", "/getSysdata/")[0] == 10
    lab.emulator.fault("restart")
    until(lambda: lab.emulator.server._web is not None)


@pytest.mark.slow
def test_line_pulled_and_plugged_again(lab: AgentLab) -> None:
    assert lab.ask("PING", "/")[0] == 200
    for _ in range(2):
        lab.unplug()
        time.sleep(0.3)
        seen = lab.log.read_text().count(" open\n")
        lab.plug()
        lab.until(lambda n=seen: lab.log.read_text().count(" open\n") > n)  # type: ignore[misc]
        assert lab.ask("HELLO", "/")[0] == 200
        assert json.loads(lab.ask("GET", "/getSysdata/")[1])["UIDevice"] == "M0"


def test_a_line_nobody_reads_does_not_stop_the_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board_agent, "WRITE_TIMEOUT_S", 0.2)
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    port = board_agent.SerialPort(os.ttyname(slave), 115200, BoardAgent(Recorder(), 10.0))
    for byte in (b"x", b"y"):
        port._write(slave, 20_000 * byte)  # comes back
    os.close(master)
    os.close(slave)


# -- dead man --------------------------------------------------------------------------------------------------------


@pytest.fixture
def short(tmp_path: Path) -> Iterator[AgentLab]:
    one = AgentLab(tmp_path, "--deadman", "1", "--http-timeout", "2")
    yield one
    one.end()


@pytest.mark.slow
def test_regulating_reactor_is_left_alone_the_other_is_not(short: AgentLab) -> None:
    short.ask("POST", "/Experiment/1/M0")
    short.ask("POST", "/SetOutputTarget/OD/M0/0.1")
    short.ask("POST", "/SetOutputOn/OD/1/M0")
    short.pump("Pump3", "M0", 1.0)
    short.pump("Pump1", "M1", 1.0)
    short.until(lambda: "M1/Pump1" not in short.motors() and "verified off" in short.log.read_text())
    assert "M0/Pump3" in short.motors()
    assert "M0: pumps left on" in short.log.read_text()
    hello = json.loads(short.ask("HELLO", "/")[1])
    assert hello["trips"] == 1
    assert hello["silent_s"] > 1.0
    assert hello["last_trip"].startswith("20")
    assert {m: list(pumps) for m, pumps in hello["switched_off"].items()} == {"M1": ["Pump1"]}
    assert 0.0 <= hello["switched_off"]["M1"]["Pump1"] < 10.0


@pytest.mark.slow
def test_dead_bus_is_unmasked_and_ends_with_everything_off(short: AgentLab) -> None:
    short.emulator.fault("bus_stuck_when_pumping")
    short.pump("Pump1", "M0", 0.9)
    short.until(lambda: short.motors() == {"M0/Pump1"})
    short.until(lambda: not short.motors())
    truth = short.emulator.truth()
    assert truth["restarts"] == 1
    short.until(lambda: "pumps verified off" in short.log.read_text(), timeout=12.0)


def test_a_stopped_agent_leaves_no_pump_running(short: AgentLab) -> None:
    short.pump("Pump1", "M1", 1.0)
    short.until(lambda: short.motors() == {"M1/Pump1"})
    short.agent.send_signal(signal.SIGTERM)
    assert short.agent.wait(timeout=5) == 0
    assert short.motors() == set()


# -- start -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "--tty nor --http"), (["--tty", "x", "--deadman", "0"], "deadman = 0"),
        (["--tty", "x", "--deadman", "nan"], "deadman = nan"),
        (["--tty", "x", "--http-timeout", "-1"], "http-timeout = -1"),
        (["--tty", "x", "--url", "https://board"], "https"),
        (["--tty", "x", "--url", "http://board/path"], "/path"),
        (["--tty", "x", "--url", "http://board:port"], "port"),
        (["--tty", "x", "--baud", "12345"], "12345"), (["--http", "5001", "--token-file", "{token}"], "http = 5001"),
        (["--http", "203.0.113.1:5001", "--token-file", "{token}"], ""),
        (["--http", "127.0.0.1:99999", "--token-file", "{token}"], ""),
        (["--http", "127.0.0.1:0"], "token-file"), (["--http", "127.0.0.1:0", "--token-file", "{empty}"], "32 to 256"),
        (["--http", "127.0.0.1:0", "--token-file", "{short}"], "32 to 256"),
        (["--http", "127.0.0.1:0", "--token-file", "{two}"], "32 to 256"),
        (["--http", "127.0.0.1:0", "--token-file", "{all}"], "chmod 600"),
        (["--http", "127.0.0.1:0", "--token-file", "{group}"], "chmod 600"),
    ],
)  # fmt: skip
def test_bad_arguments_give_one_line_without_the_token(
    arguments: list[str], named: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    files = {"token": (TOKEN, 0o600), "empty": ("", 0o600), "short": ("secret", 0o600),
             "two": (f"{TOKEN} {TOKEN}", 0o600), "all": (TOKEN, 0o644), "group": (TOKEN, 0o620)}  # fmt: skip
    paths = {name: tmp_path / name for name in files}
    for name, path in paths.items():
        path.mkdir()
        paths[name] = make_token(path, *files[name])
    assert board_agent.main([word.format(**paths) for word in arguments]) == 2
    error = capfd.readouterr().err
    assert error.startswith("board_agent: ")
    assert error.count("\n") == 1
    assert named in error
    assert "secret" not in error
    assert TOKEN not in error
