"""Training as a user runs it: real processes, real files, real kills.

KILL_SEED=7 python -m pytest tests/experiments/test_train.py tests/campaigns/test_kills.py     kills at other moments
"""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from dqn import checkpoint, policy
from dqn.checkpoint import CheckpointError
from envs.coculture.optimum import Grid
from envs.optimum import solve_episode
from envs.task import EnvConfig, step_factors
from experiments.cli.frame import UserError
from experiments.coculture.base import SEEN, SEEN_AHEAD
from experiments.train import main as entry_point
from experiments.training import agents
from experiments.training import run as train_run
from experiments.training.config import TrainConfig
from experiments.training.density import DensityTask, first_actions
from tests.patience import PATIENCE_S

SHORT = ["agent.total_steps=500", "agent.learn_start=100", "agent.epsilon_steps=400", "eval_every=200"]
SHORT += ["checkpoint_every=200", "n_agents=2", "seed=2"]
KILL_SEED = int(os.environ.get("KILL_SEED", "0"))
ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.xdist_group("train"), pytest.mark.numeric]  # its tests share a run, made once
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def command(*overrides: str) -> list[str]:
    return [sys.executable, "-m", "experiments.train", *overrides]


def run(*overrides: str) -> None:
    done = subprocess.run(
        command(*overrides), capture_output=True, text=True, env=ENVIRONMENT, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One uninterrupted short training with two agents."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    run(*SHORT, f"hydra.run.dir={folder}")
    return folder


@pytest.mark.slow
def test_a_run_leaves_a_summary_and_every_file(whole):
    summary = json.loads((whole / "summary.json").read_text())
    assert summary["seeds"] == [2, 3]
    assert (summary["env_steps"], summary["updates"]) == (500, 400 * 4)  # four updates a step (agent=tuned)
    assert [len(summary[key]) for key in ("regret_pct", "steady_abs_error", "regret_pct_last")] == [2, 2, 2]
    assert summary["train_seconds"] > 0
    assert Path(summary["policy"]).resolve() == (whole / "policy.npz").resolve()
    figures = [f"figures/{name}.{end}" for name in ("learning", "policy_map", "trajectories") for end in ("svg", "png")]
    files = ("config.yaml", "progress.csv", "checkpoint.pt", "policy.npz")
    for name in (*files, "policies/seed0002.npz", "policies/seed0003.npz", *figures):
        assert (whole / name).is_file(), name


@pytest.mark.slow
def test_killed_at_a_random_moment_and_resumed_gives_the_same_weights(whole, tmp_path):
    rng = np.random.default_rng(KILL_SEED)
    folder = tmp_path / "killed"
    process = subprocess.Popen(
        command(*SHORT, f"hydra.run.dir={folder}"),
        env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    while not (folder / "checkpoint.pt").is_file():
        assert process.poll() is None
        time.sleep(0.005)
    time.sleep(float(rng.uniform(0.0, 0.6)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    run(f"resume={folder}")
    a, b = checkpoint.load(whole / "checkpoint.pt"), checkpoint.load(folder / "checkpoint.pt")
    ours, theirs = (c["agents"]["groups"][0]["agent"] for c in (a, b))
    for key in ("online", "target"):
        assert torch.equal(ours[key], theirs[key])
    assert torch.equal(ours["replay"]["rows"], theirs["replay"]["rows"])
    assert torch.equal(a["best"]["weights"], b["best"]["weights"])
    assert a["returns"] == b["returns"]
    first, second = (
        [line for line in (run / "progress.csv").read_text().splitlines() if ",speed/" not in line]
        for run in (whole, folder)
    )
    assert first == second


def test_the_optimums_map_is_that_of_each_setpoint_solved_alone():
    """Three setpoints on a grid four times as fine: other actions in less than 1 % of the cells, by one level."""
    env = EnvConfig(mu=0.025)
    od, setpoint = np.linspace(0.05, 1.25, 241), np.array([0.2, 0.55, 1.0])
    x, s = (a.ravel() for a in np.meshgrid(od, setpoint))
    expected = np.concatenate([solve_episode(env, float(goal), 5e-4).act(od, env.episode_steps) for goal in setpoint])
    difference = np.abs(first_actions(env, x, s) - expected)
    assert difference.max() <= 1
    assert np.mean(difference > 0) < 0.01
    assert len(np.unique(expected)) > 12


def test_selection_and_report_share_no_start():
    config = EnvConfig()
    kept = {(round(a, 9), round(b, 9)) for a, b in DensityTask(config).selection_grid()}
    reported = {(round(a, 9), round(b, 9)) for a, b in DensityTask(config).report_grid()}
    assert len(reported) == 41 * 9
    assert not kept & reported


def test_what_is_remembered_follows_the_model_also_at_the_end_of_an_episode():
    """x' = f(u) x towards the same setpoint in every transition of six episodes, and nothing is final."""
    env = EnvConfig(episode_steps=5)
    trainer = agents.trainer(DensityTask(env), TrainConfig().agent, range(3))
    trainer._observation, _ = trainer.env.reset()
    for _ in range(30):
        trainer._step()
    x, goal, reached, same, action, reward, continues = trainer.agent.replay.state_dict()["rows"].double().numpy().T
    np.testing.assert_allclose(reached, x * step_factors(env)[action.astype(int)], rtol=1e-6)
    np.testing.assert_array_equal(goal, same)
    np.testing.assert_allclose(reward, -((reached - goal) ** 2), rtol=1e-4, atol=1e-6)
    assert (continues == 1.0).all()
    assert len(np.unique(goal)) > 3


@pytest.mark.parametrize(
    ("mu", "tau", "outgrown"),
    [(0.03, 1 / 3, False), (0.059, 1 / 3, False), (0.061, 1 / 3, True), (0.03, 0.66, False), (0.03, 0.67, True)],
)
def test_a_culture_that_outgrows_the_pump_is_said_before_it_is_trained_on(mu, tau, outgrown, monkeypatch, caplog):
    """The largest rate, 0.02 mL/s, thins by 0.02 / tau a minute."""
    monkeypatch.setattr(train_run, "Session", Mock(side_effect=CheckpointError("far enough")))
    config = TrainConfig(env=EnvConfig(mu=mu, tau=tau))
    with pytest.raises(UserError, match="far enough"):
        train_run.train(config, Path())
    assert [f"env.mu = {mu:g} 1/min outgrows the pump" in m for m in caplog.messages] == [True] * outgrown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env=coculture_preview", "agent=tuned"], r"rows of 2 numbers, but this task observes 6"),
        (
            ["agent.total_steps=300", "agent.learn_start=300"],
            r"agent.learn_start = 300: allowed 0 to 299, below agent.total_steps",
        ),
    ],
    ids=["of another task", "never learns"],
)
def test_an_agent_that_cannot_learn_the_task_is_refused_before_it_trains(words, said, tmp_path):
    with pytest.raises(UserError, match=said):
        train_run.train(entry_point.config(words), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coculture", "coculture_preview"])
def test_a_composition_is_trained_scored_and_exported(tmp_path, name, monkeypatch):
    """A few hundred steps: what is written, that the file says what the summary says, the figure what was measured.

    The optimum is found on a coarse grid of shares.
    """
    monkeypatch.setattr("experiments.coculture.task.FINE", Grid(logits=41))
    drawn, save = {}, train_run.charts.save

    def kept(figure, folder, name):
        drawn[name] = figure
        return save(figure, folder, name)

    monkeypatch.setattr(train_run.charts, "save", kept)
    words = ["agent.total_steps=240", "agent.learn_start=100", "agent.updates_per_step=1", "eval_every=120"]
    train_run.train(entry_point.config([f"env={name}", *words]), tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    learned = policy.load(tmp_path / "policy.npz")
    assert learned.observation == (SEEN if name == "coculture" else SEEN_AHEAD)
    assert learned.actions.tolist() == np.linspace(29.0, 36.0, 17).tolist()
    assert learned.metadata["regret_pct"] == pytest.approx(summary["regret_pct"][0])
    assert (summary["myopic_regret_pct"] > 300.0) == (name == "coculture_preview")
    assert (tmp_path / "figures" / "trajectories.png").exists()
    with open(tmp_path / "progress.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    left, right = (ax.lines[0].get_data() for ax in drawn["learning"].axes)
    regrets = [(int(row["step"]), float(row["value"])) for row in rows if row["tag"] == "eval/regret_pct"]
    assert [step for step, _ in regrets] == right[0].tolist()
    assert [regret for _, regret in regrets] == pytest.approx(right[1].tolist())
    costs = [-float(row["value"]) for row in rows if row["tag"] == "train/return"]
    assert costs == pytest.approx(left[1].tolist())
