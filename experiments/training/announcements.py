"""Messages of a training run: task and limits at the start, then progress, then the result."""

import logging
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.cli.files import choices
from experiments.reporting import tables
from experiments.reporting.curves import TRAINING, of_population
from experiments.reporting.tensorboard import PopulationWriter
from experiments.reporting.verdict import Headline
from experiments.training import tasks
from experiments.training.config import TrainConfig
from experiments.training.evaluation import Array, Score
from experiments.training.tasks import Task

log = logging.getLogger(__name__)


def began(config: TrainConfig, task: Task, seeds: Sequence[int], folder: Path, step: int) -> None:
    """Log the task, its limits, and how to watch the training. Args: step: first step of a resumed run, else 0."""
    chosen = choices(folder)
    names = f"env={chosen.get('env', tasks.kind(config.env))} agent={chosen.get('agent', 'given')}"
    where = f"continues at step {step} of" if step else "for"
    who = f"seed {seeds[0]}" if len(seeds) == 1 else f"{len(seeds)} agents, seeds {seeds[0]} to {seeds[-1]}"
    log.info("learns %s: %s; %s, %s %d steps", names, task.description, who, where, config.agent.total_steps)
    limits = f"{task.regret_unit:g} % regret and {task.steady_unit:g} {task.unit} steady error"
    log.info("target: a policy within %s at its worst setpoint (regret: cost above that of the exact optimum)", limits)
    log.info("writes to %s; watch the training with: tensorboard --logdir %s", folder, shlex.quote(str(folder)))


def _pair(regret: Array, steady: Array, unit: str) -> str:
    return f"{np.median(regret):.2f} % regret, {np.median(steady):.4f} {unit} steady error"


def progress(step: int, total: int, seconds: float, score: Score, best: tuple[Array, Array], task: Task) -> str:
    """Describe the remaining time, and the medians over the agents' current and kept policies on the selection grid.

    Args: seconds: training time so far. best: regret and steady error of the kept policies, (S,) each.
    """
    left = seconds / max(step, 1) * (total - step)
    now = _pair(score.regret_pct, score.steady_abs_error, task.unit)
    clock = f"{int(left // 60)}:{int(left % 60):02d} min left"
    return f"{100 * step // total} %, {clock}: selection grid: {now}; kept: {_pair(*best, task.unit)}"


def ended(
    folder: Path, task: Task, kept: Score, told: Headline | None, spent: str, path: Path, words: str = "",
    whole: bool = True,
) -> None:  # fmt: skip
    """Log the result and the next step.

    Args: told: result as on the run's page. spent: steps, updates and time, as text. words: arguments for the next
    command. whole: whether the training did all its steps.
    """
    log.info("%s", spent)
    for line in () if told is None else filter(None, (*told.items, told.remark)):
        log.info("%s", line)
    log.info("policy %s; figures %s", path, folder / "figures")
    if task.tried:
        file = shlex.quote(str(path))
        if task.provable and whole and (kept.regret_pct <= task.regret_unit).any():  # others seldom get a certificate
            log.info("next, prove its closed loop: python -m experiments.certify policy=%s", file)
        said = " ".join(filter(None, (words, task.tried.format(file))))
        log.info("next, try it: python -m experiments.deploy %s", said)


def show(writer: PopulationWriter, config: TrainConfig, task: Task, seeds: Sequence[int], folder: Path) -> None:
    """Write TensorBoard's custom page and the config at the start of a run."""
    writer.events.layout(TRAINING if len(seeds) == 1 else of_population(TRAINING))
    path = folder / "config.yaml"
    if path.is_file():
        writer.events.text("run/config", f"```yaml\n{path.read_text(encoding='utf-8')}\n```")
    chosen = choices(folder)
    values: dict[str, float | str] = {
        "command": "train",
        "decides": chosen.get("agent", "given"),
        "on": chosen.get("env", tasks.kind(config.env)),
        "steps": config.agent.total_steps,
    }
    values |= task.scalars
    for seed, events in zip(seeds, writer.agents, strict=False):
        events.hyper_parameters(values | {"seed": seed}, folder, f"seed{seed:04d}" if len(seeds) > 1 else "")
    writer.flush()


def results(writer: PopulationWriter, step: int, kept: Score, task: Task, seeds: Sequence[int]) -> None:
    """Write the results to TensorBoard's HPARAMS table and text page."""
    for events, regret, steady in zip(writer.agents, kept.regret_pct, kept.steady_abs_error, strict=False):
        events.scalars({"result/regret_pct": float(regret), "result/steady_abs_error": float(steady)}, step)
    limits = ("limit", f"{task.regret_unit:g}", f"{task.steady_unit:g}")
    pairs = zip(seeds, kept.regret_pct, kept.steady_abs_error, strict=True)
    rows = [(f"seed {seed}", f"{regret:.3f}", f"{steady:.4f}") for seed, regret, steady in pairs]
    columns = ("policy", "regret, %", f"steady error, worst setpoint, {task.unit}")
    writer.events.text("run/summary", tables.markdown(columns, [limits, *rows]), step)
