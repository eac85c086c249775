"""A run over the serial line as a user starts it, with the cable pulled and plugged in again."""

import csv
import json
import signal
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from hardware.emulator.process import EmulatorProcess
from hardware.emulator.vial import Dose
from hardware.storage.journal import read_journal
from tests.campaigns.audit import audit_doses
from tests.hardware.test_serial_transport import Cable, cable  # noqa: F401  (a fixture)
from tests.programs import Program

SPEED = 60.0


def rows(folder: Path, name: str) -> list[float]:
    path = folder / "recordings" / f"{name}.csv"
    if not path.exists():
        return []
    with open(path, newline="") as f:
        return [60.0 * float(row["time_min"]) for row in csv.DictReader(f)]


@pytest.mark.slow
def test_the_line_is_unplugged_for_three_minutes(
    cable: tuple[Cable, EmulatorProcess],  # noqa: F811
    tmp_path: Path,
) -> None:
    line, device = cable
    folder = tmp_path / "run"
    scenario = ["scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[1000]", "controller=adaptive_inverse"]
    link = ["backend=chibio", "backend/transport=serial", f"backend.transport.port={line.pc}"]
    numbers = [f"backend.speed={SPEED}", "backend.reactors=[M0,M1]", f"hydra.run.dir={folder}"]
    client = Program("experiments.deploy", *scenario, *link, *numbers, cwd=tmp_path, out=tmp_path / "out")

    client.until(lambda: len(rows(folder, "M1")) >= 3)
    line.unplug()
    before = len(rows(folder, "M1"))
    time.sleep(180.0 / SPEED)
    line.plug()
    client.until(lambda: len(rows(folder, "M1")) >= before + 4)
    client.send_signal(signal.SIGINT)
    status, said = client.end()
    assert status == 0, said
    journal, torn = read_journal(folder / "journal.jsonl")
    assert torn == 0
    for name in ("M0", "M1"):
        gaps = np.diff(rows(folder, name))
        assert (gaps > 90.0).sum() == 1
        assert gaps.max() < 180.0 + 150.0  # the minutes in between, and until the next sample was noticed
        with urllib.request.urlopen(f"{device.control}/_emulator/doses/{name}", timeout=10.0) as answer:
            doses = [Dose(**dose) for dose in json.load(answer)]
        first = next(row for row in journal if row["kind"] == "intent" and row["reactor"] == name and row["feed_ml"])
        zero = doses[0].start_s - first["on_s"] - 20.0  # a few slow requests lie between an intent and its dose
        assert audit_doses(journal, doses, name, zero)[0] == 0
    with urllib.request.urlopen(f"{device.control}/_emulator/truth", timeout=10.0) as answer:
        truth = json.load(answer)
    assert not any(any(truth[name]["motors"].values()) for name in ("M0", "M1"))
