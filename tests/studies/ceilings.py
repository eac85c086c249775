"""What no controller can gain, and what a change known ahead is worth: `python -m tests.studies.ceilings`.

Noise-free mean |error| of a one-line controller on its estimate, of the same one on the true state, and of dynamic
programming on the true state: what is left with the last is unavoidable.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from conf.schema import check, setting
from envs.coculture.second import of_plant
from envs.coculture.task import logit
from envs.plant.plant import Plant
from envs.scenario import Scenario
from experiments.benchmark import main as benchmark
from experiments.coculture import comparison
from experiments.coculture.base import ShareEstimate
from experiments.coculture.comparison import ShareCell
from experiments.coculture.recall import Recall
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.statistics import Spread
from experiments.comparison.trials import Cell, DensityTrial, run_cell, run_trial, windows
from experiments.laws import registry
from experiments.laws.base import Array, Controller
from experiments.reporting.tables import number
from tests.entry import command
from tests.studies.results import leave
from tests.studies.supervision import shipped

__all__ = ["CeilingsConfig", "main"]

SCHEDULES = ((0.8, 0.65, 0.5), (0.5, 0.8, 0.4, 0.7))
CONTROLLERS = ("inverse", "shipped", "pi_tuned")
TRUE = ", truth"


@dataclass(frozen=True)
class CeilingsConfig:
    """How many vials of which plants."""

    vials: int = setting(64, "of each row", within=(2, 4096))
    plants: tuple[str, ...] = setting(("bench", "measured", "recorded", "tired_pump"), "whose density is held")
    seed: int = setting(8128, "of the vials", at_least=0)

    def __post_init__(self) -> None:
        check(self)


class Truth:
    """An estimator of the density that is told the truth. Args: of the vials; model: of the control period and pump."""

    def __init__(self, plant: Plant, control_min: float, max_rate: float) -> None:
        self._plant, self._of = plant, (control_min, 60.0 * control_min * max_rate)

    @property
    def full_pump(self) -> Array:
        """What one period of full pump takes off ln OD, (N,)."""
        return self._plant.at_rest(*self._of)[0]

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return error and growth share, each (N,)."""
        full, share = self._plant.at_rest(*self._of)
        return np.log(self._plant.apparent_od / setpoint) / full, share

    def explain(self) -> dict[str, Array]:
        """Explain nothing."""
        return {}

    def _nothing(self, *_: Any) -> None:
        """Learn nothing."""

    reset = watch = see = decided = dosed = _nothing


def density(known: BenchmarkConfig, kind: str, plant: str, setpoints: tuple[float, ...], ahead: float) -> DensityTrial:
    """One run of all vials, half an hour at each setpoint."""
    model, n = known.env, len(setpoints)
    schedule = Scenario(setpoints, (30.0,) * n, (37.0,) * n, recovery_od=setpoints[0], announce_min=ahead)

    def make(vials: Plant) -> Controller:
        if kind == "shipped":
            return shipped()
        law: Any = registry.build(known.controllers[kind.removesuffix(TRUE)], model=model, plant=vials)
        if kind.endswith(TRUE):
            law.estimator = Truth(vials, model.control_min, model.max_pump_rate)
        return law  # type: ignore[no-any-return]

    cell = Cell(kind, plant, "steps")
    return run_trial(cell, known.plants[plant], schedule, make, model, known.replicates, known.seed)


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
        first, second = (
            plant.draws["mu"] / plant.config.growth.mu,
            plant.draws["second_mu"] / of_plant(plant.config).second.mu,
        )
        state = logit(plant.culture.share), zero, plant.thermal.temperature, rate
        return ShareEstimate(*state, first - 1.0, second - 1.0, -plant.thermal.offset)

    met = patch.object(comparison, "calibrate", lambda _, plant, seed: vials.append(plant))
    with met, patch.object(Recall, "estimate", truth):
        yield


def composed(known: BenchmarkConfig, plant: str) -> list[float]:
    """Mean |share - setpoint| of `midpoint` on its estimate, on the truth, and of the optimum on the truth."""
    cell = ShareCell("midpoint", plant, "ratio_steps", density="inverse", announced=True)
    found: list[Any] = [run_cell(known, cell, None)]
    with told():
        for law in ("midpoint", "optimum"):
            found.append(run_cell(known, replace(cell, controller=law, calibrated=True), None))
    return [float(np.nanmean(np.abs(trial.share - trial.setpoint))) for trial in found]


def parts(task: str, plant: str, errors: list[float]) -> list[str]:
    """A row: the error on the estimate, and its shares in per cent."""
    estimate, truth, best = errors
    shares = (best, truth - best, estimate - truth)
    return [task, plant, number(estimate), *(f"{100.0 * share / estimate:.0f}" for share in shares)]


def worth(known: BenchmarkConfig, kind: str, plant: str, setpoints: tuple[float, ...]) -> str:
    """Change of ISE and mean |e| by announcing, %; and of the decisions that the interlock held back, in all vials."""
    mine, theirs = (density(known, kind, plant, setpoints, ahead) for ahead in (60.0, 0.0))
    cells = []
    for metric in ("ise", "abs_error"):
        off, mean = Spread(scored(mine, metric) - scored(theirs, metric)), float(scored(theirs, metric).mean())
        cells.append(f"{100.0 * off.mean / mean:+.0f} ± {50.0 * (off.ci95[1] - off.ci95[0]) / mean:.0f}")
    held = mine.held.sum() - theirs.held.sum()
    return " / ".join(cells) + f", {held:+.0f} held" * bool(held)


def ceilings(c: CeilingsConfig, folder: Path) -> None:
    """Both tables."""
    known = replace(benchmark.config(["+experiment=coculture"]), replicates=c.vials, seed=c.seed)
    rows = []
    for task, ahead in (("density", 0.0), ("density, announced", 60.0)):
        for plant in c.plants:
            runs = (
                density(known, kind, plant, SCHEDULES[0], ahead) for kind in ("inverse", f"inverse{TRUE}", "oracle")
            )
            rows.append(parts(task, plant, [float(scored(run).mean()) for run in runs]))
    rows.append(parts("composition, announced", "coculture_mixed", composed(known, "coculture_mixed")))
    leave(folder, __file__, ["task", "plant", "mean abs error", "unavoidable, %", "controller, %", "estimate, %"], rows)
    each = [(plant, s, *(worth(known, k, plant, s) for k in CONTROLLERS)) for plant in c.plants for s in SCHEDULES]
    body = [(plant, ", ".join(map(str, s)), *cells) for plant, s, *cells in each]
    leave(folder, __file__, ["plant", "setpoints", *CONTROLLERS], body, "announced")


main = command(__file__, CeilingsConfig(), ceilings)


if __name__ == "__main__":
    main()
