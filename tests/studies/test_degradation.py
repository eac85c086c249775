"""The degradation study, small: its output files."""

import csv
import json
from pathlib import Path

import pytest

from tests.studies.degradation import degradation, main

pytestmark = pytest.mark.numeric

SHORT = [
    "agent.total_steps=120", "agent.learn_start=60", "agent.epsilon_steps=60", "agent.batch_size=16", "n_agents=2",
    "eval_every=50", "~trained", "~fitted", "+trained={mine: {target_period: 30}}",
    "+fitted={told: {hindsight_share: 1.0}}",
]  # fmt: skip
COLUMNS = [
    "variant", "step", "sweeps", "regret_pct", "regret_pct_worst", "steady_abs_error", "value_error", "lowest_value",
    "td_error",
]  # fmt: skip


@pytest.mark.slow
def test_a_study_leaves_curves_summary_and_figure(tmp_path: Path) -> None:
    folder = tmp_path
    degradation(main.config(SHORT), folder)
    with open(folder / "curves.csv", newline="") as f:
        reader = csv.DictReader(f)
        rows = list(reader)
    assert reader.fieldnames == COLUMNS
    assert [(r["variant"], r["step"]) for r in rows] == [("mine", "100"), ("mine", "120")]
    assert [int(r["sweeps"]) for r in rows] == [(step - 60) * 4 // 30 for step in (100, 120)]
    for row in rows:
        assert 0.0 < float(row["regret_pct"]) <= float(row["regret_pct_worst"])
    summary = json.loads((folder / "summary.json").read_text())
    assert list(summary) == ["action_gap", "trained", "fitted"]
    assert 0.0 < summary["action_gap"] < 1e-4
    assert {k: str(v) for k, v in summary["trained"]["mine"].items()} == rows[-1]
    assert {key: len(values) for key, values in summary["fitted"]["told"].items()} == {
        "regret_pct": 2,
        "steady_abs_error": 2,
    }
    assert (folder / "figures" / "degradation.png").stat().st_size > 5000
