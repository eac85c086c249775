"""Training as a user runs it: real processes, real files, real kills.

KILL_SEED=7 python -m pytest tests/experiments/test_train.py tests/campaigns/test_kills.py     kills at other moments
"""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing import plugin_event_accumulator as shown
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from conf import presets
from dqn import checkpoint, policy
from dqn.checkpoint import CheckpointError
from dqn.config import DQNConfig
from envs.optimum import solve_episode
from envs.task import EnvConfig, step_factors
from experiments.cli.frame import UserError
from experiments.train import main as entry_point
from experiments.training import build
from experiments.training import run as train_run
from experiments.training.config import TrainConfig
from experiments.training.density import Density, first_actions
from experiments.training.evaluation import Evaluation, Score, each
from experiments.training.session import Best, Session, merit
from tests.patience import PATIENCE_S

SHORT = [
    "agent.total_steps=1000",
    "agent.learn_start=100",
    "agent.epsilon_steps=500",
    "eval_every=200",
    "checkpoint_every=200",
]
TWO = ["n_agents=2", "seed=2"]  # of which the second becomes the better one, and is best before the end
KILL_SEED = int(os.environ.get("KILL_SEED", "0"))
ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.xdist_group("train"), pytest.mark.numeric]  # its tests share a run, made once
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def command(entry: str, *overrides: str) -> list[str]:
    return [sys.executable, "-m", f"experiments.{entry}", *overrides]


def run(entry: str, *overrides: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(entry, *overrides), capture_output=True, text=True, env=ENVIRONMENT, timeout=PATIENCE_S, cwd=cwd
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One uninterrupted short training with two agents."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    done = run("train", *SHORT, *TWO, f"hydra.run.dir={folder}")
    assert done.returncode == 0, done.stderr
    return folder


def test_summary_has_its_keys(whole):
    summary = json.loads((whole / "summary.json").read_text())
    assert summary["seeds"] == [2, 3]
    assert summary["env_steps"] == 1000
    assert summary["updates"] == 900 * 4  # four updates a step (agent=tuned)
    for key in ("regret_pct", "steady_abs_error", "regret_pct_last"):
        assert len(summary[key]) == 2
    assert summary["train_seconds"] > 0
    assert Path(summary["policy"]).is_file()


def test_every_file_is_there(whole):
    names = {p.relative_to(whole).as_posix() for p in whole.rglob("*")}
    for name in (
        "config.yaml",
        "progress.csv",
        "checkpoint.pt",
        "policy.npz",
        "policies/seed0002.npz",
        "policies/seed0003.npz",
    ):
        assert name in names
    for figure in ("learning", "policy_map", "trajectories"):
        assert f"figures/{figure}.svg" in names
        assert f"figures/{figure}.png" in names


def test_tensorboard_reads_grouped_scalars_and_figures(whole):
    events = EventAccumulator(str(whole)).Reload()
    tags = set(events.Tags()["tensors"])
    for tag in ("train/return", "train/loss", "q/min", "q/max", "eval/regret_pct", "eval/steady_abs_error"):
        assert {f"{tag}/iqm", f"{tag}/min", f"{tag}/max"} <= tags
    assert {"train/epsilon", "speed/steps_per_s"} <= tags
    for name in ("learning", "policy_map", "trajectories"):  # drawn once: TensorBoard has the PNG of the folder
        (image,) = events.Tensors(f"figures/{name}")
        assert image.tensor_proto.string_val[2] == (whole / "figures" / f"{name}.png").read_bytes()
    single = EventAccumulator(str(whole / "agents" / "seed0003")).Reload()
    assert [e.step for e in single.Tensors("train/return")] == list(range(100, 1001, 100))


def test_the_summary_can_be_recomputed_from_the_exported_policy(whole):
    summary = json.loads((whole / "summary.json").read_text())
    config = EnvConfig()
    task = Density(config)
    report = Evaluation(task, task.report_grid())
    for i, seed in enumerate(summary["seeds"]):
        learned = policy.load(whole / "policies" / f"seed{seed:04d}.npz")
        score = report(each(learned))
        assert score.regret_pct[0] == pytest.approx(summary["regret_pct"][i], rel=1e-3)
        assert score.steady_abs_error[0] == pytest.approx(summary["steady_abs_error"][i], rel=1e-3)
        assert score.mean_abs_error[0] == pytest.approx(summary["mean_abs_error"][i], rel=1e-3)


def test_a_policy_file_says_what_a_reactor_is_told_before_it_runs(whole):
    """Regret and steady error as in the summary, setpoints, and updates: four a step after step 100."""
    summary = json.loads((whole / "summary.json").read_text())
    for i, seed in enumerate(summary["seeds"]):
        metadata = policy.load(whole / "policies" / f"seed{seed:04d}.npz").metadata
        assert metadata["updates"] == 4 * (summary["kept_step"][i] - 100)
        assert metadata["regret_pct"] == summary["regret_pct"][i]
        assert metadata["steady_abs_error"] == summary["steady_abs_error"][i]
        assert metadata["steady_abs_error"] == max(summary["steady_abs_error_by_setpoint"][i])
        assert metadata["model"]["setpoints"] == list(EnvConfig().setpoints)
    assert DQNConfig(learn_start=100, updates_per_step=4).updates_at(100) == 0


def test_a_policy_with_an_offset_at_one_setpoint_gives_way_to_one_without():
    """0.0005 OD at eight setpoints and 0.012 at one, then 0.0025 at all of them, then the offset again."""
    offset, even = np.full((1, 9), 0.0005), np.full((1, 9), 0.0025)
    offset[0, 3] = 0.012
    best = Best.empty(torch.zeros(1, 2))
    for step, steady in ((100, offset), (200, even), (300, offset)):
        score = Score(np.ones(1), np.full(1, 0.1), steady, np.zeros(1))
        best.update(step, score, merit(score, Density(EnvConfig())), torch.full((1, 2), float(step)))
    assert (best.step.tolist(), best.steady.tolist(), best.weights.tolist()) == ([200], [0.0025], [[200.0, 200.0]])


def test_the_policy_of_a_run_is_that_of_its_best_seed_and_says_so(whole):
    """Which seed and which step, by hand from every evaluation: the second seed, and before the run's end."""
    history = checkpoint.load(whole / "checkpoint.pt")["best"]["history"]
    far = np.array([[max(r / 0.5, s / 0.003) for r, s in zip(*scores, strict=True)] for _, *scores in history])
    steps, chosen = [history[k][0] for k in far.argmin(axis=0)], int(far.min(axis=0).argmin())
    assert chosen == 1
    assert steps[0] != steps[1] < 1000
    summary = json.loads((whole / "summary.json").read_text())
    assert (summary["policy_seed"], summary["kept_step"]) == (3, steps)
    files = [whole / "policies" / f"seed000{seed}.npz" for seed in (2, 3)]
    for file, seed, step in ((files[0], 2, steps[0]), (files[1], 3, steps[1]), (whole / "policy.npz", 3, steps[1])):
        metadata = policy.load(file).metadata
        assert (metadata["seed"], metadata["trained_steps"]) == (seed, step)
        assert metadata["updates"] == 4 * (step - 100)
    flies, *each_seed = (policy.load(file) for file in (whole / "policy.npz", *files))
    assert [np.array_equal(flies.weights[0], other.weights[0]) for other in each_seed] == [False, True]


def _limits(history) -> list[float]:
    """Of every evaluation, how far the kept policy of the slower agent is from the limits, in units of them."""
    each = [[max(r / 0.5, s / 0.003) for r, s in zip(*scores, strict=True)] for _, *scores in history]
    return np.minimum.accumulate(np.array(each), axis=0).max(axis=1).tolist()


def test_training_ends_when_every_agent_has_met_the_limits(whole, tmp_path):
    """Where it ends follows from the history of the run that was not to end; up to there it is the same run."""
    full = checkpoint.load(whole / "checkpoint.pt")["best"]
    far = _limits(full["history"])
    k = next(k for k in range(2, len(far)) if far[k] < far[k - 1])
    within = (far[k - 1] + far[k]) / 2
    assert [step for step, *_ in full["history"]] == [200, 400, 600, 800, 1000]
    options = [*SHORT, *TWO, f"stop_within={within}", f"hydra.run.dir={tmp_path / 'run'}"]
    done = run("train", *options)
    assert done.returncode == 0, done.stderr
    early = checkpoint.load(tmp_path / "run" / "checkpoint.pt")["best"]
    assert early["history"] == full["history"][: k + 1]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["env_steps"] == full["history"][k][0]
    assert summary["updates"] == 4 * (summary["env_steps"] - 100)
    assert summary["ended"] == (
        f"every kept policy is within {0.5 * within:g} % regret and {0.003 * within:g} OD steady error "
        "on the selection grid"
    )
    assert json.loads((whole / "summary.json").read_text())["ended"] == "agent.total_steps"
    assert len(summary["regret_pct"]) == len(summary["regret_pct_last"]) == 2  # on the reported grid, as always
    again = run("train", f"resume={tmp_path / 'run'}")
    assert again.returncode == 0, again.stderr
    assert json.loads((tmp_path / "run" / "summary.json").read_text()) == summary


def test_limits_of_nothing_are_refused(tmp_path):
    done = run("train", "stop_within=0", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "error: stop_within = 0.0: allowed greater than 0, or null\n")


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
    kept = {(round(a, 9), round(b, 9)) for a, b in Density(config).selection_grid()}
    reported = {(round(a, 9), round(b, 9)) for a, b in Density(config).report_grid()}
    assert len(reported) == 41 * 9
    assert not kept & reported


def test_killed_at_a_random_moment_and_resumed_gives_the_same_weights(whole, tmp_path):
    rng = np.random.default_rng(KILL_SEED)
    folder = tmp_path / "killed"
    process = subprocess.Popen(
        command("train", *SHORT, *TWO, f"hydra.run.dir={folder}"),
        env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    while not (folder / "checkpoint.pt").is_file():
        assert process.poll() is None
        time.sleep(0.005)
    time.sleep(float(rng.uniform(0.0, 0.6)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = run("train", f"resume={folder}")
    assert done.returncode == 0, done.stderr
    a, b = checkpoint.load(whole / "checkpoint.pt"), checkpoint.load(folder / "checkpoint.pt")
    ours, theirs = (c["agents"]["groups"][0]["agent"] for c in (a, b))
    for key in ("online", "target"):
        assert torch.equal(ours[key], theirs[key])
    assert torch.equal(ours["replay"]["rows"], theirs["replay"]["rows"])
    assert torch.equal(a["best"]["weights"], b["best"]["weights"])
    assert a["returns"] == b["returns"]
    first = [line for line in (whole / "progress.csv").read_text().splitlines() if ",speed/" not in line]
    second = [line for line in (folder / "progress.csv").read_text().splitlines() if ",speed/" not in line]
    assert first == second


def test_agent_of_a_population_is_the_same_seed_alone(tmp_path):
    """Same episodes, exploration and minibatches; same weights up to rounding over the first updates."""
    config = TrainConfig().agent
    many = build.trainer(Density(EnvConfig()), config, range(10, 18))
    alone = build.trainer(Density(EnvConfig()), config, [13])
    for trainer in (many, alone):
        trainer._observation, _ = trainer.env.reset()
        for _ in range(config.learn_start + 5):
            trainer._step()
    ours, theirs = many.agent.replay.state_dict()["rows"][3], alone.agent.replay.state_dict()["rows"][0]
    assert torch.equal(ours[:500], theirs[:500])
    np.testing.assert_allclose(many.agent.online.flat[3], alone.agent.online.flat[0], atol=2e-5)
    assert not torch.allclose(many.agent.online.flat[2], many.agent.online.flat[3])


def test_what_is_remembered_follows_the_model_also_at_the_end_of_an_episode():
    """x' = f(u) x towards the same setpoint in every transition of six episodes, and nothing is final."""
    env = EnvConfig(episode_steps=5)
    trainer = build.trainer(Density(env), TrainConfig().agent, range(3))
    trainer._observation, _ = trainer.env.reset()
    for _ in range(30):
        trainer._step()
    x, goal, reached, same, action, reward, continues = trainer.agent.replay.state_dict()["rows"].double().numpy().T
    np.testing.assert_allclose(reached, x * step_factors(env)[action.astype(int)], rtol=1e-6)
    np.testing.assert_array_equal(goal, same)
    np.testing.assert_allclose(reward, -((reached - goal) ** 2), rtol=1e-4, atol=1e-6)
    assert (continues == 1.0).all()
    assert len(np.unique(goal)) > 3


def test_a_resumed_session_equals_an_uninterrupted_one(tmp_path, caplog):
    from dataclasses import replace

    c = TrainConfig()
    c = replace(c, agent=replace(c.agent, total_steps=600, learn_start=100), eval_every=100, checkpoint_every=100)
    (tmp_path / "a").mkdir()
    first = Session(c, tmp_path / "a")
    with caplog.at_level("INFO"):
        first.run()
    first.writer.close()
    learns, good, writes, untrained, step, *_ = caplog.messages
    assert learns == (
        "learns env=density agent=given: mu 0.03 1/min, tau 0.3333, a decision every 1 min; seed 0, for 600 steps"
    )
    assert good.startswith("good is a policy within 0.5 % regret and 0.003 OD at rest at its worst setpoint")
    assert writes == f"writes to {tmp_path / 'a'}; watch it with: tensorboard --logdir {tmp_path / 'a'}"
    assert untrained == "step 100 of 600, untrained until step 100"
    number = r"\d+\.\d\d % regret, \d\.\d{4} OD steady error"
    assert re.fullmatch(rf"step 200 of 600, 33 %, \d:\d\d min left: selection grid: {number}; kept: {number}", step)
    assert [step for step, _, _ in first.best.history] == [200, 300, 400, 500, 600]
    (tmp_path / "b").mkdir()
    for total in (300, 400):  # killed after step 400, before that was saved
        second = Session(replace(c, agent=replace(c.agent, total_steps=total)), tmp_path / "b", resume=total > 300)
        second.run()
        second.writer.close()
        if total == 300:
            saved = (tmp_path / "b" / "checkpoint.pt").read_bytes()
    (tmp_path / "b" / "checkpoint.pt").write_bytes(saved)
    third = Session(c, tmp_path / "b", resume=True)
    assert third.agents.steps == 300
    third.run()
    third.writer.close()
    assert torch.equal(first.agents.weights(), third.agents.weights())
    assert first.best.history == third.best.history
    whole, resumed = (shown.EventAccumulator(str(tmp_path / name), {"tensors": 0}).Reload() for name in "ab")
    tags = [tag for tag in whole.Tags()["tensors"] if tag.partition("/")[0] in ("train", "eval", "kept", "q", "limit")]
    for tag in tags:  # every point once
        ours, theirs = ([(e.step, *e.tensor_proto.float_val) for e in x.Tensors(tag)] for x in (whole, resumed))
        assert (tag, ours) == (tag, theirs)
    assert [e.step for e in resumed.Tensors("train/return")] == [100, 200, 300, 400, 500, 600]


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
    ("arguments", "message"),
    [
        (["env.mu=abc"], "env.mu = abc: allowed a number, 0 < mu"),
        (["resume=nowhere"], "resume=nowhere: no run folder"),
        (["+env=simm"], "env=simm: no such option; allowed: coculture, coculture_preview, relative, sim"),
    ],
)
def test_bad_input_ends_in_one_line(arguments, message, tmp_path):
    done = run("train", *arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [None, "mu: 0.02\ntau: zero\n", "- 1\n", "mu: [", "nu: 0.02\n", "mu: 7\n"])
def test_a_bad_env_file_ends_in_one_line(content, tmp_path):
    path = tmp_path / "model.yaml"
    if content is not None:
        path.write_text(content)
    done = run("train", f"env_file={path}", f"hydra.run.dir={tmp_path / 'run'}")
    assert done.returncode == 1
    assert "model.yaml" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_help_that_nobody_reads_to_the_end_says_nothing_about_it():
    line = f"{sys.executable} -m experiments.train --help | head -1"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", line], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1


@pytest.mark.parametrize("flags", [["--help=all"], ["--cfg", "job"], ["--cfg", "job", "+env=sim", "+experiment=smoke"]])
def test_help_and_config_printing(flags):
    done = run("train", *flags)
    assert done.returncode == 0
    assert "mu: 0.03" in done.stdout or "env.mu = 0.03" in done.stdout
    assert "Traceback" not in done.stderr


def test_an_agent_of_another_task_is_refused_before_it_trains(tmp_path):
    config = entry_point.config(["env=coculture_preview", "agent=tuned"])
    with pytest.raises(UserError, match=r"rows of 2 numbers, this task observes 6.*agent=coculture_preview"):
        train_run.train(config, tmp_path)


@pytest.mark.parametrize(
    ("words", "agent"),
    [
        (["env=coculture"], "coculture"),
        (["+env=coculture_preview", "seed=3"], "coculture_preview"),
        (["env=relative"], "relative"),
        (["env=relative", "agent=tuned"], "tuned"),
        (["agent=paper", "env=coculture"], "paper"),
        (["+env=sim"], "tuned"),
        ([], "tuned"),
    ],
)
def test_a_task_comes_with_the_agent_that_belongs_to_it(words, agent):
    """Unless another is chosen; values on the command line count in either."""
    own, config = presets.load(f"agent/{agent}"), entry_point.config(words)
    assert json.loads(json.dumps({key: getattr(config.agent, key) for key in own})) == own
    assert config.seed == 3 * ("seed=3" in words)


def test_an_agent_that_would_never_learn_is_refused(tmp_path):
    config = entry_point.config(["agent.total_steps=300", "agent.learn_start=300"])
    with pytest.raises(UserError, match=r"agent.learn_start = 300: allowed 0 to 299, below agent.total_steps"):
        train_run.train(config, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["coculture", "coculture_preview"])
def test_a_composition_is_trained_scored_and_exported(tmp_path, name, monkeypatch):
    """A few hundred steps: what is written, that the file says what the summary says, the figure what was measured."""
    drawn, save = {}, train_run.charts.save

    def kept(figure, folder, name):
        drawn[name] = figure
        return save(figure, folder, name)

    monkeypatch.setattr(train_run.charts, "save", kept)
    words = ["agent.total_steps=240", "agent.learn_start=100", "agent.updates_per_step=1", "eval_every=120"]
    train_run.train(entry_point.config([f"env={name}", *words]), tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    learned = policy.load(tmp_path / "policy.npz")
    assert learned.observation == (policy.COCULTURE if name == "coculture" else policy.COCULTURE_PREVIEW)
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
