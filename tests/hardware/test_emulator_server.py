"""The emulator as a separate process: real sockets, scaled real time, faults, clean end."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from http.client import HTTPConnection, IncompleteRead
from pathlib import Path

import pytest

from hardware.emulator.server import EmulatorServer, build, main, parser
from hardware.rig import __main__ as rig
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]


def until(condition: Callable[[], object], timeout: float = PATIENCE_S) -> bool:
    """Wait until `condition()` holds, as it must."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return True


class Served:
    """The emulator in a thread of this process, which starts in no time."""

    def __init__(self, *arguments: str) -> None:
        self.server = EmulatorServer(build(parser().parse_args(arguments)), "127.0.0.1", 0, 0)
        self.port, self.control_port = self.server.port, self.server.control_port
        self._thread = threading.Thread(target=self.server.run)
        self._thread.start()

    def end(self) -> None:
        self.server.stop()
        self._thread.join()

    def ask(self, method: str, path: str, port: int | None = None, timeout: float = 5.0) -> tuple[int, bytes]:
        connection = HTTPConnection("127.0.0.1", port or self.port, timeout=timeout)
        try:
            connection.request(method, path)
            response = connection.getresponse()
            return response.status, response.read()
        finally:
            connection.close()

    def fault(self, text: str) -> None:
        assert self.ask("POST", f"/_emulator/fault/{text}", self.control_port)[0] == 204

    def truth(self) -> dict:  # type: ignore[type-arg]
        return dict(json.loads(self.ask("GET", "/_emulator/truth", self.control_port)[1]))


@pytest.fixture
def emulator(request: pytest.FixtureRequest) -> Iterator[Served]:
    served = Served("--reactors", "M0,M1", "--speed", getattr(request, "param", "60"))
    yield served
    served.end()


@pytest.mark.parametrize("emulator", ["600"], indirect=True)
def test_an_experiment_over_http(emulator: Served) -> None:
    assert emulator.ask("POST", "/Experiment/1/M0") == (204, b"")
    until(lambda: json.loads(emulator.ask("GET", "/getSysdata/")[1])["Experiment"]["cycles"] >= 4)
    state = json.loads(emulator.ask("GET", "/getSysdata/")[1])
    assert state["OD"]["record"][0] == pytest.approx(0.3, abs=0.05)  # started with a blank
    stored = json.loads(emulator.ask("GET", "/_emulator/samples/M0", emulator.control_port)[1])
    assert [s["sample_s"] for s in stored[: len(state["time"]["record"])]] == state["time"]["record"]
    assert stored[0]["stored_s"] - stored[0]["sample_s"] > 10.0
    assert [b - a for a, b in zip(state["time"]["record"], state["time"]["record"][1:], strict=False)] == pytest.approx(
        [60.07] * (len(state["time"]["record"]) - 1), abs=1.0
    )
    with urllib.request.urlopen(f"http://127.0.0.1:{emulator.port}/getSysdata", timeout=5) as answer:  # follows 308
        assert json.load(answer)["UIDevice"] == "M0"
    assert emulator.ask("GET", "/changeDevice/M1")[0] == 405
    assert emulator.ask("POST", "/changeDevice/M11")[0] == 500


def test_requests_are_served_one_at_a_time(emulator: Served) -> None:
    """Four at once of 3 device seconds each: k of them take at least 3 k."""
    emulator.ask("POST", "/SetOutputTarget/Stir/M0/0.9")
    spans: list[float] = []

    def kick() -> None:
        emulator.ask("POST", "/SetOutputOn/Stir/1/M0", timeout=PATIENCE_S)
        spans.append(time.monotonic() - began)

    threads = [threading.Thread(target=kick) for _ in range(4)]
    began = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, span in enumerate(sorted(spans), start=1):
        assert span >= k * 3.0 / 60.0 - 0.01


def test_socket_faults(emulator: Served) -> None:
    emulator.fault("reset_after/all/1")
    with pytest.raises(ConnectionResetError):
        emulator.ask("POST", "/SetOutputTarget/Stir/M0/0.7")
    emulator.fault("lost_reply/all/1")
    with pytest.raises(TimeoutError):
        emulator.ask("POST", "/SetOutputTarget/Stir/M1/0.7", timeout=0.5)
    emulator.fault("truncated/all/1")
    with pytest.raises(IncompleteRead):
        emulator.ask("GET", "/getSysdata/")
    emulator.fault("malformed")
    with pytest.raises(json.JSONDecodeError):
        json.loads(emulator.ask("GET", "/getSysdata/")[1])
    for reactor in ("M0", "M1"):
        emulator.ask("POST", f"/changeDevice/{reactor}")
        assert json.loads(emulator.ask("GET", "/getSysdata/")[1])["Stir"]["target"] == 0.7


def test_death_refuses_connections_until_somebody_restarts_it(emulator: Served) -> None:
    with pytest.raises(ConnectionError):
        emulator.ask("POST", "/MeasureOD/M7")
    until(lambda: not emulator.truth()["alive"])
    until(lambda: emulator.server._web is None)
    with pytest.raises(ConnectionRefusedError):
        emulator.ask("GET", "/getSysdata/")
    until(lambda: not emulator.truth()["M0"]["powered"])
    emulator.fault("restart")
    until(lambda: emulator.server._web is not None)
    assert json.loads(emulator.ask("GET", "/getSysdata/")[1])["OD0"]["target"] == 65000.0


def test_truth_doses_and_list_of_faults(emulator: Served) -> None:
    emulator.ask("POST", "/SetOutputTarget/Pump1/M1/0.02")
    emulator.ask("POST", "/SetOutputOn/Pump1/1/M1")

    def told() -> list[dict[str, float]]:
        return list(json.loads(emulator.ask("GET", "/_emulator/doses/M1", emulator.control_port)[1]))

    until(told)
    emulator.ask("POST", "/SetOutputOn/Pump1/0/M1")
    doses = told()
    assert [d["pump"] for d in doses] == ["Pump1"]
    assert doses[0]["seconds"] == pytest.approx(1.26, abs=0.25)
    assert emulator.truth()["M1"]["feed_ml"] == pytest.approx(doses[0]["feed_ml"])
    assert "od_frozen" in json.loads(emulator.ask("GET", "/_emulator/faults")[1])
    status, text = emulator.ask("POST", "/_emulator/fault/nonsense")
    assert status == 400
    assert text.startswith(b"fault = nonsense: allowed ")
    assert emulator.ask("POST", "/_emulator/fault/od_offset/M0/much")[0] == 400
    assert emulator.ask("GET", "/_emulator/nonsense")[0] == 404


def test_garbage_on_the_socket_does_not_end_it(emulator: Served) -> None:
    wrong = b"POST / HTTP/1.1\r\nContent-Length: x\r\n\r\n"
    for data in (b"", b"\x00\xff\xfe\n\n", b"GET\r\n\r\n", wrong, b"A" * 70000):
        with socket.create_connection(("127.0.0.1", emulator.port), timeout=2) as connection:
            connection.sendall(data)
    assert emulator.ask("GET", "/getSysdata/")[0] == 200


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly_and_it_says_one_line_when_it_is_ready(number: int) -> None:
    command = [sys.executable, "-m", "hardware.emulator", "--port", "0"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    assert re.search(r"http://127.0.0.1:\d+ .*control http://127.0.0.1:\d+", process.stdout.readline())
    process.send_signal(number)
    said, _ = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said) == (0, "")


@pytest.mark.slow
def test_it_ends_with_the_process_that_started_it_however_that_ends() -> None:
    """A client that is killed by -9 leaves no device behind."""
    client = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import time; from hardware.emulator.process import EmulatorProcess; d = EmulatorProcess([]);"
            "print(d.pid, flush=True); time.sleep(600)",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert client.stdout is not None
    device = int(client.stdout.readline())
    os.kill(device, 0)
    client.kill()
    client.wait()
    client.stdout.close()
    deadline = time.monotonic() + 30.0
    while Path(f"/proc/{device}").exists() and "\nState:\tZ" not in Path(f"/proc/{device}/status").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--reactors", "M9"], "M9"), (["--reactors", ""], "reactors"), (["--reactors", "m0"], "m0"),
        (["--reactors", "M0,M0"], "M0"), (["--speed", "0"], "speed = 0"),
        (["--speed", "nan"], "speed = nan"), (["--od", "0.3,0.4", "--reactors", "M0"], "od"),
        (["--od", "-1"], "-1"),
        (["--od", "much"], "od = much"), (["--port", "70000"], "port = 70000"),
        (["--pump-start", "0.7", "0.2"], "pump_start_high_s = 0.2"), (["--host", "203.0.113.1"], "203.0.113.1:0"),
    ],
)  # fmt: skip
def test_bad_arguments_give_one_line(arguments: list[str], named: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["--port", "0", *arguments]) == 2
    said, error = capfd.readouterr()
    assert said.startswith("emulator: ")
    assert said.count("\n") == 1
    assert named in said
    assert error == ""


def test_a_port_in_use_gives_one_line(emulator: Served, capfd: pytest.CaptureFixture[str]) -> None:
    for port in (["--port", str(emulator.port)], ["--port", "0", "--control-port", str(emulator.control_port)]):
        assert main(port) == 2
        said, error = capfd.readouterr()
        assert (error, said.count("\n")) == ("", 1)
        assert port[-1] in said


@pytest.mark.parametrize("program", ["emulator", "rig"])
def test_a_wrong_word_is_two_lines_help_says_all(
    program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(word: str) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", [program, word])
        with pytest.raises(SystemExit):
            {"emulator": main, "rig": rig.main}[program]()
        return capsys.readouterr()

    usage, error = said("--reactor-speed=x")[1].splitlines()
    assert usage.endswith(f"python -m hardware.{program} --help says all")
    assert error.endswith("--reactor-speed=x")
    assert "--seed" in said("--help")[0]
