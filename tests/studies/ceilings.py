"""What no controller can gain, and what a change known ahead is worth: `python -m tests.studies.ceilings`.

Noise-free mean |error| of a one-line controller on its estimate, of the same one on the true state, and of dynamic
programming on the true state: what is left with the last is unavoidable.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from conf.schema import check, setting
from envs.coculture.task import logit
from envs.plant.plant import Plant
from envs.scenario import Scenario
from experiments.benchmark import main as benchmark
from experiments.comparison import trials
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.statistics import Spread
from experiments.comparison.trials import Cell, DensityTrial, run_cell, run_trial, windows
from experiments.laws import registry
from experiments.laws.base import Array, Controller
from experiments.laws.density.inverse import Inverse
from experiments.laws.share.base import ShareEstimate
from experiments.laws.share.recall import Recall
from experiments.reporting.tables import number
from tests.entry import command
from tests.studies.results import leave
from tests.studies.supervision import shipped

__all__ = ["CeilingsConfig", "main"]

log = logging.getLogger(__name__)

SCHEDULES = {"0.8, 0.65, 0.5": (0.8, 0.65, 0.5), "0.5, 0.8, 0.4, 0.7": (0.5, 0.8, 0.4, 0.7)}
AHEAD = 60.0  # min


@dataclass(frozen=True)
class CeilingsConfig:
    """How many vials of which plants."""

    vials: int = setting(64, "of each row", within=(2, 4096))
    plants: tuple[str, ...] = setting(("bench", "measured", "recorded", "tired_pump"), "whose density is held")
    composed: tuple[str, ...] = setting(("coculture_mixed",), "whose composition is held")
    controllers: tuple[str, ...] = setting(("inverse", "shipped", "pi_tuned"), "to which changes are announced")
    seed: int = setting(8128, "of the vials", at_least=0)

    def __post_init__(self) -> None:
        check(self)


class Truth:
    """An estimator of the density that is told the truth. Args: of the vials."""

    def __init__(self, plant: Plant, control_min: float, max_rate: float) -> None:
        self._at_rest = partial(plant.at_rest, control_min, 60.0 * control_min * max_rate)
        self._plant = plant

    @property
    def full_pump(self) -> Array:
        """What one period of full pump takes off ln OD, (N,)."""
        return self._at_rest()[0]

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return error and growth share, each (N,)."""
        full, share = self._at_rest()
        return np.log(self._plant.apparent_od / setpoint) / full, share

    def explain(self) -> dict[str, Array]:
        """Explain nothing."""
        return {}

    def _nothing(self, *_: Any) -> None:
        """Learn nothing."""

    reset = watch = see = decided = dosed = _nothing


def scenario(setpoints: tuple[float, ...], ahead: float) -> Scenario:
    """Half an hour at each setpoint."""
    n = len(setpoints)
    return Scenario(setpoints, (30.0,) * n, (37.0,) * n, recovery_od=setpoints[0], announce_min=ahead)


def density(c: CeilingsConfig, known: BenchmarkConfig, kind: str, plant: str, schedule: Scenario) -> DensityTrial:
    """One run of all vials."""

    def make(vials: Plant) -> Controller:
        if kind == "shipped":
            return shipped()
        name = kind.removesuffix(", truth")
        law: Controller = registry.build(known.controllers[name], model=known.env, plant=vials)
        if name != kind:
            assert isinstance(law, Inverse)
            law.estimator = Truth(vials, known.env.control_min, known.env.max_pump_rate)  # type: ignore[assignment]
        return law

    log.info("%s on %s", kind, plant)
    return run_trial(Cell(kind, plant, "steps"), known.plants[plant], schedule, make, known.env, c.vials, c.seed)


def scored(trial: DensityTrial, metric: str = "abs_error") -> Array:
    """Mean over the windows, noise-free, (N,)."""
    scores = [getattr(trial.score(window, "clean"), metric) for window in windows(trial.schedule)]
    return np.asarray(np.mean(scores, axis=0))


@contextmanager
def told() -> Iterator[None]:
    """Inside, an estimator of the share whose sensor is calibrated tells the truth."""
    vials: list[Plant] = []

    def truth(_: Any) -> ShareEstimate:
        plant = vials[-1]
        rate, zero = 60.0 * plant.culture.rates(plant.age_min)[:, 1], np.zeros(plant.n)
        first, second = plant.draws["mu"] / plant.config.growth.mu, plant.draws["second_mu"] / plant.config.second.mu
        state = logit(plant.culture.share), zero, plant.thermal.temperature, rate
        return ShareEstimate(*state, first - 1.0, second - 1.0, -plant.thermal.offset)

    met = patch.object(trials, "calibrate", lambda _, plant, seed: vials.append(plant))
    with met, patch.object(Recall, "estimate", truth):
        yield


def composed(c: CeilingsConfig, known: BenchmarkConfig, plant: str) -> list[float]:
    """Mean |share - setpoint| of `midpoint` on its estimate, on the truth, and of the optimum on the truth."""
    found = [run_cell(known, Cell("midpoint", plant, "ratio_steps", "share", "inverse", True), None)]
    with told():
        for law in ("midpoint", "optimum"):
            found.append(run_cell(known, Cell(law, plant, "ratio_steps", "share", "inverse", True, True), None))
    return [float(np.nanmean(np.abs(trial.share - trial.setpoint))) for trial in found]  # type: ignore[attr-defined]


def parts(task: str, plant: str, errors: list[float]) -> list[str]:
    """A row: the error on the estimate, and its shares in per cent."""
    estimate, truth, best = errors
    shares = (best, truth - best, estimate - truth)
    return [task, plant, number(estimate), *(f"{100.0 * share / estimate:.0f}" for share in shares)]


def ceilings(c: CeilingsConfig, folder: Path) -> None:
    """Both tables."""
    known = replace(benchmark.config(["+experiment=coculture"]), replicates=c.vials, seed=c.seed)
    rows, worths = [], []
    for ahead in (0.0, AHEAD):
        steps = scenario(SCHEDULES["0.8, 0.65, 0.5"], ahead)
        for plant in c.plants:
            runs = [density(c, known, kind, plant, steps) for kind in ("inverse", "inverse, truth", "oracle")]
            task = "density, announced" if ahead else "density"
            rows.append(parts(task, plant, [float(scored(run).mean()) for run in runs]))
    rows += [parts("composition, announced", plant, composed(c, known, plant)) for plant in c.composed]
    leave(folder, __file__, ["task", "plant", "mean abs error", "unavoidable, %", "controller, %", "estimate, %"], rows)
    for plant in c.plants:
        for name, setpoints in SCHEDULES.items():
            cells = [worth(c, known, kind, plant, setpoints) for kind in c.controllers]
            worths.append([plant, name, *cells])
    leave(folder, __file__, ["plant", "setpoints", *c.controllers], worths, "announced")


def worth(c: CeilingsConfig, known: BenchmarkConfig, kind: str, plant: str, setpoints: tuple[float, ...]) -> str:
    """Change of ISE and mean |e| by announcing, %; and of the decisions that the interlock held back, in all vials."""
    runs = [density(c, known, kind, plant, scenario(setpoints, ahead)) for ahead in (AHEAD, 0.0)]
    ise, error = (change(*(scored(run, metric) for run in runs)) for metric in ("ise", "abs_error"))
    held = runs[0].held.sum() - runs[1].held.sum()
    return f"{ise} / {error}" + f", {held:+.0f} held" * bool(held)


def change(mine: Array, theirs: Array) -> str:
    """Paired change of a mean, % and its 95 % interval's half."""
    off = Spread(mine - theirs)
    return f"{100.0 * off.mean / theirs.mean():+.0f} ± {50.0 * (off.ci95[1] - off.ci95[0]) / theirs.mean():.0f}"


main = command(__file__, CeilingsConfig(), ceilings)


if __name__ == "__main__":
    main()
