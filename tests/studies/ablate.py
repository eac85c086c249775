"""What each choice of an agent is worth: trains variants of one agent over the same seeds and compares them.

`python -m tests.studies.ablate` trains every entry of `ablations` in ablate.yaml beside this file: the agent of the
command line with some of its values replaced. The run folder gets ablation.csv (a row per variant and seed),
summary.json, table.md, a figure, and one sub-folder per variant with its TensorBoard curves. A stopped run goes on with
`resume=RUN`, to the bit on one processor.
"""

import csv
import logging
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import build, check, part, setting
from dqn.config import DQNConfig
from envs.task import EnvConfig
from experiments.cli import files, frame
from experiments.training.config import TrainConfig
from tests.entry import command
from tests.studies.results import leave, write_csv

__all__ = ["AblateConfig", "Row", "main", "summarise", "variant"]

log = logging.getLogger(__name__)

MEASURES = ("regret_pct", "steady_abs_error", "regret_pct_last", "steady_abs_error_last")
COLUMNS = ("variant", "seeds", "regret, %", "steady error, OD", "last regret, %", "last steady error, OD", "time, s")


def variant(agent: DQNConfig, name: str, values: dict[str, Any]) -> DQNConfig:
    """`agent` with some values replaced.

    Raises: ValueError naming the variant and the key that does not exist or is out of range.
    """
    where = f"ablations.{name}"
    try:
        return build(agent, values, where)
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(where) else f"{where}: {error}") from None


@dataclass(frozen=True)
class AblateConfig:
    """Which variants of an agent to train. Raises: ValueError naming key, value and allowed range."""

    env: EnvConfig = part(EnvConfig, "the training model and its episodes")
    agent: DQNConfig = part(DQNConfig, "the agent that the variants change")
    ablations: dict[str, dict[str, Any]] = setting({}, "variants by name: values of the agent that differ")
    only: list[str] = setting([], "names to train; empty: all")
    seed: int = setting(0, "of the first agent", at_least=0)
    n_agents: int = setting(32, "seeds of each variant", within=(1, 100_000))
    device: str = setting("cpu", "where networks are trained", choices=("cpu", "cuda"))
    threads: int | None = setting(
        None, "groups of 16 agents trained at the same time; null: one per core. No effect on results", at_least=1
    )
    eval_every: int = setting(100, "between evaluations on the selection grid", "steps", at_least=1)
    resume: str | None = setting(None, "a run folder to continue")

    def __post_init__(self) -> None:
        """Check every variant before the first one trains."""
        check(self)
        unknown = [name for name in self.only if name not in self.ablations]
        if unknown:
            raise ValueError(f"only = {unknown[0]}: allowed {', '.join(self.ablations)}")
        for name in self.ablations:
            if not re.fullmatch(r"[\w.+-]+", name):
                raise ValueError(f"ablations.{name}: allowed letters, digits, _ . + and - (it names a folder)")
            self.training(name)

    @property
    def names(self) -> list[str]:
        """Variants to train, in order."""
        return [name for name in self.ablations if not self.only or name in self.only]

    def training(self, name: str) -> TrainConfig:
        """The training run of one variant."""
        return TrainConfig(
            env=self.env, agent=variant(self.agent, name, self.ablations[name]), seed=self.seed, n_agents=self.n_agents,
            device=self.device, threads=self.threads, eval_every=self.eval_every,
            checkpoint_every=self.agent.total_steps, resume=self.resume,
        )  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One agent of one variant: measures on the reported grid, kept policy and last iterate."""

    ablation: str
    seed: int
    regret_pct: float
    steady_abs_error: float
    regret_pct_last: float
    steady_abs_error_last: float
    train_seconds: float  # of the whole population


def _read(path: Path) -> list[Row]:
    """Rows of an earlier life of this run."""
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as f:
        rows = list(csv.DictReader(f))
    numbers = (*MEASURES, "train_seconds")
    return [Row(r["ablation"], int(r["seed"]), **{k: float(r[k]) for k in numbers}) for r in rows]


def _train(config: TrainConfig, name: str, folder: Path) -> list[Row]:
    """Train one variant and score it on the reported grid; one that was stopped goes on where it was."""
    from dqn.checkpoint import CheckpointError
    from experiments.training.session import Session

    folder.mkdir(parents=True, exist_ok=True)
    try:
        session = Session(config, folder, resume=config.resume is not None and (folder / "checkpoint.pt").is_file())
    except CheckpointError as error:
        raise frame.UserError(f"resume={config.resume}: {error}") from None
    try:
        session.run()
    finally:
        session.writer.close()
    _, kept, last = session.report()
    scores = (kept.regret_pct, kept.steady_abs_error, last.regret_pct, last.steady_abs_error)
    return [
        Row(
            name, seed, train_seconds=session.seconds, **{m: float(s[i]) for m, s in zip(MEASURES, scores, strict=True)}
        )
        for i, seed in enumerate(session.seeds)
    ]


def summarise(rows: list[Row]) -> dict[str, dict[str, Any]]:
    """Per variant: median, interquartile mean and worst seed of every measure."""
    from experiments.reporting.tables import interquartile_mean

    out: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(row.ablation for row in rows):
        own = [row for row in rows if row.ablation == name]
        entry: dict[str, Any] = {"seeds": len(own), "train_seconds": own[0].train_seconds}
        for measure in MEASURES:
            values = np.array([getattr(row, measure) for row in own])
            entry[measure] = {
                "median": float(np.median(values)),
                "iqm": interquartile_mean(values),
                "worst": float(values.max()),
            }
        out[name] = entry
    return out


def table(rows: list[Row]) -> list[tuple[object, ...]]:
    """The summary by `COLUMNS`: median over seeds and, in brackets, the worst seed."""
    lines: list[tuple[object, ...]] = []
    for name, entry in summarise(rows).items():
        values = zip((entry[m] for m in MEASURES), (3, 4, 3, 4), strict=True)
        cells = [f"{v['median']:.{digits}f} ({v['worst']:.{digits}f})" for v, digits in values]
        lines.append((name, entry["seeds"], *cells, f"{entry['train_seconds']:.0f}"))
    return lines


def draw(rows: list[Row], folder: Path) -> None:
    """One point per seed: regret and steady error of the kept policy, and regret of the last iterate."""
    from experiments.reporting import charts

    names = list(dict.fromkeys(row.ablation for row in rows))
    panels = (
        ("regret_pct", "regret of the kept policy, %", 0.5),
        ("regret_pct_last", "regret of the last iterate, %", 2.0),
        ("steady_abs_error", "steady error of the kept policy, OD", 0.003),
    )
    canvas, axes = charts.new_figure(11.0, 1.4 + 0.27 * len(names), 1, len(panels), sharey=True)
    for ax, (measure, label, limit) in zip(axes, panels, strict=True):
        jitter = np.random.default_rng(0)
        for height, name in enumerate(names):
            own = np.array([getattr(row, measure) for row in rows if row.ablation == name])
            places = height + jitter.uniform(-0.22, 0.22, own.size)
            ax.plot(np.maximum(own, 1e-4), places, ".", color=charts.COLOURS[0], alpha=0.45, markersize=5)
            ax.plot([np.median(own)] * 2, [height - 0.34, height + 0.34], color=charts.COLOURS[1], linewidth=2)
        ax.set(xscale="log", xlabel=label, ylim=(len(names) - 0.5, -0.5))
        ax.set_yticks(range(len(names)), names, fontsize=8)
        ax.axvline(limit, color=charts.COLOURS[6], linewidth=1, linestyle="--")
    charts.save(canvas, folder / "figures", "ablation")


def ablate(config: AblateConfig, folder: Path) -> float:
    """Train all variants; returns the median regret of the first, the objective of a sweep."""
    import torch

    torch.set_num_threads(1)
    path = folder / "ablation.csv"
    rows = _read(path)
    done = {row.ablation for row in rows}
    for k, name in enumerate(config.names):
        if name in done:
            continue
        log.info("variant %d of %d: %s %s", k + 1, len(config.names), name, config.ablations[name])
        rows += _train(config.training(name), name, folder / name)
        write_csv(path, [asdict(row) for row in rows])
        entry = summarise(rows)[name]
        regret, steady, last = (entry[m] for m in MEASURES[:3])
        log.info(
            "%s: regret %.3f %% (worst %.3f), steady error %.4f (worst %.4f), last regret %.3f %% (worst %.3f), %.0f s",
            name, regret["median"], regret["worst"], steady["median"], steady["worst"], last["median"], last["worst"],
            entry["train_seconds"],
        )  # fmt: skip
    summary = summarise(rows)
    files.write_json(folder / "summary.json", {"agents": config.n_agents, "seed": config.seed, "ablations": summary})
    leave(folder, __file__, COLUMNS, table(rows))
    draw(rows, folder)
    log.info("table %s, figure %s", folder / "table.md", folder / "figures" / "ablation.png")
    return float(summary[config.names[0]]["regret_pct"]["median"])


main = command(__file__, AblateConfig(), ablate, resumes="config.yaml")


if __name__ == "__main__":
    main()
