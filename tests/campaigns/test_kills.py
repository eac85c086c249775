"""SIGKILL and resume of a real run on a real emulator; the campaign: `python -m tests.campaigns.kills`.

KILL_SEED=7 python -m pytest -m slow tests/campaigns/test_kills.py     kills at other moments
"""

import json
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hardware.emulator.process import EmulatorProcess
from hardware.storage.journal import read_journal
from tests.campaigns import killed_run
from tests.campaigns.killed_run import Clients, Comparison, Findings, KillConfig
from tests.campaigns.kills import kill_campaign
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]
KILL_SEED = int(os.environ.get("KILL_SEED", "0"))


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
def test_killed_six_times_nothing_is_lost_or_doubled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    for limit in ("HELD_OD", "LONGEST_OUT_MIN"):  # a busy machine samples late: test_control_judged.py
        monkeypatch.setattr(killed_run, limit, math.inf)
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
