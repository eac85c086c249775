"""Parts of a training run by hand: what is scored when, what is kept and told, and what a resumed run knows."""

import json
import re
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from dqn import checkpoint, policy
from dqn.checkpoint import CheckpointError
from dqn.config import DQNConfig
from dqn.network import export
from dqn.population import Population
from dqn.replay import Transition
from envs.coculture.optimum import Grid
from envs.coculture.pair import PairConfig
from envs.coculture.task import CocultureConfig, logit, share
from envs.relative import RelativeConfig
from envs.task import EnvConfig, step_factors
from experiments.cli.frame import UserError
from experiments.coculture import config as two_species
from experiments.coculture.task import Coculture
from experiments.laws.density.estimator import EstimatorConfig
from experiments.reporting.verdict import Headline
from experiments.train import main as entry_point
from experiments.training import agents as training_agents
from experiments.training import announcements, tasks
from experiments.training import run as train_run
from experiments.training.config import TrainConfig
from experiments.training.density import DensityTask
from experiments.training.evaluation import Evaluation, Rollout, Score, each
from experiments.training.relative import Relative
from experiments.training.session import BestSoFar, Session, merit
from tests.experiments.test_deploy import inverse_policy
from tests.two_species import EQUAL_RATES_C, e_coli_rate, p_putida_rate

pytestmark = pytest.mark.numeric

SMALL = DQNConfig(hidden=(8,), total_steps=100, learn_start=40, batch_size=8)


def session(folder: Path, resume: bool = False, **changes: Any) -> Session:
    folder.mkdir(exist_ok=True)
    return Session(TrainConfig(**{"agent": SMALL, "checkpoint_every": 1000, **changes}), folder, resume)


def scored(regret: list[float], steady: list[list[float]]) -> Score:
    one = np.ones(len(regret))
    return Score(one, np.array(regret), np.array(steady), one)


@pytest.mark.parametrize(
    ("whole", "regret", "steady", "sent"),
    [
        (True, [0.1], [[0.002]], True), (True, [3.8], [[0.002]], False), (True, [0.1], [[0.02]], True),
        (False, [0.1], [[0.002]], False),  # stopped once it was good enough
        (True, [3.8, 0.1], [[0.002], [0.002]], True),  # the second one is kept
        (True, [3.8, 0.1], [[0.002], [0.02]], True),  # devices refuse for safety, not for its steady error
    ],
)  # fmt: skip
def test_only_a_policy_that_was_trained_to_the_end_and_is_good_is_sent_to_a_proof(
    whole, regret, steady, sent, tmp_path, caplog
):
    score = scored(regret, steady)
    with caplog.at_level("INFO"):
        announcements.ended(tmp_path, DensityTask(EnvConfig()), score, None, "", tmp_path / "policy.npz", whole=whole)
    assert ["experiments.deploy" in caplog.text, "experiments.certify" in caplog.text] == [True, sent]


def test_a_policy_is_scored_and_saved_behind_each_multiple(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of 24 steps, an evaluation every 50, a checkpoint every 100, and both at the end; updates from 40 on."""
    env, agent = EnvConfig(episode_steps=24), replace(SMALL, total_steps=340)
    one = session(tmp_path / "run", env=env, agent=agent, eval_every=50, checkpoint_every=100)
    save, written = checkpoint.save, []
    monkeypatch.setattr(checkpoint, "save", lambda *given: (written.append(one.agents.steps), save(*given)))
    one.run()
    one.writer.close()
    assert written == [120, 216, 312, 340]
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
    best, task = BestSoFar.empty(torch.zeros(2, 3)), DensityTask(EnvConfig())
    each = [
        scored([0.3, 9.0], [[0.002, 0.002], [0.1, 0.3]]),  # 0.67 and 100 units
        scored([5.0, 0.2], [[0.0004, 0.0001], [0.0001, 0.003]]),  # 10 and 1
        scored([0.1, 0.1], [[0.001, 0.02], [0.02, 0.0]]),  # 6.7 and 6.7
        scored([4.0, 8.0], [[0.0, 0.0], [0.0, 0.0]]),
    ]
    for k, score in enumerate(each, 1):
        best.update(100 * k, 7 * k, score, merit(score, task), torch.full((2, 3), float(k)))
    assert best.merit == pytest.approx([2.0 / 3.0, 1.0])
    assert best.steady.tolist() == [0.002, 0.003]
    assert best.regret.tolist() == [0.3, 0.2]
    assert best.step.tolist() == [100, 200]
    assert best.weights.tolist() == [[1.0] * 3, [2.0] * 3]


def scripted(monkeypatch: pytest.MonkeyPatch, one: Session, merits: list[list[float]]) -> list[torch.Tensor]:
    """Give the evaluations of a session these merits, one row each; returns the weights that each of them saw."""
    seen: list[torch.Tensor] = []

    def told(score: Score, task: Any) -> Any:
        seen.append(one.agents.weights())
        return np.array(merits[len(seen) - 1])

    monkeypatch.setattr("experiments.training.session.merit", told)
    return seen


MERITS = [[4.0, 2.1, 0.9], [3.0, 0.7, 2.0], [2.0, 1.5, 2.1], [1.2, 3.0, 2.0]]
"""Of three seeds at steps 48, 72, 96 and 120: the first is best at the end, the second at 72, the third at 48."""
THREE: dict[str, Any] = {
    "n_agents": 3, "seed": 5, "env": EnvConfig(episode_steps=24, setpoints=(0.3, 0.7)),
    "agent": replace(SMALL, total_steps=120), "eval_every": 24,
}  # fmt: skip


def test_the_policy_of_a_run_is_that_of_its_best_seed_at_the_step_at_which_it_was_best(tmp_path, monkeypatch):
    monkeypatch.setattr(train_run, "_figures", Mock())
    one = session(tmp_path / "run", **THREE)
    seen = scripted(monkeypatch, one, MERITS)
    one.run()
    train_run._finish(one)
    one.writer.close()
    assert [step for step, *_ in one.best.history] == [48, 72, 96, 120]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["policy_seed"], summary["kept_step"]) == (6, [120, 72, 48])
    policies = [tmp_path / "run" / "policies" / f"seed000{seed}.npz" for seed in (5, 6, 7)]
    for file, i, when in (*zip(policies, range(3), (3, 1, 0), strict=True), (tmp_path / "run" / "policy.npz", 1, 1)):
        found = policy.load(file)
        step = 48 + 24 * when
        assert [found.metadata[key] for key in ("seed", "trained_steps", "updates")] == [5 + i, step, step - 40]
        np.testing.assert_array_equal(found.weights[0].ravel(), seen[when][i, :16])


def test_a_run_that_may_end_early_is_the_same_run_up_to_the_step_at_which_its_slowest_agent_is_good_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within 2 units: the third seed at 48, the second at 72, the first, just so, at 96; resumed, it stays ended."""
    monkeypatch.setattr(train_run, "_figures", Mock())
    whole, early = (session(tmp_path / name, **THREE, stop_within=w) for name, w in (("whole", None), ("early", 2.0)))
    seen = scripted(monkeypatch, whole, MERITS)
    whole.run()
    scripted(monkeypatch, early, MERITS)
    early.run()
    assert early.best.history == whole.best.history[:3]
    assert torch.equal(early.agents.weights(), seen[2])
    summaries = []
    for one in (early, again := session(tmp_path / "early", resume=True, **THREE, stop_within=2.0)):
        one.run()
        train_run._finish(one)
        one.writer.close()
        summaries.append(json.loads((tmp_path / "early" / "summary.json").read_text()))
    whole.writer.close()
    assert (summaries[0]["env_steps"], summaries[0]["updates"], again.agents.steps) == (96, 56, 96)
    assert summaries[0]["ended"] == early.ended != whole.ended == "agent.total_steps"
    assert early.ended.startswith("every kept policy is within 1 % regret")
    assert summaries[0] == summaries[1]
    again.best.merit[0] = 2.1
    assert again.ended == "agent.total_steps"


def aiming(gain: float) -> torch.Tensor:
    """Weights (P,) for which Q = 2 a v - a^2 of action a is largest nearest to v = 8 + gain (x - setpoint)."""
    first, last, a = torch.zeros(2, 8), torch.zeros(17, 8), torch.arange(17.0)
    first[0, 0] = first[1, 1] = 1.0
    last[:, 0], last[:, 1] = 2.0 * gain * a, -2.0 * gain * a
    return torch.cat([first.ravel(), torch.zeros(8), last.ravel(), 16.0 * a - a * a])


def test_the_summary_names_the_seed_of_the_policy_that_flies_and_has_of_each_what_its_file_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights by hand, with no start at a tie of two actions; the best merit is not that of the least regret."""
    monkeypatch.setattr(train_run, "_figures", Mock())
    one = session(tmp_path / "run", **THREE)
    one.best.weights[:] = torch.stack([aiming(gain) for gain in (71.3, 19.7, 5.9)])
    one.agents.groups[0].agent.network.flat[:] = torch.stack([aiming(gain) for gain in (3.1, 41.7, 9.3)])
    one.best.merit[:], one.best.step[:] = [3.0, 0.9, 2.0], [80, 60, 100]
    train_run._finish(one)
    one.writer.close()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert [summary[key] for key in ("seeds", "policy_seed", "kept_step")] == [[5, 6, 7], 6, [80, 60, 100]]
    assert int(np.argmin(summary["regret_pct"])) == 0
    assert policy.load(Path(summary["policy"])).metadata["seed"] == 6
    report = Evaluation(one.task, one.task.report_grid())
    for i, seed in enumerate((5, 6, 7)):
        learned = policy.load(tmp_path / "run" / "policies" / f"seed000{seed}.npz")
        newest = export(one.agents.network, i, one.agents.weights(), one.task.actions, one.task.limits, {})
        kept, last = report(each(learned)), report(each(newest))
        for key in ("regret_pct", "steady_abs_error", "mean_abs_error"):
            assert summary[key][i] == pytest.approx(getattr(kept, key)[0], rel=1e-3)
        for key in ("regret_pct", "steady_abs_error"):
            assert summary[f"{key}_last"][i] == pytest.approx(getattr(last, key)[0], rel=1e-3)
            assert learned.metadata[key] == summary[key][i]
        np.testing.assert_allclose(summary["steady_abs_error_by_setpoint"][i], kept.steady_by_setpoint[0], rtol=1e-3)
        assert (learned.metadata["seed"], learned.metadata["trained_steps"]) == (seed, (80, 60, 100)[i])
        assert learned.metadata["config_hash"] == summary["config_hash"]
        assert learned.metadata["model"]["setpoints"] == [0.3, 0.7]
    names = ("optimum_cost", "optimum_steady_abs_error", "optimum_mean_abs_error")
    of_optimum = report.optimum_cost, report.optimum_steady, report.optimum_abs_error
    assert [summary[name] for name in names] == pytest.approx(of_optimum)
    assert len(set(of_optimum)) == 3
    myopic = report(one.task.myopic)
    assert summary["myopic_regret_pct"] == pytest.approx(float(myopic.regret_pct[0]))
    assert summary["myopic_steady_abs_error"] == pytest.approx(float(myopic.steady_abs_error[0]))


TASKS = (
    ("sim", "tuned"), ("sim", "paper"), ("relative", "relative"), ("preview", "preview"),
    *(pytest.param(name, name, marks=pytest.mark.slow) for name in ("coculture", "coculture_preview")),
)  # fmt: skip


def population(env: str, agent: str, seeds: Iterable[int], interval: int, threads: int = 1) -> Population:
    """Agents with their presets, small: updates from step 71 on, a full memory, some copies of the target network."""
    words = ["env.episode_steps=24", "agent.learn_start=70", "agent.total_steps=130"]
    words += ["agent.replay_size=60", "agent.target_period=31", "agent.batch_size=16"]
    config = entry_point.config([f"env={env}", f"agent={agent}", *words])
    made = training_agents.population(tasks.of(config.env), config.agent, tuple(seeds), threads=threads)
    for group in made.groups:
        group.interval = interval
    return made


def same(one: Any, other: Any) -> bool:
    """Whether two states, or records, are equal to the bit; nan equals nan."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    return np.array_equal(one, other, equal_nan=isinstance(one, float | np.ndarray))


@pytest.mark.parametrize(("env", "agent"), TASKS)
def test_what_is_resumed_from_a_checkpoint_is_the_uninterrupted_training_to_the_bit(env, agent, tmp_path, monkeypatch):
    """Every task with its agents: from amid an episode before the first update, and twice from among them.

    Two groups of agents; the second life has another number of threads. Records at steps 102 and 119 tell of the same
    look at the loss.
    """
    monkeypatch.setattr(training_agents, "GROUP", 2)
    whole, records = population(env, agent, (3, 4, 9), 17, threads=2), []
    for record in whole.run():
        checkpoint.save(tmp_path / f"{record.step}.pt", whole.state_dict())
        records.append(asdict(record))
    assert [record["step"] for record in records] == [17, 34, 51, 68, 85, 102, 119, 130]
    for k in (2, 5, 6):
        resumed = population(env, agent, (3, 4, 9), 17)
        resumed.load_state_dict(checkpoint.load(tmp_path / f"{17 * k}.pt"))
        assert resumed.steps == 17 * k
        assert same(records[k:], [asdict(record) for record in resumed.run()])
        assert same(whole.state_dict(), resumed.state_dict())


@pytest.mark.parametrize(("env", "agent"), TASKS)
def test_an_agent_of_a_population_is_the_same_seed_alone(env: str, agent: str) -> None:
    """Same episodes, exploration and minibatches; same weights up to rounding after the updates of one step."""
    many, alone = (population(env, agent, seeds, 71) for seeds in ((3, 4, 9, 8, 7), (9,)))
    for each_one in (many, alone):
        next(each_one.run())
    rows = [one.groups[0].agent.replay.state_dict()["rows"] for one in (many, alone)]
    assert torch.equal(rows[0][2], rows[1][0])
    np.testing.assert_allclose(many.weights()[2], alone.weights()[0], atol=2e-5)
    start = population(env, agent, (9,), 71).weights()[0]
    assert not torch.allclose(alone.weights()[0], start, atol=1e-4)
    assert not torch.allclose(many.weights()[2], many.weights()[3])


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


def test_growth_shares_that_are_scored_are_those_that_are_trained_and_a_policy_sees_no_other() -> None:
    """Midpoints of 48 equal cells between 0.4 and 0.9, and places a fifth of a cell before them in 25."""
    task = Relative(RelativeConfig(growth_shares=(0.4, 0.9), largest_error=1.5))
    for grid, shares, place in ((task.report_grid(), 48, 0.5), (task.selection_grid(), 25, 0.3)):
        found, errors = (np.unique(grid[:, k].round(12)) for k in (1, 0))
        np.testing.assert_allclose(found, 0.4 + 0.5 * (np.arange(shares) + place) / shares)
        assert -1.5 < errors[0] < -1.3 < 1.3 < errors[-1] < 1.5
        assert len(grid) == len(found) * len(errors)
    np.testing.assert_allclose(task.limits, [[-1.45, 0.4], [1.45, 0.9]])


def test_a_setpoint_at_which_nothing_rests_is_scored_from_the_nearest_start() -> None:
    """Growth of 7 % a minute, of which the pump takes 6: at no setpoint a culture stays, and at each by other amounts.

    Nothing would ever be kept if one of them had no score.
    """
    env = EnvConfig(mu=0.07, setpoints=(0.2, 0.6, 1.0))
    evaluation = Evaluation(task := DensityTask(env), task.report_grid())
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
    score, kept = scored([4.0, 2.0, 9.0], [[0.03], [0.01], [0.02]]), ([1.0, 0.5, 3.0], [0.004, 0.006, 0.009])
    line = announcements.progress(250, 1000, 60.0, score, tuple(map(np.array, kept)), DensityTask(EnvConfig()))
    assert re.findall(r"[\d.:]*\d", line) == ["25", "3:00", "4.00", "0.0200", "1.00", "0.0060"]


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
    record = Mock(step=120, episode_return=np.array([-1.0, -2.0, -3.0]), curves={"train/mine": 0.5})
    one._log(record)
    step, values = one.writer.scalars.call_args.args
    assert (step, values["speed/steps_per_s"], values["train/mine"]) == (120, 3 * 120 / 8.0, 0.5)
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


def test_the_share_that_is_drawn_as_asked_for_is_that_of_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decision by decision, also at that in which the change comes."""
    monkeypatch.setattr("experiments.coculture.task.FINE", Grid(logits=41))
    drawn: list[Any] = []
    monkeypatch.setattr("experiments.coculture.charts.episodes", lambda *given: drawn.append(given))
    task = Coculture(CocultureConfig(preview_min=120.0, episode_steps=12, control_min=30.0))
    monkeypatch.setattr("experiments.coculture.task.each", lambda _: lambda o: np.zeros(o.shape[:-1], dtype=int))
    best = task.best
    monkeypatch.setattr(task, "best", lambda start: drawn.append(best(start)) or drawn[-1])
    task.figures(inverse_policy())
    optimum, (hours, wanted, ours, theirs, temperature, best_temperature, species) = drawn
    np.testing.assert_allclose(hours, 0.5 * np.arange(1, 13))
    np.testing.assert_allclose(theirs - wanted, optimum.error[:, 0], atol=1e-9)
    assert (np.diff(ours[3:], axis=0) > 0.0).all()  # always at 29 degC, where the second gains
    assert (temperature == 29.0).all()
    np.testing.assert_allclose(best_temperature, 29.0 + 7.0 / 16.0 * optimum.action[:, 0])
    assert species == "P. putida"


class Fading:
    """Errors that an action k leaves as large as k / 4 of them, and an optimum that leaves a fourth."""

    steps, steady_steps, arrived = 4, 3, 0.3

    def advance(self, observation: Any, action: Any) -> tuple[Any, Any]:
        error = observation[..., 0] * action / 4.0
        return np.stack([error, observation[..., 1]], axis=-1), error

    def asked(self, start: Any) -> Any:
        return start[:, 1]

    def best(self, start: Any) -> Rollout:
        error = start[:, 0] * 0.25 ** np.arange(1, 5)[:, None, None]
        return Rollout(error, error, np.ones(error.shape, dtype=np.intp))


def test_scores_of_two_policies_by_hand() -> None:
    """Errors 4 and 8 at setpoint 1 and -2 at setpoint 5; one policy halves them, the other leaves them as they are.

    From 8 the optimum is at 0.5 two steps before the end, beyond 0.3: that start is left out of the steady errors.
    """
    evaluation = Evaluation(Fading(), np.array([[4.0, 1.0], [8.0, 1.0], [-2.0, 5.0]]))
    score = evaluation(lambda seen: np.array([[2], [4]]) * np.ones(seen.shape[:-1], dtype=np.intp), agents=2)
    squares = 4.0**2 + 8.0**2 + 2.0**2
    fade = [sum(kept ** (2 * k) for k in range(1, 5)) for kept in (0.5, 1.0, 0.25)]
    assert score.cost == pytest.approx([squares / 3.0 * fade[0], squares / 3.0 * fade[1]])
    assert evaluation.optimum_cost == pytest.approx(squares / 3.0 * fade[2])
    assert score.regret_pct == pytest.approx([100.0 * (own / fade[2] - 1.0) for own in fade[:2]])
    assert score.steady_by_setpoint.tolist() == [[0.5, 0.25], [4.0, 2.0]]
    assert score.steady_abs_error.tolist() == [0.5, 4.0]
    assert score.mean_abs_error == pytest.approx([14.0 / 3.0 * 0.9375 / 4.0, 14.0 / 3.0])
    assert evaluation.optimum_steady == pytest.approx(0.0625)
    assert evaluation.optimum_abs_error == pytest.approx(14.0 / 3.0 * 0.33203125 / 4.0)


def replaced(task: Any, uniform: list[list[float]], before: list[float], after: list[float]) -> Transition:
    """One transition, given as many other goals as there are rows of uniform numbers."""
    n, relabel = len(uniform), task.hindsight(SMALL)
    seen = [torch.tensor([[o] * n]) for o in (before, after)]
    batch = Transition(seen[0], torch.zeros(1, n, dtype=torch.int64), torch.zeros(1, n), seen[1], torch.ones(1, n))
    relabel.replace(batch, relabel.drawn(torch.tensor([uniform], dtype=torch.float64)))
    return batch


def test_goals_in_hindsight_reach_over_the_setpoints_of_the_task_in_whatever_order_they_are() -> None:
    """0.3 to 0.7, and the reward is that of the OD reached, 0.6, not of the one before."""
    task = DensityTask(EnvConfig(setpoints=(0.5, 0.7, 0.3, 0.6)))
    batch = replaced(task, [[0.0, 0.5], [0.25, 0.5], [1.0, 0.5]], [0.9, 0.5], [0.6, 0.5])
    np.testing.assert_allclose(batch.s_t[0, :, 1], [0.3, 0.4, 0.7], rtol=1e-6)
    np.testing.assert_allclose(batch.r_t[0], [-0.09, -0.04, -0.01], rtol=1e-5)


def test_errors_in_hindsight_reach_as_far_as_those_that_are_trained() -> None:
    task = Relative(RelativeConfig(largest_error=1.5))
    batch = replaced(task, [[0.0, 0.5], [1.0, 0.5]], [0.2, 0.4], [0.5, 0.4])
    np.testing.assert_allclose(batch.s_tm1[0, :, 0], [-1.5, 1.5])
    np.testing.assert_allclose(batch.s_t[0, :, 0], [-1.2, 1.8])
    np.testing.assert_allclose(batch.r_t[0], [-1.44, -3.24], rtol=1e-6)


def test_programs_in_hindsight_are_those_of_the_task() -> None:
    """Setpoints .2 to .6, decisions of 20 min, changes known 20 to 60 min ahead; the cost is that of the share."""
    task = Coculture(CocultureConfig(setpoints=(0.2, 0.6), control_min=20.0, preview_min=60.0))
    uniform = [[0.5, 0.0, 0.5, 1.0, 0.21], [1.0, 1.0, 0.5, 0.0, 0.999]]
    batch = replaced(task, uniform, [0.1, 33.0, 0.8, 0.0, 0.0, 20.0], [0.3, 33.0, 0.8, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(batch.s_t[0, :, 0], [0.0, 3.0])
    np.testing.assert_allclose(batch.s_tm1[0, :, 0], [-0.2, 2.8], rtol=1e-6)
    np.testing.assert_allclose(share(batch.s_tm1[0, :, 3:5]), [[0.2, 0.6], [0.6, 0.2]], rtol=1e-6)
    np.testing.assert_allclose(batch.s_tm1[0, :, 5], [20.0, 60.0])
    np.testing.assert_allclose(batch.s_t[0, :, 5], [0.0, 40.0])
    np.testing.assert_allclose(batch.r_t[0], [-((0.5 - 0.2) ** 2), -((share(3.0) - 0.6) ** 2)], rtol=1e-5)


def test_more_agents_than_a_group_holds_are_the_seeds_that_they_are_called_by() -> None:
    """Eighteen in groups of 16 and 2."""
    task = DensityTask(EnvConfig())
    many = training_agents.population(task, SMALL, range(5, 23), threads=3)
    assert ([group.agent.n_agents for group in many.groups], many.n_agents, many.threads) == ([16, 2], 18, 3)
    for k in (0, 15, 16, 17):
        alone = training_agents.trainer(task, SMALL, [5 + k]).agent.network.flat[0]
        assert torch.equal(many.weights()[k], alone)
    assert [group.interval for group in many.groups] == [EnvConfig().episode_steps] * 2


def test_a_decision_of_a_share_lasts_its_period_and_is_judged_by_the_setpoint_before_a_change() -> None:
    """20 min at 36 degC, long in balance with it: the logit falls by a third of an hour's difference of the rates."""
    task = Coculture(CocultureConfig(control_min=20.0, preview_min=60.0))
    fall = (float(p_putida_rate(36.0)) - float(e_coli_rate(36.0))) / 3.0
    start = np.array([[0.2, 36.0, float(p_putida_rate(36.0)), logit(0.4), logit(0.7), left] for left in (20.0, 40.0)])
    after, error = task.advance(start, np.array([16, 16]))
    np.testing.assert_allclose(after[:, 0], 0.2 + fall)
    np.testing.assert_allclose(error, share(0.2 + fall) - 0.4)
    np.testing.assert_allclose(after[:, 3:], [[logit(0.7), logit(0.7), 0.0], [logit(0.4), logit(0.7), 20.0]])


def test_a_policy_of_a_share_sees_the_edge_of_what_its_task_trains() -> None:
    changes: dict[str, Any] = {"setpoints": (0.2, 0.6), "temperatures": (30.0, 34.0), "control_min": 20.0}
    task = Coculture(CocultureConfig(preview_min=60.0, **changes))
    low, high = (np.delete(end, 2) for end in task.limits)
    np.testing.assert_allclose(low, [-3.0, 30.0, logit(0.2), logit(0.2), 0.0])
    np.testing.assert_allclose(high, [3.0, 34.0, logit(0.6), logit(0.6), 60.0])
    assert (task.actions[0], task.actions[-1]) == (30.0, 34.0)
    assert task.model()["control_min"] == task.model()["model"]["control_min"] == 20.0
    assert task.description == (
        "composition of two species by temperature, a decision every 20 min, setpoints announced 60 min ahead"
    )
    assert (task.regret_unit, Coculture(CocultureConfig()).regret_unit) == (5.0, 0.5)
    assert DensityTask(EnvConfig(control_min=2.5)).model()["control_min"] == 2.5


def test_grids_of_a_share_are_every_start_with_every_setpoint_at_rest() -> None:
    task = Coculture(CocultureConfig())
    for grid, starts, goals in (
        (task.selection_grid(), np.linspace(0.06, 0.94, 8), np.linspace(0.15, 0.85, 8)),
        (task.report_grid(), np.linspace(0.05, 0.95, 19), np.linspace(0.1, 0.9, 9)),
    ):
        found = share(grid[:, [0, 3]])
        np.testing.assert_allclose(found[:, 0], np.repeat(starts, goals.size))
        np.testing.assert_allclose(found[:, 1], np.tile(goals, starts.size))
        np.testing.assert_allclose(grid[:, 1], EQUAL_RATES_C)
        np.testing.assert_allclose(grid[:, 2], float(p_putida_rate(EQUAL_RATES_C)))
    ahead = Coculture(CocultureConfig(preview_min=180.0)).report_grid()
    np.testing.assert_allclose(ahead[:, 0], ahead[:, 3])  # at rest at the first of two setpoints
    assert set(ahead[:, 5]) == {180.0}


def test_the_optimum_of_many_programs_at_once_is_that_of_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty changes, which are more than are taken together, on a coarse grid of shares."""
    monkeypatch.setattr("experiments.coculture.task.FINE", Grid(logits=21))
    task = Coculture(CocultureConfig(n_actions=5, control_min=30.0, preview_min=60.0, episode_steps=3))
    start = task.report_grid()[:30][::-1]
    together = task.best(start)
    for k in (0, 23, 24):
        alone = task.best(start[k : k + 1])
        np.testing.assert_array_equal(together.action[:, 0, k], alone.action[:, 0, 0])
        np.testing.assert_allclose(together.state[:, 0, k], alone.state[:, 0, 0])
        np.testing.assert_allclose(together.error[:, 0, k], alone.error[:, 0, 0])


def test_the_one_line_law_takes_the_rate_after_which_the_model_is_nearest_to_the_setpoint() -> None:
    """u = tau (mu + ln(x / r) / h) in sixteenths of 0.02 mL/s: 38.8, 11.2 and 6.4, by tau 0.4 and h 2 min."""
    task = DensityTask(EnvConfig(mu=0.03, tau=0.4, control_min=2.0))
    seen = np.array([[0.6, 0.5], [0.505, 0.5], [0.49, 0.5]])
    assert task.myopic(seen).tolist() == [16, 11, 6]
    assert task.myopic(seen[None, ::-1] * [[[1.0, 1.0]], [[2.0, 2.0]]]).tolist() == [[6, 11, 16]] * 2


def still(value: Any) -> Any:
    """A policy that never doses, whatever its map is drawn as."""
    return SimpleNamespace(act=lambda seen: np.zeros(len(seen), dtype=np.intp), chosen=value)


def captured(monkeypatch: pytest.MonkeyPatch, *names: str) -> dict[str, tuple[Any, ...]]:
    """What the charts of these names are drawn from."""
    drawn: dict[str, tuple[Any, ...]] = {}
    for name in names:
        monkeypatch.setattr(
            f"experiments.reporting.charts.{name}", lambda *given, name=name: drawn.__setitem__(name, given)
        )
    return drawn


def test_maps_and_trajectories_of_a_density_are_drawn_with_learned_first_and_the_optimum_second(monkeypatch):
    drawn = captured(monkeypatch, "policy_map", "trajectories")
    env = EnvConfig(mu=0.03, tau=0.4, control_min=2.5, episode_steps=60, setpoints=(0.2, 0.3, 0.6, 0.9))
    DensityTask(env).figures(still(lambda seen: 10.0 * seen[:, 0] + seen[:, 1]))
    od, setpoint, learned, best = drawn["policy_map"]
    assert (setpoint[0], setpoint[-1]) == (0.2, 0.9)
    np.testing.assert_allclose(learned, 10.0 * od + setpoint[:, None])
    assert (best[0, -1], best[-1, 0]) == (0.02, 0.0)  # far above its setpoint, and far below
    minutes, ours, theirs, goals, rates, best_rates = drawn["trajectories"]
    assert goals.tolist() == [0.2, 0.6, 0.9] * 2
    assert (minutes[-1], minutes.size, rates.shape) == (150.0, 61, (60, 6))
    np.testing.assert_allclose(ours, ours[0] * step_factors(env)[0] ** np.arange(61)[:, None])
    np.testing.assert_array_equal(theirs[0], ours[0])
    np.testing.assert_allclose(theirs[-1, :2], [0.2, 0.6], rtol=0.01)  # in two hours and a half from 0.1
    assert not rates.any()
    np.testing.assert_allclose(theirs[1:] / theirs[:-1], np.interp(best_rates, env.pump_rates(), step_factors(env)))


def test_maps_and_trajectories_of_a_relative_task_are_drawn_with_learned_first_and_the_optimum_second(monkeypatch):
    """In place of the optimum stands a law that gives the level of the growth share and leaves a tenth of an error."""

    def level(config: RelativeConfig, s: float, steps: int) -> Any:
        def rollout(start: Any) -> tuple[Any, Any]:
            error = start * 0.1 ** np.arange(1, steps + 1)[:, None]
            return error, np.full(error.shape, round(16 * s))

        return SimpleNamespace(act=lambda error, k: np.full(error.shape, round(16 * s)), rollout=rollout)

    monkeypatch.setattr("experiments.training.relative._optimum", level)
    drawn = captured(monkeypatch, "relative_map", "relative_trajectories")
    Relative(RelativeConfig(growth_shares=(0.25, 0.75), largest_error=1.5)).figures(
        still(lambda seen: 10.0 * seen[:, 0] + seen[:, 1])
    )
    error, shares, learned, best = drawn["relative_map"]
    assert (error[0], error[-1], shares[0], shares[-1]) == (-1.5, 1.5, 0.25, 0.75)
    np.testing.assert_allclose(learned, 10.0 * error + shares[:, None])
    np.testing.assert_allclose(best, np.rint(16.0 * shares)[:, None] / 16.0 * np.ones(error.size))
    ours, theirs, goals, levels, best_levels = drawn["relative_trajectories"]
    np.testing.assert_allclose(ours[:3], [ours[0], ours[0] + goals, ours[0] + 2.0 * goals])  # e grows by s
    np.testing.assert_allclose(theirs[:3], [ours[0], 0.1 * ours[0], 0.01 * ours[0]])
    assert not levels.any()
    np.testing.assert_allclose(best_levels, np.rint(16.0 * goals) / 16.0 * np.ones((100, 1)))


def test_a_sweep_is_told_the_merit_of_the_worst_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Mock()
    made.return_value.best.merit = np.array([0.5, 3.0, 1.0])
    monkeypatch.setattr(train_run, "Session", made)
    monkeypatch.setattr(train_run, "_finish", Mock())
    assert train_run.train(TrainConfig(agent=SMALL, n_agents=3), tmp_path) == 3.0
    assert made.call_args.kwargs == {"resume": False}
    train_run.train(TrainConfig(agent=SMALL, resume="latest"), tmp_path)
    assert made.call_args.kwargs == {"resume": True}


def test_the_hash_of_a_policy_is_of_model_and_agent_and_of_nothing_else() -> None:
    config = TrainConfig(agent=SMALL)
    own = train_run.fingerprint(config)
    assert train_run.fingerprint(replace(config, seed=7, n_agents=3, eval_every=9, threads=2, stop_within=1.0)) == own
    assert train_run.fingerprint(replace(config, env=EnvConfig(tau=0.4))) != own
    assert train_run.fingerprint(replace(config, agent=replace(SMALL, gamma=0.9))) != own


@pytest.mark.parametrize("env", [EnvConfig(), RelativeConfig(largest_error=1.5)], ids=["density", "relative"])
def test_a_policy_of_estimates_says_with_which_estimator_it_was_meant(env: Any, tmp_path: Path) -> None:
    config = TrainConfig(agent=SMALL, env=env, n_agents=2, seed=3)
    task = tasks.of(env)
    agents = training_agents.population(task, SMALL, (3, 4))
    best = BestSoFar.empty(agents.weights())
    best.merit[:], best.step[:], best.updates[:] = (2.0, 1.0), (90, 60), (50, 20)
    parts = SimpleNamespace(config=config, best=best, task=task, folder=tmp_path, seeds=(3, 4), agents=agents)
    path, flies = train_run._export(parts, scored([0.3, 0.6], [[0.01, 0.02], [0.001, 0.003]]))  # type: ignore[arg-type]
    said = policy.load(path).metadata
    assert said.get("estimator") == (asdict(EstimatorConfig()) if task.observation == policy.RELATIVE else None)
    assert (said["seed"], said["steady_abs_error"], said["updates"]) == (4, 0.003, 20)
    np.testing.assert_allclose([flies.low, flies.high], np.float32(task.limits))


def test_learning_curves_are_drawn_of_every_agent_and_every_episode_that_ended(tmp_path, monkeypatch):
    """Of two agents; in the first interval no episode ended, in the last one that of the second agent alone."""
    drawn = captured(monkeypatch, "learning")
    monkeypatch.setattr("experiments.reporting.charts.save", lambda figure, folder, name: folder / f"{name}.png")
    history = [(50, [3.0, 4.0], [0.3, 0.4]), (90, [1.0, 2.0], [0.1, 0.2])]
    one = Mock(returns=[[np.nan, np.nan], [-1.0, -2.0], [np.nan, -3.0]], folder=tmp_path)
    one.best.history, one.best.step, one.agents.steps, one.task.figures = history, np.array([90, 50]), 120, lambda _: {}
    train_run._figures(one, inverse_policy())
    episodes, steps, regret, kept = drawn["learning"]
    np.testing.assert_array_equal(episodes, [[-1.0, -2.0], [np.nan, -3.0]])
    assert (steps.tolist(), regret.tolist(), kept.tolist()) == ([50.0, 90.0], [[3.0, 4.0], [1.0, 2.0]], [90.0, 50.0])
    shown = "figures/learning", tmp_path / "figures" / "learning.png", 120
    assert one.writer.events.picture.call_args.args == shown


def test_start_and_end_are_told_with_all_seeds_their_worst_and_the_command_that_follows(tmp_path, caplog):
    """Of two species, resumed at step 40; the following command runs the policy with the pair it is for."""
    task, path = Coculture(CocultureConfig(preview_min=60.0, control_min=20.0)), tmp_path / "policy.npz"
    kept, told = scored([0.1, 0.9, 0.2], [[0.001], [0.002], [0.02]]), Headline("", ["an item"], "a remark")
    with caplog.at_level("INFO"):
        announcements.began(TrainConfig(env=task.config, agent=SMALL), task, range(5, 8), tmp_path, 40)
        announcements.ended(tmp_path, task, kept, told, "spent", path, "pair=pair.yaml")
    learns, good, where, spent, item, remark, written, *following = caplog.messages
    for line, told in (
        (learns, ("coculture", "3 agents", "seeds 5 to 7", "step 40 of 100 steps")), (good, ("5 %", "0.02 ")),
        (where, (str(tmp_path),)), (spent, ("spent",)), (item, ("an item",)), (remark, ("a remark",)),
        (written, (str(path),)),
        (following.pop(), ("pair=pair.yaml", "composition=dqn_preview", f"composition_policy={path}")),
    ):  # fmt: skip
        assert not [word for word in told if word not in line], line
    assert not following


def test_the_table_of_runs_has_of_each_seed_its_own_numbers() -> None:
    writer, found = Mock(agents=[Mock(), Mock()]), scored([0.4, 7.0], [[0.001, 0.002], [0.05, 0.01]])
    announcements.results(writer, 90, found, DensityTask(EnvConfig()), (8, 9))
    for events, regret, error in zip(writer.agents, (0.4, 7.0), (0.002, 0.05), strict=True):
        told = {"result/regret_pct": regret, "result/steady_abs_error": error}
        assert events.scalars.call_args.args == (told, 90)
    _, table, step = writer.events.text.call_args.args
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()]
    assert (rows[-2:], step) == ([["seed 8", "0.400", "0.0020"], ["seed 9", "7.000", "0.0500"]], 90)
    assert ["limit", "0.5", "0.003"] in rows


def test_a_task_of_two_species_takes_growth_curves_and_pair_of_ones_own_and_a_resumed_one_keeps_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The curves by their file, the pair by its name; everything else of the task stays as it was asked for."""
    pair = replace(PairConfig(), second=replace(PairConfig().second, name="B. subtilis"))
    read = Mock(side_effect=lambda file, env: replace(env, scale_e=1.2))
    monkeypatch.setattr(two_species, "read_curves", read)
    monkeypatch.setattr(two_species, "read_pair", lambda name: {"bs.yaml": pair}[name])
    monkeypatch.setattr(train_run, "Session", Mock(side_effect=CheckpointError("far enough")))
    env = CocultureConfig(control_min=20.0)
    with pytest.raises(UserError, match="far enough"):
        train_run.train(TrainConfig(env=env, env_file="run", pair="bs.yaml", agent=SMALL), tmp_path)
    assert read.call_args.args == ("run", env)
    config = train_run.Session.call_args.args[0]  # type: ignore[attr-defined]
    assert config.env == replace(env, scale_e=1.2, pair=pair)
    kept: Any = OmegaConf.load(tmp_path / "config.yaml")
    assert (kept.env_file, kept.env.scale_e, kept.env.pair.second.name) == (None, 1.2, "B. subtilis")
    with pytest.raises(UserError, match="far enough"):
        train_run.train(TrainConfig(env=env, env_file="run", agent=SMALL), tmp_path)
    kept = OmegaConf.load(tmp_path / "config.yaml")
    assert (kept.env_file, kept.env.scale_e, kept.env.pair.second.name) == (None, 1.2, "P. putida")
    monkeypatch.setattr(two_species, "read_pair", Mock(side_effect=UserError("gone, or of another pair by now")))
    with pytest.raises(UserError, match="far enough"):
        train_run.train(replace(config, resume="latest"), tmp_path)
    assert train_run.Session.call_args.args[0].env == config.env  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"pair = bs\.yaml: allowed null for .*; .*env=coculture"):
        TrainConfig(pair="bs.yaml", agent=SMALL)
