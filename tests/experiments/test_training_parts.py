"""Parts of a training run by hand: what is scored when, what is kept and told, and what a resumed run knows."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from dqn import checkpoint, policy
from dqn.checkpoint import CheckpointError
from dqn.config import DQNConfig
from envs.coculture.task import CocultureConfig
from envs.relative import RelativeConfig
from envs.task import EnvConfig, step_factors
from experiments.cli.frame import UserError
from experiments.training import announcements, build
from experiments.training import run as train_run
from experiments.training.coculture import Coculture
from experiments.training.config import TrainConfig
from experiments.training.density import Density
from experiments.training.evaluation import Evaluation, Score
from experiments.training.relative import Relative
from experiments.training.session import Best, Session, merit
from tests.experiments.test_deploy import inverse_policy

SMALL = DQNConfig(hidden=(8,), total_steps=100, learn_start=40, batch_size=8)


def session(folder: Path, resume: bool = False, **changes: Any) -> Session:
    folder.mkdir(exist_ok=True)
    return Session(TrainConfig(**{"agent": SMALL, "checkpoint_every": 1000, **changes}), folder, resume)


def scored(regret: list[float], steady: list[list[float]]) -> Score:
    one = np.ones(len(regret))
    return Score(one, np.array(regret), np.array(steady), one)


@pytest.mark.parametrize("whole", [True, False])
def test_a_training_that_stopped_once_it_was_good_enough_is_not_sent_to_a_proof(
    whole: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    score = scored([0.1], [[0.002]])
    with caplog.at_level("INFO"):
        announcements.ended(tmp_path, Density(EnvConfig()), score, score, "", tmp_path / "policy.npz", whole=whole)
    assert any("next, try it: python -m experiments.deploy" in line for line in caplog.messages)
    assert any("experiments.certify" in line for line in caplog.messages) == whole


def test_a_policy_is_scored_by_the_first_episode_that_ends_behind_each_multiple(tmp_path: Path) -> None:
    """Episodes of 24 steps, an evaluation every 50, and one at the end; updates begin at step 40."""
    env, agent = EnvConfig(episode_steps=24), replace(SMALL, total_steps=340)
    one = session(tmp_path / "run", env=env, agent=agent, eval_every=50, checkpoint_every=100)
    one.run()
    one.writer.close()
    assert [step for step, *_ in one.best.history] == [72, 120, 168, 216, 264, 312, 340]
    assert len(one.returns) == len([*range(24, 340, 24), 340])
    saved = checkpoint.load(tmp_path / "run" / "checkpoint.pt")
    again = session(tmp_path / "run", resume=True, env=env, agent=agent, eval_every=50)
    again.writer.close()
    assert again.seconds == saved["seconds"] > 0.0
    assert again.best.history == one.best.history
    for name in ("merit", "regret", "steady", "step"):
        np.testing.assert_array_equal(getattr(again.best, name), getattr(one.best, name))


def test_what_is_kept_is_told_of_the_policy_that_is_kept() -> None:
    """The last one has a smaller steady error, of another one the regret is smaller; neither is better."""
    best, task = Best.empty(torch.zeros(2, 3)), Density(EnvConfig())
    each = [
        scored([0.3, 9.0], [[0.002, 0.002], [0.1, 0.3]]),  # 0.67 and 100 units
        scored([5.0, 0.2], [[0.0004, 0.0001], [0.0001, 0.003]]),  # 10 and 1
        scored([0.1, 0.1], [[0.001, 0.02], [0.02, 0.0]]),  # 6.7 and 6.7
        scored([4.0, 8.0], [[0.0, 0.0], [0.0, 0.0]]),
    ]
    for k, score in enumerate(each, 1):
        best.update(100 * k, score, merit(score, task), torch.full((2, 3), float(k)))
    assert best.merit == pytest.approx([2.0 / 3.0, 1.0])
    assert best.steady.tolist() == [0.002, 0.003]
    assert best.regret.tolist() == [0.3, 0.2]
    assert best.step.tolist() == [100, 200]
    assert best.weights.tolist() == [[1.0] * 3, [2.0] * 3]


@pytest.mark.parametrize(
    ("merits", "met"), [([0.9, 0.8, 1.1], False), ([1.1, 0.9, 0.9], False), ([1.0, 0.2, 0.9], True)]
)
def test_a_training_of_several_ends_when_the_last_of_them_is_good_enough(
    merits: list[float], met: bool, tmp_path: Path
) -> None:
    one = session(tmp_path / "run", n_agents=3, stop_within=1.0)
    one.writer.close()
    one.best.merit[:] = merits
    assert one.met() == met
    assert one.ended.startswith("every kept policy is within 1 times" if met else "agent.total_steps")


def test_the_policy_that_flies_is_of_least_merit_also_where_another_seed_has_less_regret(tmp_path: Path) -> None:
    one = session(tmp_path / "run", n_agents=3, seed=5)
    one.writer.close()
    one.best.merit[:] = [3.0, 0.9, 2.0]
    one.best.step[:] = [80, 60, 100]
    score = scored([0.1, 0.45, 0.2], [[0.009], [0.002], [0.006]])
    path, flies = train_run._export(one, score)
    found = policy.load(path).metadata
    assert (flies.metadata["seed"], found["seed"], found["trained_steps"], found["regret_pct"]) == (6, 6, 60, 0.45)
    for seed, regret, step in ((5, 0.1, 80), (6, 0.45, 60), (7, 0.2, 100)):
        metadata = policy.load(tmp_path / "run" / "policies" / f"seed000{seed}.npz").metadata
        assert (metadata["seed"], metadata["regret_pct"], metadata["trained_steps"]) == (seed, regret, step)


def test_the_summary_names_the_seed_of_the_policy_that_flies(tmp_path: Path) -> None:
    """Here not the one with the least regret on the reported grid, whichever that is."""
    agent, env = replace(SMALL, total_steps=60), EnvConfig(episode_steps=24, setpoints=(0.3, 0.7))
    one = session(tmp_path / "run", n_agents=3, seed=5, agent=agent, env=env, eval_every=30)
    one.run()
    least = int(one.report()[1].regret_pct.argmin())
    other = (least + 1) % 3
    one.best.merit[:] = [4.0 - 3.0 * (i == other) for i in range(3)]
    train_run._finish(one)
    one.writer.close()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["seeds"], summary["policy_seed"]) == ([5, 6, 7], 5 + other)
    assert policy.load(tmp_path / "run" / "policy.npz").metadata["seed"] == 5 + other


@pytest.mark.parametrize(
    ("regret", "steady", "said"),
    [
        ([0.1, 0.5, 0.2], [0.001, 0.002, 0.003], "within the limits of 0.5 % regret and 0.003 OD at rest"),
        ([0.1, 0.2, 0.9], [0.001, 0.001, 0.001], "beyond the limit of 0.5 % regret, within that of 0.003 OD at rest"),
        ([0.1, 0.2, 0.3], [0.02, 0.001, 0.001], "within the limit of 0.5 % regret, beyond that of 0.003 OD at rest"),
        ([0.6, 0.2, 0.3], [0.001, 0.004, 0.001], "beyond the limit of 0.5 % regret, beyond that of 0.003 OD at rest"),
    ],
)
def test_the_last_line_is_about_the_worst_of_all_seeds(regret: list[float], steady: list[float], said: str) -> None:
    score = scored(regret, [[0.0, each] for each in steady])
    assert announcements._verdict(score, Density(EnvConfig())) == said


def test_a_resumed_training_goes_on_with_the_model_that_it_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The calibration's folder may be gone, or hold another model, by then."""
    monkeypatch.setattr(train_run, "Session", Mock(side_effect=CheckpointError("far enough")))
    file = tmp_path / "calibrated.yaml"
    file.write_text("mu: 0.02\ntau: 0.4\n")
    with pytest.raises(UserError, match="far enough"):
        train_run.train(TrainConfig(env_file=str(file), agent=SMALL), tmp_path)
    kept: Any = OmegaConf.load(tmp_path / "config.yaml")
    assert (kept.env_file, kept.env.mu, kept.env.tau) == (None, 0.02, 0.4)
    assert train_run.Session.call_args.args[0].env == EnvConfig(mu=0.02, tau=0.4)  # type: ignore[attr-defined]


def test_episodes_with_a_change_are_grouped_by_the_share_at_which_they_rest() -> None:
    """Each reported pair of setpoints once; the second of the two is asked for at the end."""
    task = Coculture(CocultureConfig(preview_min=360.0))
    grid = task.report_grid()
    asked = task.asked(grid)
    last = grid.copy()
    for _ in range(task.steps):
        last, _ = task.advance(last, np.zeros(len(last), dtype=int))
    np.testing.assert_allclose(asked, last[:, 3], atol=1e-6)
    assert not np.allclose(asked, grid[:, 3])
    assert {int((asked == goal).sum()) for goal in np.unique(asked)} == {8}
    plain = Coculture(CocultureConfig())
    np.testing.assert_allclose(plain.asked(plain.report_grid()), plain.report_grid()[:, 3], atol=1e-9)


@pytest.mark.parametrize("control_min", [1.0, 2.5])
def test_trajectories_are_drawn_over_minutes(control_min: float) -> None:
    """The culture is on the line where the model has it, decision by decision."""
    env = EnvConfig(control_min=control_min, episode_steps=20, setpoints=(0.3, 0.5, 0.8))
    drawn = Density(env).figures(inverse_policy(control_min))["trajectories"]
    top, bottom = drawn.axes[1], drawn.axes[4]
    lines = {str(line.get_label()): line for line in top.get_lines()}
    for start in env.start_od:
        minutes, od = lines[f"learned, from {start:g}"].get_data()
        np.testing.assert_allclose(minutes, control_min * np.arange(21))
        u = np.clip(0.01 + 0.1 * (start - 0.5), 0.0, 0.02)
        levels = env.pump_rates()
        nearest = int(np.abs(levels - u).argmin())
        assert np.asarray(od)[1] == pytest.approx(start * step_factors(env)[nearest], rel=0.01)
    for line in bottom.get_lines():
        np.testing.assert_allclose(np.asarray(line.get_xdata()), control_min * np.arange(20))


def test_growth_shares_that_are_scored_are_those_that_are_trained() -> None:
    """Midpoints of 48 equal cells between 0.4 and 0.9, and places a fifth of a cell before them in 25."""
    task = Relative(RelativeConfig(growth_shares=(0.4, 0.9), largest_error=1.5))
    for grid, shares, place in ((task.report_grid(), 48, 0.5), (task.selection_grid(), 25, 0.3)):
        found = np.unique(grid[:, 1].round(12))
        np.testing.assert_allclose(found, 0.4 + 0.5 * (np.arange(shares) + place) / shares)
        errors = np.unique(grid[:, 0].round(12))
        assert -1.5 < errors[0] < -1.3
        assert 1.3 < errors[-1] < 1.5
        assert len(grid) == len(found) * len(errors)


def test_a_setpoint_at_which_nothing_rests_is_scored_from_the_nearest_start() -> None:
    """Growth of 7 % a minute, of which the pump takes 6: at no setpoint a culture stays, and at each by other amounts.

    Nothing would ever be kept if one of them had no score.
    """
    env = EnvConfig(mu=0.07, setpoints=(0.2, 0.6, 1.0))
    evaluation = Evaluation(task := Density(env), task.report_grid())
    score = evaluation(task.myopic)
    assert score.steady_by_setpoint.shape == (1, 3)
    assert np.isfinite(score.steady_by_setpoint).all()
    assert np.isfinite(merit(score, task)).all()


@pytest.mark.parametrize(("each", "start"), [(1, 0), (4, 200), (3, 500)])
def test_the_learning_rate_falls_in_the_second_half_of_the_updates_to_its_end(each: int, start: int) -> None:
    """From 1e-3 to 1e-5, so that it is 1e-4 three quarters through; updates are as many as a step makes."""
    config = DQNConfig(
        learning_rate=1e-3, learning_rate_end=1e-5, total_steps=1000, learn_start=max(start, 1), updates_per_step=each
    )
    updates = each * (1000 - max(start, 1))
    found = [config.learning_rate_at(round(part * updates)) for part in (0.0, 0.3, 0.5, 0.75, 1.0)]
    assert found == pytest.approx([1e-3, 1e-3, 1e-3, 1e-4, 1e-5], rel=0.01)
    assert replace(config, learning_rate_end=None).learning_rate_at(updates) == 1e-3


def test_progress_tells_the_time_left_what_is_scored_and_what_is_kept() -> None:
    """A quarter done in a minute: three are left. Medians over three agents."""
    score = scored([4.0, 2.0, 9.0], [[0.03], [0.01], [0.02]])
    kept = np.array([1.0, 0.5, 3.0]), np.array([0.004, 0.006, 0.009])
    assert announcements.progress(250, 1000, 60.0, score, kept, Density(EnvConfig())) == (
        "25 %, 3:00 min left: selection grid: 4.00 % regret, 0.0200 OD steady error; "
        "kept: 1.00 % regret, 0.0060 OD steady error"
    )


def test_speed_and_time_left_of_a_resumed_training_count_its_earlier_life(tmp_path: Path) -> None:
    """An hour before, and less than that now: 200 steps are done, and it took an hour."""
    one = session(tmp_path / "run", checkpoint_every=1)
    one.run()
    one.seconds = 3600.0
    one._save()
    one.writer.close()
    again = session(tmp_path / "run", resume=True, agent=replace(SMALL, total_steps=200))
    again.run()
    again.writer.close()
    assert 3600.0 < again.seconds < 7200.0
    rows = [line.split(",") for line in (tmp_path / "run" / "progress.csv").read_text().splitlines()]
    speeds = {int(row[0]): float(row[-1]) for row in rows if "speed/steps_per_s" in row}
    assert speeds[200] == pytest.approx(200 / 3600.0, rel=0.5)


def test_curves_show_speed_of_all_agents_limits_and_what_is_kept(tmp_path: Path) -> None:
    one = session(tmp_path / "run", n_agents=3)
    one.writer.close()
    one.writer, one.seconds = Mock(), 8.0
    record = Mock(step=120, episode_return=np.array([-1.0, -2.0, -3.0]))
    one._log(record)
    step, values = one.writer.scalars.call_args.args
    assert (step, values["speed/steps_per_s"]) == (120, 3 * 120 / 8.0)
    assert values["train/return"].tolist() == one.returns[-1] == [-1.0, -2.0, -3.0]
    one.best.merit[0] = 0.0  # of the first agent nothing better comes
    one.best.regret[0], one.best.steady[0] = 0.2, 0.001
    score = one.evaluate(200)
    step, values = one.writer.scalars.call_args.args
    assert step == 200
    for key, now in (("regret_pct", score.regret_pct), ("steady_abs_error", score.steady_abs_error)):
        np.testing.assert_array_equal(values[f"eval/{key}"], now)
        np.testing.assert_array_equal(values[f"kept/{key}"][1:], now[1:])
    assert (values["kept/regret_pct"][0], values["kept/steady_abs_error"][0]) == (0.2, 0.001)
    limits = {"limit/regret_pct": 0.5, "limit/steady_abs_error": 0.003}
    assert one.writer.events.scalars.call_args.args == (limits, 200)


def test_the_summary_tells_the_kept_policies_from_the_last_ones(tmp_path: Path) -> None:
    one = session(tmp_path / "run", n_agents=2, seed=4)
    one.evaluate(50)
    one.returns = [[-1.0, -2.0], [-1.0, -1.5]]
    one.best.weights[:] = 0.1 * one.best.weights.flip(0)
    report = Evaluation(one.task, one.task.report_grid())
    kept, last = (report(build.act_with(one.agents.network, w), 2) for w in (one.best.weights, one.agents.weights()))
    assert not np.allclose(kept.regret_pct, last.regret_pct)
    train_run._finish(one)
    one.writer.close()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["seeds"], summary["kept_step"]) == ([4, 5], [50, 50])
    assert summary["regret_pct"] == pytest.approx(kept.regret_pct)
    assert summary["steady_abs_error"] == pytest.approx(kept.steady_abs_error)
    assert summary["mean_abs_error"] == pytest.approx(kept.mean_abs_error)
    assert summary["regret_pct_last"] == pytest.approx(last.regret_pct)
    assert summary["steady_abs_error_last"] == pytest.approx(last.steady_abs_error)


def test_a_relative_policy_sees_the_edge_of_its_training_beyond_it() -> None:
    low, high = Relative(RelativeConfig(growth_shares=(0.1, 0.9), largest_error=1.5)).limits
    assert (low.tolist(), high.tolist()) == (pytest.approx([-1.45, 0.1]), pytest.approx([1.45, 0.9]))


def test_the_share_that_is_drawn_as_asked_for_is_that_of_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decision by decision, also at that in which the change comes."""
    drawn: list[Any] = []
    monkeypatch.setattr("experiments.reporting.composition_charts.episodes", lambda *given: drawn.append(given))
    task = Coculture(CocultureConfig(preview_min=120.0, episode_steps=12, control_min=30.0))
    monkeypatch.setattr("experiments.training.coculture.each", lambda _: lambda o: np.zeros(o.shape[:-1], dtype=int))
    best = task.best
    monkeypatch.setattr(task, "best", lambda start: drawn.append(best(start)) or drawn[-1])
    task.figures(inverse_policy())
    optimum, (hours, wanted, _, theirs, *_) = drawn
    np.testing.assert_allclose(hours, 0.5 * np.arange(1, 13))
    np.testing.assert_allclose(theirs - wanted, optimum.error[:, 0], atol=1e-9)
