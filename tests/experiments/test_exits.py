"""However a run ends, its pumps are verified off: real processes, real signals, a disk that really refuses."""

import csv
import json
import os
import resource
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from hardware.emulator.process import EmulatorProcess
from hardware.storage.journal import read_journal
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
SPEED = 30.0
BROKEN = """
import experiments.deploy
from experiments.laws.density.inverse import Inverse
whole = Inverse.act
calls = []
def act(self, *arguments):
    calls.append(0)
    if len(calls) > 8:
        raise RuntimeError("the controller failed")
    return whole(self, *arguments)
Inverse.act = act
experiments.deploy.main()
"""


class Bench:
    """A client at work on two reactors of an emulated device."""

    def __init__(
        self, device: EmulatorProcess, folder: Path, code: str = "", more: Sequence[str] = (), resume: bool = False
    ) -> None:
        self.device, self.folder = device, folder
        program = ["-c", code] if code else ["-m", "experiments.deploy"]
        scenario = ["scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[1000]"]
        backend = ["backend=chibio", f"backend.url={device.url}", f"backend.speed={SPEED}", "backend.reactors=[M0,M1]"]
        new = ["controller=adaptive_inverse", *scenario, *backend, *more, f"hydra.run.dir={folder}"]
        command = [sys.executable, *program, *([f"resume={folder}"] if resume else new)]
        self.client = subprocess.Popen(
            command, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    def truth(self) -> dict[str, Any]:
        with urllib.request.urlopen(f"{self.device.control}/_emulator/truth", timeout=10.0) as answer:
            return dict(json.load(answer))

    def motors(self) -> list[str]:
        truth = self.truth()
        return [f"{m}/{pump}" for m in ("M0", "M1") for pump, on in truth[m]["motors"].items() if on]

    def until_a_dose(self) -> None:
        """Wait until a pump runs."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.motors():
            assert time.monotonic() < deadline
            assert self.client.poll() is None
            time.sleep(0.005)

    def end(self) -> tuple[int, str]:
        """Status and what was said, after the client has ended by itself."""
        said = self.client.communicate(timeout=PATIENCE_S)[0]
        return self.client.returncode, said

    def check(self, outcome: str) -> None:
        """Everything off, seen by the emulator and on record, and every reactor with a row."""
        assert self.motors() == []
        rows, torn = read_journal(self.folder / "journal.jsonl")
        assert torn == 0
        stops = [row for row in rows if row["kind"] == "stop"]
        if stops:
            assert stops[-1]["not_verified"] == []
        summary = json.loads((self.folder / "summary.json").read_text())
        assert outcome in summary["outcome"]
        assert all(reactor["rows"] > 0 for reactor in summary["reactors"].values())


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with EmulatorProcess(["--reactors", "M0,M1", "--speed", str(SPEED), "--od", "0.5"]) as device:
        one = Bench(device, tmp_path / "run")
        yield one
        if one.client.poll() is None:
            one.client.kill()
            one.client.communicate()


def volumes(folder: Path, name: str) -> list[float]:
    with open(folder / "recordings" / f"{name}.csv", newline="") as file:
        return [float(row["volume_ml"]) for row in csv.DictReader(file)]


def test_a_signal_while_the_pumps_are_being_switched_on_costs_no_row(bench: Bench) -> None:
    """The journal's newest row tells when the waste pump runs and the feed pump not yet: a second of device time."""
    journal = bench.folder / "journal.jsonl"
    bench.until_a_dose()
    time.sleep(2.0 * 60.0 / SPEED)
    urllib.request.urlopen(
        urllib.request.Request(f"{bench.device.control}/_emulator/fault/slow_s/all/6", method="POST"), timeout=10.0
    ).close()  # 0.2 s for each request: the signal falls inside the switching on
    began = journal.stat().st_size
    deadline = time.monotonic() + PATIENCE_S  # over so slow a link not every sample is new enough for a dose
    while b'"kind":"intent"' not in journal.read_bytes()[began:]:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    bench.client.send_signal(signal.SIGTERM)
    status, said = bench.end()
    assert status == 0, said
    rows, _ = read_journal(journal)
    for name in ("M0", "M1"):
        decided = [row for row in rows if row["kind"] == "decision" and row["reactor"] == name]
        given = volumes(bench.folder, name)
        assert len(given) == len(decided)
        intents = [row for row in rows if row["kind"] == "intent" and row["reactor"] == name]
        ends = [row for row in rows if row["kind"] == "dose_end" and row["reactor"] == name]
        assert len(ends) == sum(row["feed_ml"] > 0.0 for row in intents)
        if ends and ends[-1]["feed_ml"] == 0.0:  # switched off again before the feed pump was on
            assert given[-1] == 0.0
    bench.check("stopped by the operator")


def test_three_signals_at_once_end_with_a_summary(bench: Bench) -> None:
    bench.until_a_dose()
    time.sleep(2.0 * 60.0 / SPEED)
    bench.until_a_dose()
    for _ in range(3):
        bench.client.send_signal(signal.SIGINT)
        time.sleep(0.15)
    for _ in range(40):  # and all the way through the summary
        time.sleep(0.05)
        if bench.client.poll() is not None:
            break
        bench.client.send_signal(signal.SIGINT)
    status, said = bench.end()
    assert "pumps verified off" in said
    assert "Traceback" not in said
    bench.check("stopped by the operator")
    assert status in (0, 130, -signal.SIGINT)  # the last one may fall into the end of the interpreter


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_in_the_middle_of_a_dose(bench: Bench, number: int) -> None:
    bench.until_a_dose()
    time.sleep(2.0 * 60.0 / SPEED)
    bench.until_a_dose()
    bench.client.send_signal(number)
    status, said = bench.end()
    assert "pumps verified off" in said
    assert "Traceback" not in said
    bench.check("stopped by the operator")
    assert status == 0


def test_an_impatient_operator_does_not_get_out_before_the_pumps_are_off(bench: Bench) -> None:
    bench.until_a_dose()
    time.sleep(2.0 * 60.0 / SPEED)
    urllib.request.urlopen(
        urllib.request.Request(f"{bench.device.control}/_emulator/fault/slow_s/all/3", method="POST"), timeout=10.0
    ).close()
    bench.client.send_signal(signal.SIGINT)
    while bench.client.poll() is None:
        time.sleep(0.1)
        bench.client.send_signal(signal.SIGINT)
    status, said = bench.end()
    assert "pumps verified off" in said
    assert bench.motors() == []
    assert status in (0, 130, -signal.SIGINT)


def test_a_full_disk(bench: Bench) -> None:
    bench.until_a_dose()
    time.sleep(3.0 * 60.0 / SPEED)
    size = (bench.folder / "journal.jsonl").stat().st_size
    bench.until_a_dose()
    resource.prlimit(bench.client.pid, resource.RLIMIT_FSIZE, (size + 40, resource.RLIM_INFINITY))
    status, said = bench.end()
    assert status == 1
    assert "pumps verified off" in said
    assert "free disk space, then resume the run" in said.splitlines()[-1]
    assert bench.motors() == []
    assert read_journal(bench.folder / "journal.jsonl")[1] == 0


def test_an_exception_in_the_controller(tmp_path: Path) -> None:
    with EmulatorProcess(["--reactors", "M0,M1", "--speed", str(SPEED), "--od", "0.5"]) as device:
        bench = Bench(device, tmp_path / "run", BROKEN)
        status, said = bench.end()
        assert status == 1
        assert "pumps verified off" in said
        bench.check("failed: RuntimeError: the controller failed")


def test_an_overflow_pump_runs_over_doses_and_a_kill_and_is_off_after_every_other_end(tmp_path: Path) -> None:
    pump = ["backend.overflow_pump.pump=Pump3", "backend.overflow_pump.duty=0.95"]
    folder = tmp_path / "run"
    state = folder / "state.json"

    def until_fed(bench: Bench) -> None:
        """Until a dose is given beside a running overflow pump."""
        deadline = time.monotonic() + PATIENCE_S
        while not (state.exists() and any({f"{m}/Pump1", f"{m}/Pump3"} <= set(bench.motors()) for m in ("M0", "M1"))):
            assert time.monotonic() < deadline
            assert bench.client.poll() is None
            time.sleep(0.005)

    with EmulatorProcess(
        ["--reactors", "M0,M1", "--speed", str(SPEED), "--od", "0.5", "--overflow-pump", "Pump3"]
    ) as device:
        bench = Bench(device, folder, more=pump)
        until_fed(bench)
        bench.client.kill()
        assert "overflow pump: Pump3 at duty 0.95" in bench.end()[1]
        whole = state.read_text()
        state.write_text("{")  # a resumed run that fails between the reactors' start and the loop
        bench = Bench(device, folder, resume=True)
        status, said = bench.end()
        assert status == 1
        assert "no state to resume from" in said.splitlines()[-1]
        assert bench.motors() == []
        state.write_text(whole)
        bench = Bench(device, folder, resume=True)
        until_fed(bench)
        time.sleep(2.0 * 60.0 / SPEED)
        bench.client.send_signal(signal.SIGTERM)
        status, said = bench.end()
        assert status == 0, said
        assert "pumps verified off" in said
        notes = [row["note"] for row in read_journal(folder / "journal.jsonl")[0] if row["kind"] == "note"]
        assert sum("the overflow pump was found off" in note for note in notes) == 2
        bench.check("stopped by the operator")
