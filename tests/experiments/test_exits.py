"""However a run ends, its pumps are verified off: real processes, real signals, a disk that really refuses."""

import csv
import json
import resource
import signal
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hardware.emulator.process import EmulatorProcess
from hardware.storage.journal import read_journal
from tests.programs import Program

SPEED = 30.0
OTHERS = signal.SIGINT, signal.SIGHUP
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
        program = ["-c", code] if code else ["experiments.deploy"]
        scenario = ["scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[1000]"]
        backend = ["backend=chibio", f"backend.url={device.url}", f"backend.speed={SPEED}", "backend.reactors=[M0,M1]"]
        new = ["controller=adaptive_inverse", *scenario, *backend, *more, f"hydra.run.dir={folder}"]
        words = [*program, *([f"resume={folder}"] if resume else new)]
        self.client = Program(*words, cwd=folder.parent, out=folder.with_suffix(".out"), WITHOUT_FIGURES="1")

    def truth(self) -> dict[str, Any]:
        with urllib.request.urlopen(f"{self.device.control}/_emulator/truth", timeout=10.0) as answer:
            return dict(json.load(answer))

    def motors(self) -> list[str]:
        truth = self.truth()
        return [f"{m}/{pump}" for m in ("M0", "M1") for pump, on in truth[m]["motors"].items() if on]

    def until_a_dose(self) -> None:
        """Wait until a pump runs."""
        self.client.until(lambda: bool(self.motors()))

    def until_under_way(self) -> None:
        """Wait until a pump runs and each reactor has two rows on record."""
        self.client.until(lambda: all(len(volumes(self.folder, name)) > 1 for name in ("M0", "M1")))
        self.until_a_dose()

    def slow(self, seconds: float) -> None:
        """From now on each request takes so much device time."""
        url = f"{self.device.control}/_emulator/fault/slow_s/all/{seconds:g}"
        urllib.request.urlopen(urllib.request.Request(url, method="POST"), timeout=10.0).close()

    def end(self) -> tuple[int, str]:
        """Status and what was said, after the client has ended by itself."""
        return self.client.end()

    def check(self, outcome: str) -> None:
        """Everything off, seen by the emulator and on record, and every reactor with a row."""
        assert self.motors() == []
        rows, torn = read_journal(self.folder / "journal.jsonl")
        assert torn == 0
        assert [row["not_verified"] for row in rows if row["kind"] == "stop"][-1:] == [[]]
        summary = json.loads((self.folder / "summary.json").read_text())
        assert outcome in summary["outcome"]
        assert all(reactor["rows"] > 0 for reactor in summary["reactors"].values())


@contextmanager
def at_work(folder: Path, code: str = "") -> Iterator[Bench]:
    with EmulatorProcess(["--reactors", "M0,M1", "--speed", str(SPEED), "--od", "0.5"]) as device:
        one = Bench(device, folder, code)
        with one.client:
            yield one


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with at_work(tmp_path / "run") as one:
        yield one


def volumes(folder: Path, name: str) -> list[float]:
    """Of every whole row."""
    path = folder / "recordings" / f"{name}.csv"
    with open(path if path.exists() else "/dev/null", newline="") as file:
        return [float(row["volume_ml"]) for row in csv.DictReader(file) if None not in row.values()]


@pytest.mark.slow
def test_a_signal_while_the_pumps_are_being_switched_on_costs_no_row(bench: Bench) -> None:
    """The journal's newest row tells when the waste pump runs and the feed pump not yet: a second of device time."""
    journal = bench.folder / "journal.jsonl"
    bench.until_under_way()
    bench.slow(6.0)  # 0.2 s for each request: the signal falls inside the switching on
    began = journal.stat().st_size
    bench.client.until(
        lambda: b'"kind":"intent"' in journal.read_bytes()[began:]
    )  # not every sample is new enough for a dose
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


@pytest.mark.parametrize("number", [signal.SIGTERM, *(pytest.param(n, marks=pytest.mark.slow) for n in OTHERS)])
def test_a_signal_in_the_middle_of_a_dose(bench: Bench, number: int) -> None:
    bench.until_under_way()
    bench.client.send_signal(number)
    status, said = bench.end()
    assert "Traceback" not in said
    bench.check("stopped by the operator")
    assert status == 0


@pytest.mark.slow
@pytest.mark.parametrize("slow_s", [0.0, 3.0])
def test_signal_after_signal_does_not_end_it_before_the_pumps_are_off(bench: Bench, slow_s: float) -> None:
    """Through the switching off and through the summary."""
    bench.until_under_way()
    bench.slow(slow_s)
    while bench.client.poll() is None:
        bench.client.send_signal(signal.SIGINT)
        time.sleep(0.05)
    status, said = bench.end()
    assert "Traceback" not in said
    assert bench.motors() == []
    bench.check("stopped by the operator")
    assert status in (0, 130, -signal.SIGINT)  # the last one may fall into the end of the interpreter


@pytest.mark.slow
def test_a_full_disk(bench: Bench) -> None:
    bench.until_under_way()
    size = (bench.folder / "journal.jsonl").stat().st_size
    bench.until_a_dose()
    resource.prlimit(bench.client.pid, resource.RLIMIT_FSIZE, (size + 40, resource.RLIM_INFINITY))
    status, said = bench.end()
    assert status == 1
    assert "free disk space, then resume the run" in said.splitlines()[-1]
    assert bench.motors() == []
    assert read_journal(bench.folder / "journal.jsonl")[1] == 0


@pytest.mark.slow
def test_an_exception_in_the_controller(tmp_path: Path) -> None:
    with at_work(tmp_path / "run", BROKEN) as bench:
        assert bench.end()[0] == 1
        bench.check("failed: RuntimeError: the controller failed")


@pytest.mark.slow
def test_an_overflow_pump_runs_over_doses_and_a_kill_and_is_off_after_every_other_end(tmp_path: Path) -> None:
    pump = ["backend.overflow_pump.pump=Pump3", "backend.overflow_pump.duty=0.95"]
    folder = tmp_path / "run"
    state = folder / "state.json"

    def until_fed(bench: Bench) -> None:
        """Until each reactor has a row and a dose is given beside a running overflow pump."""
        both = [{f"{name}/Pump1", f"{name}/Pump3"} for name in ("M0", "M1")]
        bench.client.until(lambda: state.exists() and all(volumes(folder, name) for name in ("M0", "M1")))
        bench.client.until(lambda: any(pumps <= set(bench.motors()) for pumps in both))

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
        bench.client.send_signal(signal.SIGTERM)
        status, said = bench.end()
        assert status == 0, said
        assert "pumps verified off" in said
        notes = [row["note"] for row in read_journal(folder / "journal.jsonl")[0] if row["kind"] == "note"]
        assert sum("the overflow pump was found off" in note for note in notes) == 2
        bench.check("stopped by the operator")
