"""Routes, status codes, clamps and selection as docs/device.md states them, and the emulator as a process."""

import json
import math
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

import numpy as np
import pytest

from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice
from hardware.emulator.faults import inject
from hardware.emulator.server import EmulatorServer, build, main, parser
from hardware.rig import __main__ as rig
from tests.hardware.emulator_lab import Lab, running
from tests.patience import PATIENCE_S

SAMPLE = Path(__file__).parents[2].parent / "shared" / "samples" / "chibio_sysdata.json"


ANSWERS = {  # by method and status
    ("GET", 200): "/ /getSysdata/ /getSysdata/?t=1",
    ("POST", 204): """
        /changeDevice/M0 /changeDevice/M5 /scanDevices/all /scanDevices/M5 /SetOutputTarget/Pump1/M0/0.02
        /SetOutputTarget/Pump1/0/0.02 /SetOutputOn/Pump1/0/M0 /SetOutputOn/Zigzag/1/M0 /Direction/Pump1/M0
        /MeasureOD/M0 /CalibrateOD/OD0/M0/14000/0 /CalibrateOD/OD/M0/14000/0 /MeasureTemp/IR/M0 /MeasureFP/M0
        /Experiment/0/M0 /ExperimentReset /ClearTerminal/M0
        /SetFPMeasurement/FP1/LEDB/CLEAR/nm510/nm550/x10 /SetOutputTarget/Pump1/M0/0%2e02""",
    ("GET", 308): "/getSysdata",
    ("POST", 308): "//changeDevice//M0",
    ("POST", 404): """
        /changeDevice/M0/ /SetOutputTarget/Pump1/M0 /SetOutputTarget/Pump1/M0/1/2 //changeDevice//M0//x
        /NoSuchRoute""",
    ("GET", 405): "/changeDevice/M0",
    ("POST", 405): "/getSysdata/",
    ("PUT", 405): "/getSysdata/",
    ("POST", 500): """
        /changeDevice/M9 /changeDevice/0 /SetOutputTarget/Pump1/0.02/M0 /SetOutputTarget/Pump1/M0/abc
        /SetOutputTarget/Pump1/M8/0.02 /SetOutputTarget/Pump1/m0/0.02 /SetOutputTarget/Pump9/M0/0.02
        /SetOutputTarget/Chemostat/M0/0.02 /SetOutputTarget/GrowthRate/M0/1 /SetOutputTarget/Zigzag/M0/1
        /SetOutputTarget/OD0/M0/14000 /SetOutputOn/Pump1/0.5/M0 /SetOutputOn/Volume/0/M0
        /SetOutputOn/Chemostat/0/M0 /SetOutputOn/OD0/0/M0 /SetOutputOn/Pump9/0/M0 /CalibrateOD/Blank/M0/14000/0
        /MeasureTemp/Culture/M0""",
}


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [(method, path, status) for (method, status), paths in ANSWERS.items() for path in paths.split()],
)
def test_status_codes(method: str, path: str, status: int) -> None:
    lab = Lab()
    got, body = lab.device.handle(method, path)
    assert got == status
    assert lab.device.supervisor.alive
    assert body == b"" if status == 204 else body
    if status == 500:
        assert b"html" in body  # no JSON errors exist
        assert lab.state()["UIDevice"] == "M0"  # and the software survives


def test_the_state_has_every_field_of_a_recorded_answer_with_its_type_and_sorted_keys() -> None:
    if not SAMPLE.exists():
        pytest.skip(f"no recorded answer at {SAMPLE}")
    lab = running(wait=9 * 60.07 + 20.0)
    lab.post("/changeDevice/M0")
    body = lab.device.handle("GET", "/getSysdata/")[1]
    recorded, mine = json.loads(SAMPLE.read_text()), json.loads(body)

    def compare(want: dict, got: dict, where: str) -> None:  # type: ignore[type-arg]
        assert sorted(want) == sorted(got), where
        for key, value in want.items():
            if isinstance(value, dict):
                compare(value, got[key], f"{where}.{key}")
            elif isinstance(value, (int, float)):
                assert isinstance(got[key], (int, float)), f"{where}.{key}"
            else:
                assert type(got[key]) is type(value), f"{where}.{key}"

    compare(recorded, mine, "sysData")
    assert list(mine) == sorted(mine)
    assert len(mine["OD"]["record"]) == len(mine["time"]["record"]) == 10


def test_a_target_that_is_no_number_passes_and_comes_out_as_a_bare_token() -> None:
    lab = Lab()
    assert lab.post("/SetOutputTarget/Pump3/M0/nan") == 204
    body = lab.device.handle("GET", "/getSysdata/")[1]
    assert b":NaN" in body
    assert math.isnan(json.loads(body)["Pump3"]["target"])


BOTH_ON = [(f"SetOutput{it}", {}) for p in "12" for it in (f"Target/Pump{p}/M0/0.1", f"On/Pump{p}/1/M0")]
FORCED = ((1, 1), (1, 1), (0, 0), (0, 0), (2, 1), (7, 0), (-1, 1))
CLAMPED = {"5": 1.0, "-5": -1.0, "-0.2": -0.2, "inf": 1.0, "-inf": -1.0}
SHOWN: dict[str, list[tuple[str, dict[str, float]]]] = {  # requests one after another, and what the device shows then
    "targets are clamped": [(f"SetOutputTarget/Pump1/M0/{v}", {"Pump1.target": kept}) for v, kept in CLAMPED.items()],
    "so is a temperature": [("SetOutputTarget/Thermostat/M0/80", {"Thermostat.target": 50.0})],
    "1 is on, 0 is off, and anything else toggles": [
        ("SetOutputTarget/Pump1/M0/0.1", {}),
        *((f"SetOutputOn/Pump1/{force}/M0", {"Pump1.ON": on}) for force, on in FORCED),
    ],
    "target 0 refuses to go on, and stays off when a target comes": [
        ("SetOutputOn/Pump1/1/M0", {"Pump1.ON": 0}), ("SetOutputTarget/Pump1/M0/0.1", {}),
        ("SetOutputOn/Pump1/1/M0", {"Pump1.ON": 1}), ("SetOutputTarget/Pump1/M0/0", {"Pump1.ON": 0}),
        ("SetOutputTarget/Pump1/M0/0.1", {"Pump1.ON": 0}),
    ],
    "switching regulation either way turns both pumps off": [
        *BOTH_ON, ("SetOutputOn/OD/1/M0", {"OD.ON": 1, "Pump1.ON": 0, "Pump2.ON": 0}),
        *BOTH_ON, ("SetOutputOn/OD/0/M0", {"OD.ON": 0, "Pump1.ON": 0, "Pump2.ON": 0}),
    ],
    "direction negates the target, and under regulation the direction, too": [
        ("SetOutputTarget/Pump1/M0/0.1", {}), ("Direction/Pump1/M0", {"Pump1.target": -0.1, "Pump1.direction": 1.0}),
        ("SetOutputOn/OD/1/M0", {}), ("Direction/Pump1/M0", {"Pump1.target": 0.1, "Pump1.direction": -1.0}),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", SHOWN)
def test_what_the_device_shows_after_each_request(name: str) -> None:
    """And no motor turns in the end that is not shown as on."""
    lab = Lab()
    for path, shown in SHOWN[name]:
        assert lab.post(f"/{path}") == 204
        state = lab.state()
        assert {key: state[key.partition(".")[0]][key.partition(".")[2]] for key in shown} == shown
    lab.wait(100.0)
    motors = lab.device.truth("M0")["motors"]
    assert all(lab.state()[pump]["ON"] for pump, turns in motors.items() if turns)


@pytest.mark.parametrize(
    ("path", "item", "key"),
    [
        ("SetOutputTarget/OD0/M0/{}", "OD0", "target"),
        *((f"SetOutputOn/{m}/{{}}/M0", m, "ON") for m in ("Chemostat", "Custom", "Volume", "OD0", "Experiment")),
    ],
)
def test_what_drives_nothing_is_set_and_then_answers_500(path: str, item: str, key: str) -> None:
    lab = Lab()
    for value in (0, 1):
        assert lab.post(f"/{path.format(value)}") == 500
        assert lab.state()[item][key] == value
    lab.wait(200.0)
    assert lab.state()["Experiment"]["cycles"] == 0  # no thread was started


def test_only_the_selected_reactor_is_served_and_an_absent_one_is_ignored() -> None:
    lab = Lab()
    lab.post("/SetOutputTarget/Stir/M1/0.7")
    assert lab.state("M1")["Stir"]["target"] == 0.7
    assert lab.post("/changeDevice/M6") == 204
    data = json.loads(lab.device.handle("GET", "/getSysdata/")[1])
    assert data["UIDevice"] == "M1"
    assert data["presentDevices"] == {"M0": 1, "M1": 1} | {f"M{k}": 0 for k in range(2, 8)}
    lab.post("/SetOutputTarget/Stir/0/0.6")  # 0 = the one selected
    assert lab.state("M1")["Stir"]["target"] == 0.6
    assert lab.state("M0")["Stir"]["target"] == 0.5


@pytest.mark.parametrize(
    ("path", "seconds"),
    [
        ("/MeasureOD/M0", 0.97),
        ("/SetOutputOn/Pump1/0/M0", 0.0),
        *((f"/SetOutputTarget/Stir/M0/{k}", s) for k, s in ((0.4, 1.5), (0.5, 2.25), (0.8, 2.25), (0.9, 3.0))),
    ],
)
def test_blocking_times(path: str, seconds: float) -> None:
    """The stirrer blocks by its target, where it is switched on and where the target of one that is on is rewritten."""
    lab = Lab()

    def taken(path: str) -> float:
        before = lab.clock.now()
        lab.post(path)
        return lab.clock.now() - before

    stirs = "Stir" in path
    assert taken(path) == pytest.approx(0.0 if stirs else seconds, abs=0.02)
    if stirs:
        assert [taken("/SetOutputOn/Stir/1/M0"), taken(path)] == pytest.approx([seconds] * 2, abs=0.02)
        assert lab.device.vials["M0"].stir == float(path.rpartition("/")[2])


def test_reset_wipes_the_selected_reactor_only() -> None:
    lab = Lab()
    for m in ("M0", "M1"):
        lab.post(f"/CalibrateOD/OD0/{m}/14000/0")
        lab.post(f"/SetOutputTarget/Stir/{m}/0.7")
    lab.post("/changeDevice/M1")
    before = lab.clock.now()
    assert lab.post("/ExperimentReset") == 204
    assert 1.0 <= lab.clock.now() - before <= 2.0
    assert (lab.state("M1")["OD0"]["target"], lab.state("M1")["Stir"]["target"]) == (65000.0, 0.5)
    assert (lab.state("M0")["OD0"]["target"], lab.state("M0")["Stir"]["target"]) == (14000.0, 0.7)


def test_forks() -> None:
    lab = Lab()
    inject(lab.device, "require_requested_with")
    assert lab.device.handle("POST", "/changeDevice/M0")[0] == 403
    assert lab.device.handle("GET", "/getSysdata/")[0] == 200
    assert lab.device.handle("POST", "/changeDevice/M0", {"x-requested-with": "XMLHttpRequest"})[0] == 204
    inject(lab.device, "terminal_as_list")
    inject(lab.device, "extra_fields")
    data = json.loads(lab.device.handle("GET", "/getSysdata/")[1])
    assert isinstance(data["Terminal"]["text"], list)
    assert "Pump5" in data


def test_a_newer_app_names_the_reactor_in_its_log() -> None:
    lab = running(wait=1.0)
    lab.post("/Experiment/0/M0")
    lab.wait(80.0)
    plain = lab.state()["Terminal"]["text"]
    inject(lab.device, "terminal_named")
    state = lab.state()
    lines, where = state["Terminal"]["text"].split("</br>"), f"on M0 ({state['DeviceID']}) "
    assert [line.replace(where, "") for line in lines] == plain.split("</br>")
    assert [line.split(" - ")[1] for line in lines[:4]] == [
        f"Experiment {where}Stopped",
        f"Experiment {where}Stopping at end of cycle",
        f"Cycle 1 {where}Started",
        f"Experiment {where}Started",
    ]


def test_same_seed_same_readings_another_seed_others() -> None:
    def records(seed: int, reactors: tuple[str, ...]) -> list[float]:
        device = ChiBioDevice(reactors, VirtualClock(), np.random.default_rng(seed), blanked=True)
        device.handle("POST", "/Experiment/1/M0")
        device.run_until(600.0)
        return list(device.apps["M0"].data["OD"]["record"])

    assert records(1, ("M0",)) == records(1, ("M0",))
    assert records(1, ("M0",)) != records(2, ("M0",))


def test_thousands_of_random_requests_leave_a_device_that_answers() -> None:
    rng = np.random.default_rng(5)
    verbs = {"SetOutputTarget": 3, "SetOutputOn": 3, "Direction": 2, "MeasureOD": 1, "CalibrateOD": 4, "Experiment": 2}
    verbs |= {"changeDevice": 1, "MeasureTemp": 2, "ClearTerminal": 1, "SetFPMeasurement": 6}
    verbs |= {"getSysdata": 0, "getSysdata/": 0, "ExperimentReset": 0}
    arguments = ["Pump1", "Pump2", "Stir", "OD", "OD0", "Thermostat", "Heat", "Zigzag", "Light", "FP1", "LASER650"]
    arguments += ["M0", "M1", "0", "1", "2", "-1", "0.5", "nan", "inf", "1e400", "", "%00", "x", "IR", "Internal", "é"]
    lab = running(blanked=True, od=0.5)
    seen = set()
    for _ in range(1500):
        verb = str(rng.choice(list(verbs)))
        count = verbs[verb] if rng.random() < 0.9 else int(rng.integers(0, 5))
        path = "/".join(["", verb, *rng.choice(arguments, count)])
        reads = verb.startswith("get") == (rng.random() < 0.9)
        status, _ = lab.device.handle("GET" if reads else "POST", path)
        seen.add(status)
        lab.wait(float(rng.exponential(2.0)))
        assert lab.device.supervisor.alive, lab.device.computer.errors[-1]
    assert seen == {200, 204, 308, 404, 405, 500}
    for reactor in ("M0", "M1"):
        assert 0.0 < lab.device.truth(reactor)["volume_ml"] <= 30.0
        assert math.isfinite(lab.device.truth(reactor)["od"])
    assert lab.state()["UIDevice"] == "M0"


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
        (["--pump-start", "0.7", "0.2"], "pump_start_s = [0.7, 0.2]"), (["--host", "203.0.113.1"], "203.0.113.1:0"),
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
