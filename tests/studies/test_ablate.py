"""The ablation study, small, and its table against numbers recomputed from the rows."""

import csv
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from dqn.config import DQNConfig
from experiments.cli import frame
from tests.studies.ablate import AblateConfig, Row, ablate, main, summarise

pytestmark = pytest.mark.numeric

SHORT = ["agent.total_steps=60", "agent.learn_start=30", "agent.epsilon_steps=30", "agent.batch_size=16",
         "eval_every=60", "n_agents=2"]  # fmt: skip


def _plain(agent: DQNConfig) -> str:
    """As JSON, in which a list and a tuple are the same."""
    return json.dumps(asdict(agent))


def _rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "ablation.csv", newline="") as f:
        return list(csv.DictReader(f))


@pytest.mark.slow
def test_a_study_leaves_table_summary_and_figure_and_resumes(tmp_path: Path) -> None:
    config = main.config([*SHORT, "only=[tuned,mine]", "+ablations.mine={action_gap: 0.0, batch_size: 8}"])
    ablate(config, tmp_path)
    rows = _rows(tmp_path)
    assert [(r["ablation"], r["seed"]) for r in rows] == [("tuned", "0"), ("tuned", "1"), ("mine", "0"), ("mine", "1")]
    assert rows[0]["regret_pct"] != rows[2]["regret_pct"]
    summary = json.loads((tmp_path / "summary.json").read_text())
    regret = [float(r["regret_pct"]) for r in rows if r["ablation"] == "mine"]
    assert summary["ablations"]["mine"]["regret_pct"]["worst"] == pytest.approx(max(regret))
    assert summary["ablations"]["mine"]["regret_pct"]["median"] == pytest.approx(float(np.median(regret)))
    assert len((tmp_path / "table.md").read_text().splitlines()) == 4
    assert (tmp_path / "figures" / "ablation.png").stat().st_size > 5000

    kept = [line for line in (tmp_path / "ablation.csv").read_text().splitlines() if not line.startswith("mine")]
    (tmp_path / "ablation.csv").write_text("\n".join(kept) + "\n")
    ablate(replace(config, resume=str(tmp_path)), tmp_path)
    assert [r["regret_pct"] for r in _rows(tmp_path)] == [r["regret_pct"] for r in rows]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("only=[nothing]", "only = nothing: allowed tuned"),
        ("+ablations.mine={doubled: true}", r"ablations\.mine\.doubled"),
        ("+ablations.mine={gamma: 2.0}", r"ablations\.mine: agent\.gamma = 2\.0"),
        ("+ablations={bad/name: {}}", r"ablations\.bad/name"),
    ],
)
def test_mistakes_are_one_line(override: str, message: str) -> None:
    with pytest.raises((frame.UserError, ValueError), match=message) as caught:
        main.config([override])
    assert "\n" not in str(caught.value)


def test_every_shipped_variant_differs_from_the_agent_it_starts_from() -> None:
    config = main.config()
    for name, values in config.ablations.items():
        assert (_plain(config.training(name).agent) != _plain(config.agent)) == bool(values), name
    paper = frame.load(frame.compose("ablate", ["agent=paper"]), AblateConfig(ablations={"paper": {}}))
    assert _plain(config.training("paper").agent) == _plain(paper.agent)


def test_summary_by_hand() -> None:
    rows = [Row("a", k, float(k), 0.001 * k, 1.0, 0.0, 5.0) for k in range(5)]
    entry = summarise(rows)["a"]
    assert entry["seeds"] == 5
    assert entry["regret_pct"] == {"median": 2.0, "iqm": 2.0, "worst": 4.0}
    assert entry["steady_abs_error"]["worst"] == pytest.approx(0.004)
