"""A few simulated hours of several reactors: nothing missed, doubled, grown or drifted."""

import json
from pathlib import Path

import pytest

from experiments.recordings.reader import read_recording
from tests.campaigns.soak import Day, SoakConfig, soak, soak_run


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
