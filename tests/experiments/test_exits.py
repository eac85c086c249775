"""However a run ends, its pumps are verified off: real processes, real signals, a disk that really refuses."""

import csv
import json
import resource
import signal
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hardware.emulator.process import EmulatorProcess
from hardware.storage.journal import read_journal
from tests.programs import Program

SPEED = 30.0
OTHERS = (signal.SIGINT, 0.0), (signal.SIGHUP, 0.0), (signal.SIGTERM, 6.0)  # 0.2 s for each request


class Bench:
    """A client at work on two reactors of an emulated device."""

    def __init__(self, device: EmulatorProcess, folder: Path) -> None:
        self.device, self.folder = device, folder
        scenario = ["scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[1000]"]
        backend = ["backend=chibio", f"backend.url={device.url}", f"backend.speed={SPEED}", "backend.reactors=[M0,M1]"]
        words = ["controller=adaptive_inverse", *scenario, *backend, f"hydra.run.dir={folder}"]
        out = folder.with_suffix(".out")
        self.client = Program("experiments.deploy", *words, cwd=folder.parent, out=out, WITHOUT_FIGURES="1")

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


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with EmulatorProcess(["--reactors", "M0,M1", "--speed", str(SPEED), "--od", "0.5"]) as device:
        one = Bench(device, tmp_path / "run")
        with one.client:
            yield one


def volumes(folder: Path, name: str) -> list[float]:
    """Of every whole row."""
    path = folder / "recordings" / f"{name}.csv"
    with open(path if path.exists() else "/dev/null", newline="") as file:
        return [float(row["volume_ml"]) for row in csv.DictReader(file) if None not in row.values()]


@pytest.mark.parametrize(
    ("number", "slow_s"),
    [(signal.SIGTERM, 0.0), *(pytest.param(*case, marks=pytest.mark.slow) for case in OTHERS)],
)
def test_a_signal_in_a_dose_costs_no_row(bench: Bench, number: int, slow_s: float) -> None:
    """In its middle, or between the starts of its pumps: the journal's newest row tells of the waste pump alone."""
    journal = bench.folder / "journal.jsonl"
    bench.until_under_way()
    if slow_s:
        bench.slow(slow_s)
        began = journal.stat().st_size
        bench.client.until(lambda: b'"kind":"intent"' in journal.read_bytes()[began:])
    bench.client.send_signal(number)
    status, said = bench.end()
    assert status == 0, said
    assert "Traceback" not in said
    rows, _ = read_journal(journal)
    for name in ("M0", "M1"):
        decided, intents, ends = (
            [row for row in rows if row["kind"] == kind and row["reactor"] == name]
            for kind in ("decision", "intent", "dose_end")
        )
        given = volumes(bench.folder, name)
        assert len(given) == len(decided)
        assert len(ends) == sum(row["feed_ml"] > 0.0 for row in intents)
        if ends and ends[-1]["feed_ml"] == 0.0:  # switched off again before the feed pump was on
            assert given[-1] == 0.0
    bench.check("stopped by the operator")


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
    assert status in (0, 130, -signal.SIGINT), said  # the last one may fall into the end of the interpreter


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
