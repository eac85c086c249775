"""The ablation study as a user runs it, and its table against numbers recomputed from the rows."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_module

from dqn.config import DQNConfig
from experiments.cli import frame
from tests.patience import PATIENCE_S
from tests.studies.ablate import AblateConfig, Row, summarise
from tests.studies.variants import variant

pytestmark = pytest.mark.numeric

ROOT = Path(__file__).parents[2]
SHORT = ["agent.total_steps=300", "agent.learn_start=100", "agent.epsilon_steps=100", "eval_every=300", "n_agents=2"]


def _plain(agent: DQNConfig) -> str:
    """As JSON, in which a list and a tuple are the same."""
    return json.dumps(asdict(agent))


def ablate(*overrides: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "tests.studies.ablate", *overrides],
        capture_output=True,
        text=True,
        env=environment,
        timeout=PATIENCE_S,
        check=False,
    )


def test_a_study_leaves_table_summary_and_figure_and_resumes(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    done = ablate(
        *SHORT, "only=[tuned,mine]", "+ablations.mine={action_gap: 0.0, batch_size: 16}", f"hydra.run.dir={folder}"
    )
    assert done.returncode == 0, done.stderr
    with open(folder / "ablation.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    assert [(r["ablation"], r["seed"]) for r in rows] == [("tuned", "0"), ("tuned", "1"), ("mine", "0"), ("mine", "1")]
    assert rows[0]["regret_pct"] != rows[2]["regret_pct"]
    summary = json.loads((folder / "summary.json").read_text())
    regret = [float(r["regret_pct"]) for r in rows if r["ablation"] == "mine"]
    assert summary["ablations"]["mine"]["regret_pct"]["worst"] == pytest.approx(max(regret))
    assert summary["ablations"]["mine"]["regret_pct"]["median"] == pytest.approx(float(np.median(regret)))
    assert len((folder / "table.md").read_text().splitlines()) == 4
    assert (folder / "figures" / "ablation.png").stat().st_size > 5000

    kept = [line for line in (folder / "ablation.csv").read_text().splitlines() if not line.startswith("mine")]
    (folder / "ablation.csv").write_text("\n".join(kept) + "\n")
    again = ablate(f"resume={folder}")
    assert again.returncode == 0, again.stderr
    with open(folder / "ablation.csv", newline="") as f:
        resumed = list(csv.DictReader(f))
    assert [r["regret_pct"] for r in resumed] == [r["regret_pct"] for r in rows]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("only=[nothing]", "only = nothing: allowed tuned"),
        ("+ablations.mine={doubled: true}", r"ablations.mine.doubled: no such key"),
        ("+ablations.mine={gamma: 2.0}", r"ablations.mine: agent.gamma = 2.0"),
    ],
)
def test_mistakes_are_one_line(override: str, message: str) -> None:
    done = ablate(override)
    assert done.returncode == 1
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_every_shipped_variant_differs_from_the_agent_it_starts_from() -> None:
    with initialize_config_module("conf", version_base="1.3"):
        config = frame.load(compose("ablate", return_hydra_config=False), AblateConfig())
    for name, values in config.ablations.items():
        assert (_plain(config.training(name).agent) != _plain(config.agent)) == bool(values), name


def test_the_variant_paper_is_the_agent_paper() -> None:
    with initialize_config_module("conf", version_base="1.3"):
        config = frame.load(compose("ablate"), AblateConfig())
        paper = frame.load(compose("ablate", overrides=["agent=paper"]), AblateConfig(ablations={"paper": {}}))
    assert _plain(config.training("paper").agent) == _plain(paper.agent)


def test_names_that_are_no_folders_are_refused() -> None:
    with pytest.raises(ValueError, match=r"ablations\.bad/name: allowed"):
        AblateConfig(ablations={"bad/name": {}})


def test_lists_become_tuples() -> None:
    changed = variant(DQNConfig(), "x", {"input_matrix": [[1.0, 0.0]], "input_offset": [0.5]})
    assert changed.input_matrix == ((1.0, 0.0),)
    assert hash(changed) is not None


def test_summary_by_hand() -> None:
    rows = [Row("a", k, float(k), 0.001 * k, 1.0, 0.0, 5.0) for k in range(5)]
    entry = summarise(rows)["a"]
    assert entry["seeds"] == 5
    assert entry["regret_pct"] == {"median": 2.0, "iqm": 2.0, "worst": 4.0}
    assert entry["steady_abs_error"]["worst"] == pytest.approx(0.004)
