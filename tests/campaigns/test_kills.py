"""SIGKILL and resume of a real run on a real emulator; the campaign: `python -m tests.campaigns.kills`.

KILL_SEED=7 python -m pytest tests/campaigns/test_kills.py     kills at other moments
"""

import json
import os
from pathlib import Path

import pytest

from experiments.cli import frame
from hardware.storage.journal import read_journal
from tests.campaigns.killed_run import KillConfig
from tests.campaigns.kills import kill_campaign

KILL_SEED = int(os.environ.get("KILL_SEED", "0"))


def test_killed_six_times_nothing_is_lost_or_doubled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    pace = {"speed": 30.0, "longest_s": 4.0, "answer_s": 1.5}  # a machine may be busy with other tests
    kill_campaign(KillConfig(kills=6, runs=1, workers=1, seed=KILL_SEED, **pace), tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["lives"] == 7
    assert summary["rows_lost"] == summary["rows_doubled"] == summary["doses_lost"] == summary["doses_doubled"] == 0
    assert summary["rows"] >= summary["samples"] > 0
    assert summary["doses"] > 5
    assert summary["pumps_off"]
    rows, torn = read_journal(tmp_path / "run0" / "journal.jsonl")
    assert torn == 0
    starts = [row["time_s"] for row in rows if row["kind"] == "start"]
    assert len(starts) > 3
    assert starts == sorted(starts)
    state = json.loads((tmp_path / "run0" / "state.json").read_text())
    decided = [row for row in rows if row["kind"] == "decision"]
    for name in {row["reactor"] for row in decided}:  # one beginning of its schedule in all lives
        began = [r["row"]["time_min"] - r["row"]["elapsed_min"] for r in decided if r["reactor"] == name]
        assert max(began) - min(began) < 0.001
    assert len(state["began"]) == 3


@pytest.mark.parametrize("override", ["kills=0", "runs=300", "speed=0", "early=2"])
def test_bad_values_are_named(override: str) -> None:
    with pytest.raises(frame.UserError, match=f"{override.split('=')[0]} = .*allowed"):
        frame.load(frame.compose("kills", [override]), KillConfig())
