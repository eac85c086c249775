"""Kills and days, small: nothing missed, doubled, grown or drifted."""

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from experiments.recordings.reader import read_recording
from hardware.emulator.process import EmulatorProcess
from hardware.storage.journal import read_journal
from tests.campaigns.kills import Clients, Comparison, Findings, KillConfig
from tests.campaigns.soak import Day, SoakConfig, soak, soak_run
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]


def test_a_run_that_is_killed_in_a_dose_goes_on_and_nothing_is_lost_or_doubled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pace = {"speed": 30.0, "answer_s": 5.0, "kills": 1, "runs": 1}  # a machine may be busy with other tests
    config, run, found = KillConfig(reactors=("M0",), controller_kind="inverse", **pace), tmp_path / "run", Findings()

    def rows(*kinds: str) -> list[str]:
        path = run / "journal.jsonl"
        return [row["kind"] for row in read_journal(path)[0] if row["kind"] in kinds] if path.exists() else []

    def killed_once(there: Callable[[], bool]) -> float:
        client, until = clients.start(), time.monotonic() + PATIENCE_S
        while not there() and client.status is None and time.monotonic() < until:
            time.sleep(0.02)
        at = time.time()
        client.kill()
        return at

    with EmulatorProcess(["--reactors", "M0", "--speed", "30", "--od", "0.5"]) as device:
        clients = Clients(config, device, run, np.random.default_rng(0), found, threading.Event())
        first = killed_once(lambda: "feed_on" in rows("feed_on"))
        assert rows("feed_on", "dose_end") == ["feed_on"]
        last = killed_once(lambda: rows("start", "dose_end")[-3:] == ["dose_end", "start", "dose_end"])
        Comparison(config, device, run, [first], last, found).run()
    assert rows("feed_on", "dose_end")[:2] == ["feed_on", "dose_end"], "what the kill left open has its end"
    assert (found.lives, found.rows_lost, found.rows_doubled, found.doses_lost, found.doses_doubled) == (2, 0, 0, 0, 0)
    assert found.doses > 0
    assert found.rows > 0


@pytest.mark.slow
def test_hours_of_two_reactors(tmp_path: Path) -> None:
    config = SoakConfig(reactors=2, days=0.125, phase_min=60.0)
    soak(config, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["rows_lost"] == summary["rows_doubled"] == 0
    for name, reactor in summary["reactors"].items():
        assert reactor["doses_doubled"] == 0
        assert reactor["doses"] > 150
        assert reactor["booked_ml"] == pytest.approx(reactor["fed_ml"], rel=0.03)
        assert reactor["ledger_ml"] == pytest.approx(reactor["volume_ml"], abs=0.5)
        assert reactor["peak_ml"] < 22.0
        assert read_recording(tmp_path / "recordings" / f"{name}.csv").od.size == pytest.approx(179, abs=2)
    day = summary["days"][0]
    assert day["samples"] == pytest.approx(2 * 179, abs=4)
    assert day["journal_mb"] * 8 * 8 / 2 < 40.0  # of eight reactors, a day
    assert day["state_kb"] < 20.0
    assert day["error"] < 0.01


@pytest.mark.campaign
def test_memory_is_flat_over_two_days(tmp_path: Path) -> None:
    days: list[Day] = []
    soak_run(SoakConfig(reactors=2, days=2.0), tmp_path, days)
    assert days[1].memory_mb - days[0].memory_mb < 8.0
    assert days[1].journal_mb == pytest.approx(2.0 * days[0].journal_mb, rel=0.05)
