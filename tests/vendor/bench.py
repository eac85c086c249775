"""The counterparts as processes: the vendor's app on the stand-ins, or the project's emulator; the agent; a client.

Both benches have the same vials: growth .018, .03 and .042 1/min, feed pumps of 1.0, .7 and 1.35 mL/s, and are asked by
the same words. Times are device seconds since the bench began, ten in a real second.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

ROOT = Path(__file__).resolve().parents[2]
STANDINS = Path(os.environ.get("CHIBIO_STANDINS") or ROOT.parent / "shared" / "chibio_env")
SPEED = 10.0
VIALS = {
    f"M{k}": {"mu": (0.018, 0.03, 0.042)[k % 3], "feed": (1.0, 0.7, 1.35)[k % 3], "waste": (1.0, 1.1, 1.4)[k % 3]}
    for k in range(8)
}
START_OD = 0.45
WEIGHED = {"feed": ("Pump1", (0.005, 0.01, 0.02)), "waste": ("Pump2", (0.1, 0.25))}


class Run(NamedTuple):
    """One run of a motor: begin, length in device s, what it moved in mL; `forward` false runs back."""

    pump: str
    start_s: float
    seconds: float
    ml: float


def missing() -> str | None:
    """Why the vendor's app cannot run here, in one line; None if it can."""
    if not os.environ.get("CHIBIO_APP"):
        return "CHIBIO_APP is not set: the folder of the vendor's app.py (HarrisonSteel/ChiBio)"
    if not (Path(os.environ["CHIBIO_APP"]) / "app.py").is_file():
        return f"CHIBIO_APP={os.environ['CHIBIO_APP']}: no app.py there"
    if not (STANDINS / "fakerig.py").is_file():
        return f"{STANDINS} is absent: the stand-ins of the electronics"
    if not os.environ.get("CHIBIO_PYTHON"):
        return "CHIBIO_PYTHON is not set: a Python with gunicorn<21, flask, numpy, pyserial and simplejson"
    return None


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def ask(url: str, method: str = "GET", timeout: float = 10.0) -> tuple[int, bytes]:
    """Status and body; never raises for a status."""
    request = urllib.request.Request(url, data=b"" if method == "POST" else None, method=method)
    try:
        with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=timeout) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as refused:
        return refused.code, b""


def punctual() -> None:
    """Ahead of all else here, where that is allowed: 4 ms of delay are 5 % of a dose at ten times real time."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(5))


class Bench:
    """What both benches share. url: of the device; folder: what it leaves; reactors.

    Each has besides: truth(), of each vial now: x (OD), V (mL), T (degC), stir, feed (mL given), on (motors that turn);
    runs(m), of its motors; change(m, **what), vial and electronics; kill_worker(), the web worker dies and is replaced;
    kill(), the software dies and stays dead, and the supervising latch cuts power; restart(); close().
    """

    url: str
    kind: str
    truth: Callable[[], dict[str, dict[str, Any]]]
    close: Callable[[], None]
    _began: float

    def __init__(self, folder: Path, reactors: Sequence[str], unit: int) -> None:
        self.folder, self.reactors, self.unit = folder.resolve(), tuple(reactors), unit
        self.folder.mkdir(parents=True)
        self.history: dict[str, list[tuple[float, float, float]]] = {m: [] for m in reactors}  # s, OD, degC

    def now(self) -> float:
        return (time.monotonic() - self._began) * SPEED

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def sleep(self, seconds: float) -> None:
        """Device seconds."""
        time.sleep(max(seconds, 0.0) / SPEED)

    def until(self, what: Callable[[], bool], patience: float = 300.0, step: float = 0.05) -> None:
        """Wait for `what`, at most `patience` device seconds. Raises: TimeoutError."""
        end = self.now() + patience
        while not what():
            if self.now() > end:
                raise TimeoutError(f"not within {patience:g} device seconds")
            self.sleep(step)

    def post(self, path: str) -> int:
        return ask(self.url + path, "POST")[0]

    def state(self, m: str) -> dict[str, Any]:
        """sysData of a reactor, as another client gets it."""
        self.post(f"/changeDevice/{m}")
        data: dict[str, Any] = json.loads(ask(self.url + "/getSysdata/")[1])
        return data if data["UIDevice"] == m else self.state(m)

    def motors(self, m: str) -> set[str]:
        return set(self.truth()[m]["on"])

    def until_measuring(self, m: str) -> None:
        """Wait for the middle of the next measurement: the stirrer rests from 0 to 10.5 s, light falls from 5 to 10."""
        self.until(lambda: self.truth()[m]["stir"] > 0)
        self.until(lambda: self.truth()[m]["stir"] == 0)
        self.sleep(7.0)

    def dose(self, m: str, pump: str, duty: float) -> None:
        """One dose by hand, over before this returns."""
        self.post(f"/SetOutputTarget/{pump}/{m}/{duty}")
        self.post(f"/SetOutputOn/{pump}/1/{m}")
        self.sleep(63 * duty + 2.0)
        self.post(f"/SetOutputOn/{pump}/0/{m}")
        self.sleep(1.5)


class App(Bench):
    """The vendor's unmodified app behind gunicorn, one sync worker, its 30 s limit in accelerated seconds.

    Kept: the board's clock starts anew with each start of the software, as without a battery.
    """

    kind = "app"

    def __init__(self, folder: Path, reactors: Sequence[str], unit: int = 0, od: float = START_OD) -> None:
        super().__init__(folder, reactors, unit)
        self._began, port = time.monotonic(), free_port()
        self.url = f"http://127.0.0.1:{port}"
        app = Path(os.environ["CHIBIO_APP"]).resolve()
        self._environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "CHIBIO"))} | {
            "CHIBIO_FAKE": "1",
            "CHIBIO_ACCEL": f"{SPEED:g}",
            "CHIBIO_T0": repr(self._began),
            "CHIBIO_PRESENT": ",".join(reactors),
            "CHIBIO_RUN": str(self.folder),
            "CHIBIO_STANDINS": str(STANDINS),
            "CHIBIO_UNIT": str(unit),
            "CHIBIO_VIALS": json.dumps({m: VIALS[m] for m in reactors}),
            "PYTHONPATH": os.pathsep.join(map(str, (Path(__file__).parent / "standins", app, STANDINS))),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        limit = str(max(round(30 / SPEED), 1))
        self._command = [os.environ["CHIBIO_PYTHON"], "-m", "gunicorn", "-b", f"127.0.0.1:{port}", "--workers", "1"]
        self._command += ["--timeout", limit, "app:application"]
        self._process: subprocess.Popen[bytes] | None = None
        self.restart()
        for m in reactors:
            self.change(m, x=0.0)
            raws = []
            for _ in range(3):
                self.post(f"/MeasureOD/{m}")
                raws.append(float(self.state(m)["OD0"]["raw"]))
            self.post(f"/CalibrateOD/OD0/{m}/{sum(raws) / 3:g}/0")
            self.change(m, x=od)

    def restart(self) -> None:
        with open(self.folder / "app.log", "ab") as log:
            self._process = subprocess.Popen(
                self._command, cwd=self.folder, env=self._environment, stdout=log, stderr=log, start_new_session=True,
                preexec_fn=punctual,
            )  # fmt: skip
        self._wait_for_web()

    def _wait_for_web(self) -> None:
        def answers() -> bool:
            if self._process is None or self._process.poll() is not None:
                raise RuntimeError(f"the app did not start: {self.folder / 'app.log'}")
            try:
                return ask(self.url + "/getSysdata/", timeout=1.0)[0] == 200
            except OSError:
                return False

        self.until(answers, patience=300.0, step=0.5)

    def truth(self) -> dict[str, dict[str, Any]]:
        vials = json.loads((self.folder / "vials.json").read_text())
        dead = self._process is None
        return {
            m: {name: vial[name] for name in ("x", "V", "T", "stir")}
            | {"feed": vial["vin"], "on": {f"Pump{k + 1}" for k in range(4) if vial["pump"][k] and not dead}}
            for m, vial in vials.items()
        }

    def runs(self, m: str) -> list[Run]:
        began: dict[str, float] = {}
        found = []
        for line in (self.folder / "pumps.log").read_text().splitlines():
            at, reactor, pump, duty = line.split()
            if reactor != m:
                continue
            if abs(float(duty)) > 0.95:
                began.setdefault(pump, float(at))
            elif pump in began:  # the first of the two writes of a stop counts
                start = began.pop(pump)
                flow = VIALS[m][{"Pump1": "feed", "Pump2": "waste"}.get(pump, "waste")]
                found.append(Run(pump, start, float(at) - start, flow * (float(at) - start)))
        found += [
            Run(pump, at, self.now() - at, VIALS[m]["feed"] * (self.now() - at))
            for pump, at in began.items()
            if self._process
        ]
        return sorted(found, key=lambda run: run.start_s)

    def change(self, m: str, **changes: float) -> None:
        """At once. x, V, T, mu, feed, waste: the vial; internal_zero, glitch: counted; unplugged, as7341, dark, ir."""
        control = self.folder / "control.json"
        self.until(lambda: not control.exists())
        (self.folder / "control.new").write_text(json.dumps({m: changes}))
        os.replace(self.folder / "control.new", control)
        self.until(lambda: not control.exists())

    def _worker(self) -> int:
        assert self._process is not None
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        return int(children[0])

    def kill_worker(self) -> None:
        os.kill(self._worker(), signal.SIGKILL)
        self.sleep(5.0)
        self._wait_for_web()

    def kill(self) -> None:
        assert self._process is not None
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._process = None

    def read_history(self) -> None:
        for line in (self.folder / "truth.jsonl").read_text().splitlines():
            for m, vial in json.loads(line).items():
                self.history[m].append((vial["t"], vial["x"], vial["T"]))

    def close(self) -> None:
        if self._process is not None:
            self.kill()
        self.read_history()


SOUND_EMULATOR = """  # pumps that give the same each time and no single outlying readings, as the stand-ins have it
import sys
from dataclasses import replace
from functools import partial
from hardware.emulator import server
preset = server.plant_preset
server.plant_preset = lambda name: replace(preset(name), pump=replace(preset(name).pump, pulse_cv=0.0))
server.VialConfig = partial(server.VialConfig, outlier_rate=0.0)
sys.exit(server.main())
"""


class Emulator(Bench):
    """`python -m hardware.emulator` with the same vials."""

    kind = "emulator"

    def __init__(self, folder: Path, reactors: Sequence[str], unit: int = 0, od: float = START_OD) -> None:
        super().__init__(folder, reactors, unit)
        command = [sys.executable, "-c", SOUND_EMULATOR, "--port", "0", "--speed", f"{SPEED:g}"]
        command += ["--reactors", ",".join(reactors), "--od", f"{od}", "--unit", str(unit + 1)]
        self._process = subprocess.Popen(
            command, cwd=ROOT, env=client_environment(), stdout=subprocess.PIPE, text=True, start_new_session=True,
            preexec_fn=punctual,
        )  # fmt: skip
        assert self._process.stdout is not None
        ready = re.match(r"emulator ready: (http://\S+) .* control (http://\S+)", self._process.stdout.readline())
        assert ready is not None
        self.url, self.control = ready[1], ready[2]
        before = time.monotonic()
        device_s = self._get("truth")[reactors[0]]["device_s"]
        self._began = (before + time.monotonic()) / 2 - device_s / SPEED
        for m in reactors:
            self.change(m, **VIALS[m])
        self._closed = False
        self._watch = threading.Thread(target=self._follow, daemon=True)
        self._watch.start()

    def _get(self, path: str) -> Any:
        return json.loads(ask(f"{self.control}/_emulator/{path}")[1])

    def _follow(self) -> None:
        while not self._closed:
            for m, vial in self.truth().items():
                self.history[m].append((self.now(), vial["x"], vial["T"]))
            self.sleep(5.0)

    def fault(self, name: str, m: str = "all", value: float = 1.0) -> None:
        status, _ = ask(f"{self.control}/_emulator/fault/{name}/{m}/{value:g}", "POST")
        assert status == 204, (name, m, value, status)

    def truth(self) -> dict[str, dict[str, Any]]:
        truth = self._get("truth")
        return {
            m: {"x": vial["od"], "V": vial["volume_ml"], "T": vial["temperature"], "stir": vial["stir"]}
            | {"feed": vial["feed_ml"]}
            | {"on": {pump for pump, on in vial["motors"].items() if on}}
            for m, vial in truth.items()
            if m in self.reactors
        }

    def runs(self, m: str) -> list[Run]:
        waste = VIALS[m]["waste"]
        return [
            Run(r["pump"], r["start_s"], r["seconds"], r["feed_ml"] if r["pump"] == "Pump1" else waste * r["seconds"])
            for r in self._get(f"doses/{m}")
        ]

    def change(self, m: str, **changes: float) -> None:
        names = {"feed": ("pump_gain_factor", 1.0), "waste": ("waste_gain_factor", 1.0), "mu": ("mu_factor", 0.025)}
        for key, value in changes.items():
            if key in names:
                name, unit = names[key]
                self.fault(name, m, value / unit)
            elif key == "as7341":
                self.fault("spectrometer_dead", m, value)
            elif key == "glitch":  # for about one of the four readings, which take five seconds
                self.until_measuring(m)
                self.fault("spectrometer_glitch", m)
                self.sleep(1.2)
                self.fault("spectrometer_glitch", m, 0.0)
            else:
                self.fault(key, m, value)

    def kill_worker(self) -> None:
        self.fault("worker_wipe")
        self.sleep(15.0)

    def kill(self) -> None:
        self.fault("crash")

    def restart(self) -> None:
        self.fault("restart")
        self.sleep(15.0)

    def close(self) -> None:
        self._closed = True
        self._watch.join()
        self._process.terminate()
        self._process.wait()


BENCHES: dict[str, type[App] | type[Emulator]] = {"app": App, "emulator": Emulator}


class Agent:
    """The board agent between a client and a bench, over HTTP or over a serial line."""

    def __init__(self, bench: Bench, folder: Path, serial: str = "", deadman_s: float = 120.0) -> None:
        token = folder / "token"
        token.write_text(secrets.token_hex(32))
        token.chmod(0o600)
        self.token, port = token, free_port()
        self.url = f"http://127.0.0.1:{port}"
        way = ["--tty", serial] if serial else ["--http", f"127.0.0.1:{port}", "--token-file", str(token)]
        command = [sys.executable, "hardware/board/board_agent.py", *way, "--url", bench.url]
        command += ["--deadman", f"{deadman_s / SPEED:g}", "--http-timeout", f"{18 / SPEED:g}"]
        with open(folder / "agent.log", "ab") as log:
            self._process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, start_new_session=True)
        time.sleep(0.5)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()


def client_environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def in_foreground() -> None:
    """A shell starts what is in its background deaf to Ctrl-C; a client must hear it."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class Client:
    """`python -m experiments.COMMAND` as a user starts it. `lines`: what it said and when, device s."""

    def __init__(self, bench: Bench, console: Path, *arguments: str) -> None:
        self._bench, self._console = bench, console
        self.lines: list[tuple[float, str]] = []
        self.began_s = bench.now()
        self.ended_s: float | None = None
        self.process = subprocess.Popen(
            [sys.executable, "-m", *arguments], cwd=ROOT, env=client_environment(), text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, preexec_fn=in_foreground,
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout, self._console.open("a") as console:
            for line in self.process.stdout:
                self.lines.append((self._bench.now(), line.rstrip("\n")))
                console.write(f"{self._bench.now():9.1f} {line}")
                console.flush()

    def running(self) -> bool:
        return self.process.poll() is None

    def signal(self, number: int) -> None:
        if self.running():
            self.process.send_signal(number)

    def wait(self, seconds: float) -> int | None:
        """Exit status, None if it has not ended within so many device seconds; it is killed then."""
        try:
            status = self.process.wait(seconds / SPEED)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            status = None
        self._reader.join(5.0)
        self.ended_s = self._bench.now()
        return status


def weigh(kind: str, folder: Path, reactors: Sequence[str], unit: int) -> Path:
    """Weigh every pump on a bench of its own, as docs/device_guide.md asks, and return the folder of calibrations."""
    calibration = folder / f"calibration_{kind}_{len(reactors)}"
    if calibration.exists():
        return calibration
    rows: dict[tuple[str, str], list[tuple[float, int, float]]] = {}
    with BENCHES[kind](folder / f"weigh_{kind}_{len(reactors)}", reactors, unit) as bench:
        if isinstance(bench, Emulator):
            bench.sleep(60.0)
        for m in reactors:  # one after the other: motors that start together keep one another waiting on the bus
            for part, (pump, duties) in WEIGHED.items():
                for duty in duties:
                    before = len(bench.runs(m))
                    for _ in range(1 if part == "waste" else 16 if kind == "emulator" else 4):  # motors jitter
                        bench.dose(m, pump, duty)
                    doses = [run.ml for run in bench.runs(m)[before:] if run.pump == pump]
                    rows.setdefault((m, part), []).append((duty, len(doses), sum(doses)))
    made = folder / "weighed"
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    for (m, part), weighings in rows.items():
        table = made / f"{m}_{part}.csv"
        table.write_text("duty,doses,grams\n" + "".join(f"{d},{n},{g:.4f}\n" for d, n, g in weighings))
        arguments = [f"reactor={m}", f"pump={part}", f"csv={table}", f"backend.calibration={calibration}"]
        subprocess.run(
            [sys.executable, "-m", "experiments.calibrate_pump", *arguments, f"hydra.run.dir={made}/{m}_{part}"],
            cwd=ROOT, env=client_environment(), check=True, capture_output=True,
        )  # fmt: skip
    return calibration
