"""Learners side by side on the tasks whose exact optimum is known: `python -m tests.studies.learners`.

Every policy is the last iterate of one training, scored noise-free on the task's reported grid (`Evaluation`), the
same for all: regret, what it costs beyond the optimum, and the error at rest at the worst setpoint. Rivals have their
own defaults and normalised observations; `dqn_paper` has what the paper states, as far as that library knows it.
"""

import json
import logging
import math
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from conf.schema import check, setting
from envs.coculture.optimum import Grid, best_action, cost_to_go, transitions
from envs.coculture.task import CocultureConfig, advance, passed, share
from envs.optimum import solve_episode
from envs.preview import half_way, program_of
from envs.task import step_factors
from experiments.cli import files
from experiments.cli.stop import Workers
from experiments.coculture.base import SHARE, Array, ShareEstimate, Wanted
from experiments.coculture.task import Coculture
from experiments.laws import registry
from experiments.reporting.tables import number
from experiments.train import main as train
from experiments.training import tasks
from experiments.training.agents import act_with
from experiments.training.density import Preview
from experiments.training.evaluation import Act, Evaluation
from experiments.training.session import Session
from tests.entry import command
from tests.studies.results import leave

__all__ = ["LearnersConfig", "learners", "main", "one_line", "planned"]

log = logging.getLogger(__name__)

TASKS = {
    "sim": "Bioreactor-v0", "relative": "Relative-v0", "preview": "BioreactorPreview-v0", "coculture": "Coculture-v0",
    "coculture_preview": "CoculturePreview-v0",
}  # fmt: skip
RIVALS: dict[str, tuple[str, dict[str, Any]]] = {
    "dqn": ("SB3 DQN", {}),
    "dqn_paper": ("SB3 DQN, the paper's settings", {
        "learning_rate": 1e-3, "buffer_size": 10_000, "learning_starts": 500, "batch_size": 64, "gamma": 0.99,
        "train_freq": 1, "target_update_interval": 500, "exploration_fraction": 0.5, "exploration_final_eps": 0.05,
    }),
    "qrdqn": ("sb3-contrib QR-DQN", {}),
    "ppo": ("SB3 PPO", {}),
    "a2c": ("SB3 A2C", {}),
}  # fmt: skip
WITHOUT = {
    "value_root": ["agent.value_root=0", "agent.huber=1", "agent.reward_scale=10"],
    "hindsight": ["agent.hindsight_share=0"],
    "falling rate": ["agent.learning_rate_end=null"],
}
OURS, LAW = "this program's DQN", "one-step lookahead, one line"
PLANS = {
    "preview": {"10 min": 10, "20 min": 20, "30 min": 30},
    "coculture_preview": {"1 h": 60, "3 h": 180, "6 h": 360},
}
COLUMNS = ("task", "policy", "steps", "regret, %", "worst seed", "error at rest", "CPU s")


@dataclass(frozen=True)
class LearnersConfig:
    """Which trainings."""

    tasks: tuple[str, ...] = setting(tuple(TASKS), "to learn", choices=tuple(TASKS), some=True)
    rivals: tuple[str, ...] = setting(tuple(RIVALS), "beside our agent", choices=tuple(RIVALS))
    steps: tuple[int, ...] = setting((10_000,), "of each training", within=(1000, 10_000_000), some=True)
    long: tuple[str, ...] = setting(("ppo",), "rivals that are trained for `long_steps`, too", choices=tuple(RIVALS))
    long_steps: int = setting(100_000, "of those", within=(1000, 10_000_000))
    without: tuple[str, ...] = setting(
        tuple(WITHOUT),
        "parts that our agent is left without, one at a time, on coculture_preview",
        choices=tuple(WITHOUT),
    )
    seeds: int = setting(5, "of each", within=(1, 1000))
    seed: int = setting(0, "first of them", at_least=0)
    workers: int = setting(0, "processes; 0 for one per core", within=(0, 256))

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Job:
    """One training. steps: 0 for the agent's own."""

    task: str
    learner: str
    steps: int
    seed: int

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.task} {self.learner} {self.steps} {self.seed}".replace(" ", "_")


def jobs(c: LearnersConfig) -> list[Job]:
    """All trainings, short ones first."""
    kinds = [(t, r, n) for n in sorted(c.steps) for t in c.tasks for r in ("ours", *c.rivals)]
    kinds += [(t, "ours", 0) for t in c.tasks if own_steps(t) not in c.steps]
    kinds += [("coculture_preview", f"without {part}", 0) for part in c.without if "coculture_preview" in c.tasks]
    kinds += [(t, r, c.long_steps) for t in c.tasks for r in c.long]
    return [Job(*kind, seed) for kind in dict.fromkeys(kinds) for seed in seeds(c)]


def seeds(c: LearnersConfig) -> range:
    """Of every training."""
    return range(c.seed, c.seed + c.seeds)


@cache
def own_steps(task: str) -> int:
    """Steps for which our agent is trained on a task unless it is told otherwise."""
    return int(train.config([f"env={task}"]).agent.total_steps)


@cache
def evaluation(task: str) -> tuple[tasks.Task, Evaluation]:
    """Of the reported grid; the optimum of some tasks takes half a minute."""
    known = tasks.of(train.config([f"env={task}"]).env)
    return known, Evaluation(known, known.report_grid())


def run(job: Job, folder: Path) -> dict[str, float]:
    """Regret in per cent, error at rest, CPU seconds and steps of one training; kept in a file."""
    torch.set_num_threads(1)
    began = time.process_time()
    steps, act = ours(job, folder / job.name) if job.learner not in RIVALS else rival(job)
    spent = time.process_time() - began
    found = evaluation(job.task)[1](act, 1)
    regret, steady = float(found.regret_pct[0]), float(found.steady_abs_error[0])
    result = {"regret_pct": regret, "steady": steady, "cpu_s": spent, "steps": float(steps)}
    files.write_json(folder / f"{job.name}.json", result)
    return result


def ours(job: Job, folder: Path) -> tuple[int, Act]:
    """Our agent as `train env=TASK` trains it."""
    words = [f"env={job.task}", f"seed={job.seed}", "threads=1", "eval_every=100000000"]
    words += [f"agent.total_steps={job.steps}"] * bool(job.steps)
    config = train.config([*words, *WITHOUT.get(job.learner.removeprefix("without "), [])])
    folder.mkdir(parents=True, exist_ok=True)
    session = Session(config, folder)
    session.run()
    session.writer.close()
    return config.agent.total_steps, act_with(session.agents.network, session.agents.weights())


def rival(job: Job) -> tuple[int, Act]:
    """A rival with observations normalised by what it met."""
    import sb3_contrib
    import stable_baselines3
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    _, settings = RIVALS[job.learner]
    kind = {"dqn": "DQN", "dqn_paper": "DQN", "qrdqn": "QRDQN", "ppo": "PPO", "a2c": "A2C"}[job.learner]
    learner = getattr(sb3_contrib if kind == "QRDQN" else stable_baselines3, kind)
    copies = make_vec_env(f"envs:{TASKS[job.task]}", 1, seed=job.seed)
    normalised = VecNormalize(copies, norm_reward=False)
    model = learner("MlpPolicy", normalised, seed=job.seed, device="cpu", **settings)
    model.learn(job.steps)

    def act(observation: Any) -> Any:
        rows = normalised.normalize_obs(observation[0].astype(np.float32))
        return model.predict(rows, deterministic=True)[0][None]

    return job.steps, act


def laws(task: str) -> list[list[str]]:
    """Rows of the laws that learn nothing."""
    known, report = evaluation(task)
    acts: dict[str, Act] = {LAW: known.myopic}
    acts |= {"`half_way`, one line": half_way_law(known)} if isinstance(known, Preview) else {}
    acts |= {f"a plan of {name}, recomputed": planned(known, m) for name, m in PLANS.get(task, {}).items()}
    scores = [(name, report(act, 1)) for name, act in acts.items()]
    rows = [(name, float(s.regret_pct[0]), number(float(s.steady_abs_error[0]))) for name, s in scores]
    if isinstance(known, Coculture):
        kinds = ("midpoint" if known.config.preview_min else "inverse_dynamics", "proportional", "pi")
        costs = {f"`{kind}`, one line": one_line(kind, known.config, report.start) for kind in kinds}
        rows += [(name, 100.0 * (cost / report.optimum_cost - 1.0), "–") for name, cost in costs.items()]
    return [[TASKS[task], name, "–", number(round(regret, 3)), "–", steady, "–"] for name, regret, steady in rows]


def half_way_law(task: Preview) -> Act:
    """Look one period ahead towards the best way, which an error that counts after each step moves by half a period."""
    moves = np.log(step_factors(task.config))
    full = float(moves.max() - moves.min())

    def act(observation: Any) -> Any:
        now, following, left = (observation[..., k] for k in (1, 2, 3))
        way = half_way(now, following, left / task.config.control_min - 0.5, full, float(moves.max()) / full)
        return task.myopic(np.stack([observation[..., 0], way], axis=-1))

    return act


def planned(task: Any, minutes: float) -> Act:
    """Follow the optimal plan that ends after so many minutes, made anew before each decision."""
    c, steps = task.config, round(minutes / task.config.control_min)
    solved = cache(lambda *program: solve_episode(replace(c, episode_steps=steps), np.array(program)))

    def act(observation: Any) -> Any:
        rows, known = observation[0], -3  # the last three columns are the program
        program = program_of(c.control_min, rows[:, known:], steps)
        if isinstance(task, Coculture):
            model, state = transitions(c, Grid()), rows[:, :known]
            value = cost_to_go(model, share(program))[1]
            return best_action(c, model, value, state, share(program[0]))[None]
        plans = [solved(*each) for each in program.T]
        return np.array([[int(plan.act(od, steps)[0]) for plan, od in zip(plans, rows[:, :1], strict=True)]])

    return act


def one_line(kind: str, config: CocultureConfig, start: Array) -> float:
    """Cost of a law of the share, mean over the starts of the sum of squared errors, with the state as the estimate.

    Its target is not one of the policies' but any, and those with a period of a minute act within a decision, too.
    """
    law = registry.build(registry.config(kind, SHARE), SHARE)
    n, each_min = len(start), round(config.control_min)
    law.reset(n)
    state, goal, total = start[:, :3], start[:, 3:], np.zeros(n)
    for k in range(config.episode_steps):
        wanted = share(goal[:, 0])
        following = share(goal[:, 1]) if config.preview_min else wanted
        left = goal[:, 2] if config.preview_min else np.zeros(n)
        for minute in range(each_min):
            believed = ShareEstimate(state[:, 0], np.full(n, 0.01), state[:, 1], state[:, 2], *np.zeros((3, n)))
            told = Wanted(wanted, following, np.maximum(left - minute, 0.0) * (left > 0.0))
            target = law.act(believed, told, np.full(n, k * each_min + minute), np.ones(n, dtype=np.bool_))
            state = advance(config, state, target, 1.0)
        total += np.square(share(state[:, 0]) - wanted)
        goal = passed(config, goal)
    return float(total.mean())


def table(c: LearnersConfig, found: dict[Job, dict[str, float]]) -> list[list[str]]:
    """Rows of what is finished with all its seeds: of each task by regret, the lowest first."""
    rows: list[tuple[int, float, list[str]]] = []
    for kind in dict.fromkeys((job.task, job.learner, job.steps) for job in jobs(c)):
        each = [found[job] for job in (Job(*kind, seed) for seed in seeds(c)) if job in found]
        if len(each) < c.seeds:
            continue
        task, learner, _ = kind
        name = RIVALS[learner][0] if learner in RIVALS else OURS + f" {learner}".replace(" ours", "")
        regrets = [e["regret_pct"] for e in each]
        middle = statistics.median(regrets)
        cells = [number(middle), number(max(regrets)), number(statistics.median(e["steady"] for e in each)),
                 number(statistics.median(e["cpu_s"] for e in each), 2)]  # fmt: skip
        rows.append((c.tasks.index(task), middle, [TASKS[task], name, f"{each[0]['steps']:.0f}", *cells]))
    rows += [(k, float(row[3]), row) for k, task in enumerate(c.tasks) for row in laws(task)]
    ranked = [row for *_, row in sorted(rows, key=lambda entry: entry[:2])]
    return [row for k, row in enumerate(ranked) if row[:3] not in (other[:3] for other in ranked[:k])]


def by_task(rows: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of the same regrets, a column for each task and the worst seed's in brackets.

    What has no regret in the last task, the hardest, comes last. Our agent's own number of steps differs by task.
    """
    names = {name: task for task, name in TASKS.items()}
    tasks = list(dict.fromkeys(row[0] for row in rows))
    found: dict[tuple[str, str], dict[str, str]] = {}
    for task, name, steps, regret, worst, *_ in rows:
        own = name.startswith(OURS) and steps == f"{own_steps(names[task])}"
        for label in dict.fromkeys(["its own"] * own + [steps] * (not own or name == OURS)):
            found.setdefault((name, label), {})[task] = regret if worst == "–" else f"{regret} ({worst})"
    last = {key: float(cells[tasks[-1]].split()[0]) if tasks[-1] in cells else math.inf for key, cells in found.items()}
    kinds = [key for key in sorted(found, key=last.__getitem__) if key[0] != OURS or len(found[key]) == len(tasks)]
    return ["policy", "steps", *tasks], [[*key, *(found[key].get(task, "–") for task in tasks)] for key in kinds]


def learners(c: LearnersConfig, folder: Path) -> None:
    """All trainings that have no result yet, and the tables of those that have."""
    kept = folder / "jobs"
    kept.mkdir(parents=True, exist_ok=True)
    wanted = jobs(c)
    found = {j: json.loads(path.read_text()) for j in wanted if (path := kept / f"{j.name}.json").is_file()}
    with Workers(c.workers) as executor:
        running = {executor.submit(run, job, kept): job for job in wanted if job not in found}
        for done in as_completed(running):
            job = running[done]
            found[job] = done.result()
            log.info("%d of %d, %s: regret %.3g %%", len(found), len(wanted), job.name, found[job]["regret_pct"])
    rows = table(c, found)
    leave(folder, __file__, COLUMNS, rows)
    leave(folder, __file__, *by_task(rows), "by_task")


main = command(__file__, LearnersConfig(), learners)


if __name__ == "__main__":
    main()
