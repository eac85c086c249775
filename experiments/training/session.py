"""One training run: agents, evaluation, records, checkpoints. On one processor a run resumes bit for bit."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dqn import checkpoint
from dqn.trainer import TrainRecord
from experiments.cli import stop
from experiments.reporting.tensorboard import PopulationWriter
from experiments.training import agents, announcements, tasks
from experiments.training.config import TrainConfig
from experiments.training.evaluation import Evaluation, Score
from experiments.training.tasks import Task

log = logging.getLogger(__name__)

LINES = 20  # number of progress lines without a terminal
PER_AGENT = ("merit", "regret", "steady", "step", "updates")  # arrays of `BestSoFar`, (S,)


def merit(score: Score, task: Task) -> NDArray[np.float64]:
    """Return the merit of S policies, (S,): the larger of regret and worst steady error, each over the task's limit.

    A lower merit is better. Regret alone does not show a small steady error: 0.006 OD for a whole episode is 0.1 % of
    the episode's cost.
    """
    return np.maximum(score.regret_pct / task.regret_unit, score.steady_abs_error / task.steady_unit)


@dataclass
class BestSoFar:
    """Best weights of each agent on the selection grid so far, and all scores."""

    weights: torch.Tensor  # (S, P)
    merit: NDArray[np.float64]  # (S,)
    regret: NDArray[np.float64]  # per cent, of these weights, (S,)
    steady: NDArray[np.float64]  # steady error of these weights, in the task's unit, (S,)
    step: NDArray[np.int64]  # step of these weights, (S,)
    updates: NDArray[np.int64]  # gradient steps up to these weights, (S,)
    history: list[tuple[int, list[float], list[float]]] = field(default_factory=list)
    """Every evaluation: its step, and regret_pct and steady_abs_error of each agent."""

    @classmethod
    def empty(cls, weights: torch.Tensor) -> BestSoFar:
        """Return a record without scores that keeps `weights`, (S, P), until the first evaluation."""
        n = weights.shape[0]
        worst = np.full((3, n), np.inf)
        step, updates = np.zeros((2, n), dtype=np.int64)
        return cls(weights.cpu().clone(), worst[0], worst[1], worst[2], step, updates)

    def update(self, step: int, updates: int, score: Score, value: NDArray[np.float64], weights: torch.Tensor) -> None:
        """Keep the weights and score of every agent whose merit `value`, (S,), is lower than before."""
        self.history.append((step, score.regret_pct.tolist(), score.steady_abs_error.tolist()))
        better = value < self.merit
        for i in better.nonzero()[0]:
            self.weights[i] = weights[i].cpu()
        self.merit[better] = value[better]
        self.regret[better] = score.regret_pct[better]
        self.steady[better] = score.steady_abs_error[better]
        self.step[better], self.updates[better] = step, updates

    def state_dict(self) -> dict[str, Any]:
        kept = {name: getattr(self, name).tolist() for name in PER_AGENT}
        return {"weights": self.weights, **kept, "history": self.history}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.weights.copy_(state["weights"])
        for name in PER_AGENT:
            getattr(self, name)[:] = state[name]
        self.history = [(step, list(regret), list(steady)) for step, regret, steady in state["history"]]


class Session:
    """One training run: its parts, and the results so far.

    Args:
      config: config of the training. folder: run folder, for events, progress.csv and checkpoint.pt.
      resume: whether to continue from the folder's checkpoint.
    Raises: dqn.checkpoint.CheckpointError if there is no checkpoint to continue from.
    """

    def __init__(self, config: TrainConfig, folder: Path, resume: bool = False) -> None:
        self.config = config
        self.folder = folder
        self.seeds: Sequence[int] = range(config.seed, config.seed + config.n_agents)
        self.task = tasks.of(config.env)
        self.agents = agents.population(self.task, config.agent, self.seeds, config.device, config.threads)
        self.selection = Evaluation(self.task, self.task.selection_grid())
        self.best = BestSoFar.empty(self.agents.weights())
        self.returns: list[list[float]] = []  # a row per episode, with the return of each agent
        self.seconds = 0.0  # training time, including that before a resume
        if resume:
            state = checkpoint.load(folder / "checkpoint.pt")
            self.agents.load_state_dict(state["agents"])
            self.best.load_state_dict(state["best"])
            self.returns, self.seconds = [list(row) for row in state["returns"]], state["seconds"]
        self.writer = PopulationWriter(folder, self.seeds, self.agents.steps)
        announcements.show(self.writer, config, self.task, self.seeds, folder)

    def evaluate(self, step: int) -> Score:
        """Score the greedy policies on the selection grid, keep the best ones, and log the scores."""
        weights = self.agents.weights()
        score = self.selection(agents.act_with(self.agents.network, weights), self.agents.n_agents)
        self.best.update(step, self.agents.updates, score, merit(score, self.task), weights)
        kept = {"kept/regret_pct": self.best.regret, "kept/steady_abs_error": self.best.steady}
        now = {"eval/regret_pct": score.regret_pct, "eval/steady_abs_error": score.steady_abs_error}
        self.writer.scalars(step, now | kept)
        limits = {"limit/regret_pct": self.task.regret_unit, "limit/steady_abs_error": self.task.steady_unit}
        self.writer.events.scalars(limits, step)
        self.writer.flush()
        return score

    def met(self) -> bool:
        """Return whether every kept policy meets `stop_within`."""
        within = self.config.stop_within
        return within is not None and bool((self.best.merit <= within).all())

    @property
    def ended(self) -> str:
        """Reason why the training ended, for messages."""
        within = self.config.stop_within
        if within is None or not self.met():
            return "agent.total_steps"
        regret, steady = (within * unit for unit in (self.task.regret_unit, self.task.steady_unit))
        limits = f"{regret:g} % regret and {steady:g} {self.task.unit} steady error"
        return f"every kept policy is within {limits} on the selection grid"

    def _news(self, record: TrainRecord) -> str:
        """Evaluate the policies and describe their progress; before the first update say that they are untrained."""
        if not record.updates and record.step < self.config.agent.total_steps:
            return "untrained: no update yet"
        score, kept = self.evaluate(record.step), (self.best.regret, self.best.steady)
        return announcements.progress(record.step, self.config.agent.total_steps, self.seconds, score, kept, self.task)

    def report(self) -> tuple[Evaluation, Score, Score]:
        """Return the evaluation on the reported grid, the scores of the kept policies, and of the last policies."""
        report = Evaluation(self.task, self.task.report_grid())
        kept, last = (
            report(agents.act_with(self.agents.network, weights), self.agents.n_agents)
            for weights in (self.best.weights, self.agents.weights())
        )
        return report, kept, last

    def _log(self, record: TrainRecord) -> None:
        self.returns.append(record.episode_return.tolist())
        self.writer.scalars(
            record.step,
            {
                "train/return": record.episode_return,
                **record.curves,
                "speed/steps_per_s": record.step * len(self.seeds) / max(self.seconds, 1e-9),
            },
        )

    def _save(self) -> None:
        state = {
            "agents": self.agents.state_dict(),
            "best": self.best.state_dict(),
            "returns": self.returns,
            "seconds": self.seconds,
        }
        checkpoint.save(self.folder / "checkpoint.pt", state)

    def run(self) -> None:
        """Train to the end, or until `stop_within` is met: log every episode, evaluate, checkpoint, show progress.

        Raises: KeyboardInterrupt after a signal, once the running episode has ended and is saved. A batch system's own
        handler may end the job or let it continue.
        """
        c = self.config
        if self.met():  # resumed after the end
            return
        total, last = c.agent.total_steps, self.agents.steps
        line_every = max(c.eval_every, total // LINES)
        started, earlier = time.perf_counter(), self.seconds
        announcements.began(c, self.task, self.seeds, self.folder, last)
        bars = tqdm(total=total, initial=last, disable=None, unit="step")
        with stop.pausing("at the end of this episode") as stopping, logging_redirect_tqdm(), bars as bar:
            for record in self.agents.run():
                self.seconds = earlier + time.perf_counter() - started
                self._log(record)
                bar.update(record.step - last)
                final = record.step == total
                if final or record.step // c.eval_every > last // c.eval_every:
                    line = self._news(record)
                    bar.set_postfix_str(line)
                    final = final or self.met()
                    if bar.disable and (final or record.step // line_every > last // line_every):
                        log.info("step %d of %d, %s", record.step, total, line)
                stopped = stopping()
                if final or stopped or record.step // c.checkpoint_every > last // c.checkpoint_every:
                    self.seconds = earlier + time.perf_counter() - started
                    self._save()
                if stopped:
                    stopping.pass_on()
                if self.met():
                    log.info("step %d of %d: ended, %s", record.step, total, self.ended)
                    break
                last = record.step
