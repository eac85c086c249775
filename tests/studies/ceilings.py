"""What no controller can gain, and what a change known ahead is worth: `python -m tests.studies.ceilings`.

Noise-free mean |error| of a one-line controller on its estimate, of the same one on the true state, and of dynamic
programming on the true state: what is left with the last is unavoidable. A plan of the whole schedule bounds what
announcing can be worth.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.coculture.second import of_plant
from envs.coculture.task import logit
from envs.plant.plant import Plant
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.benchmark import main as benchmark
from experiments.coculture import comparison
from experiments.coculture.base import ShareEstimate
from experiments.coculture.comparison import ShareCell
from experiments.coculture.recall import Recall
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.statistics import Spread
from experiments.comparison.trials import Cell, DensityTrial, run_cell, run_trial, windows
from experiments.laws import registry
from experiments.laws.base import Array, Controller, Mask
from experiments.reporting.tables import number
from hardware.safety.interlock import Interlock, Ruling
from tests.entry import command
from tests.studies.results import leave
from tests.studies.supervision import shipped

__all__ = ["CeilingsConfig", "main"]

SCHEDULES = (
    Scenario((0.8, 0.65, 0.5), (30.0,) * 3, (37.0,) * 3, recovery_od=0.8),
    Scenario((0.5, 0.8, 0.4, 0.7), (25.0, 40.0, 30.0, 35.0), (37.0,) * 4, recovery_od=0.5),
)
CONTROLLERS = ("inverse", "shipped", "pi_tuned")
TRUE, PLAN = ", truth", "plan"
METRICS = ("ise", "abs_error")
Density = Callable[[str, str, Scenario, bool], tuple[DensityTrial, "Counter[str]"]]


@dataclass(frozen=True)
class CeilingsConfig:
    """How many vials of which plants."""

    vials: int = setting(64, "of each row", within=(2, 4096))
    plants: tuple[str, ...] = setting(("bench", "measured", "recorded", "tired_pump"), "whose density is held")
    seed: int = setting(60221, "of the vials", at_least=0)

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


class Plan:
    """Dynamic programming over a whole schedule on the true state: the present growth and mean dose go on.

    Args: metric: whose mean over the windows is least.
    """

    OD, SHARES = np.linspace(np.log(0.24), np.log(1.2), 350), np.linspace(0.0, 1.0, 17)
    EVERY_MIN = 30.0  # it is made anew

    def __init__(self, plant: Plant, schedule: Scenario, model: EnvConfig, metric: str) -> None:
        self._plant, self._rate, self._power = plant, model.max_pump_rate, 2.0 if metric == "ise" else 1.0
        self._minutes, self._windows = int(schedule.total_min), windows(schedule)

    def reset(self, n: int) -> None:
        """Begin anew."""
        self._began, self._planned = np.full(n, np.nan), -np.inf

    def _cost(self, minute: int) -> Array:
        """Of each OD at a sample; that between two windows is half in each."""
        inside = [w for w in self._windows if w.start <= minute <= w.end]
        weights = [
            (0.5 if minute in (w.start, w.end) else 1.0) / (w.end - w.start) ** (self._power < 2) for w in inside
        ]
        off = [np.abs(np.exp(self.OD) - w.setpoint) ** self._power for w in inside]
        return np.asarray(sum(weight * each for weight, each in zip(weights, off, strict=True)))

    def _places(self, ln_od: Array, shares: Array) -> tuple[NDArray[np.intp], Array]:
        """Where a minute at each share of the full pump leads: left point of the grid, and what is beyond it."""
        full, growth = self._plant.at_rest(1.0, 60.0 * self._rate)
        at = ln_od[..., None] + (full * growth)[:, None, None] - full[:, None, None] * shares
        place = np.clip((at - self.OD[0]) / (self.OD[1] - self.OD[0]), 0.0, self.OD.size - 1.000001)
        return place.astype(np.intp), place % 1.0

    def _plan(self) -> None:
        """Values of each vial at each sample, (minutes + 1, N, OD)."""
        left, beyond = self._places(self.OD[None], self.SHARES)
        row = np.arange(left.shape[0])[:, None, None]
        values = [np.tile(self._cost(self._minutes), (row.size, 1))]
        for k in range(self._minutes - 1, -1, -1):
            now, rise = values[-1], np.diff(values[-1], axis=1)
            values.append(self._cost(k) + (now[row, left] + beyond * rise[row, left]).min(axis=-1))
        self._values = np.stack(values[::-1])

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`; the reading is not used."""
        self._began = np.where(np.isnan(self._began) & rows, minute, self._began)
        if minute.max() >= self._planned + self.EVERY_MIN:
            self._planned = float(minute.max())
            self._plan()
        k = np.clip(np.nan_to_num(np.rint(minute - self._began)) + 1, 0, self._minutes).astype(np.intp)
        row, shares = np.arange(od.size), np.linspace(0.0, 1.0, 129)
        left, beyond = (each[:, 0].T for each in self._places(np.log(self._plant.apparent_od)[:, None], shares))
        low, high = self._values[k, row, left], self._values[k, row, left + 1]
        return np.asarray(self._rate * shares[(low + beyond * (high - low)).argmin(axis=0)])


@contextmanager
def judged() -> Iterator["Counter[str]"]:
    """Inside, the interlock's faults are counted by kind, one a vial and sample; "dose": the largest, µL."""
    found, check = Counter[str](), Interlock.check

    def checked(interlock: Interlock, *given: Any) -> Ruling:
        ruling = check(interlock, *given)
        found.update(kind for kinds in ruling.kinds for kind in kinds)
        found["dose"] = max(found["dose"], round(float(6e4 * interlock.bench.control_min * ruling.rate.max())))
        return ruling

    with patch.object(Interlock, "check", checked):
        yield found


def density(
    known: BenchmarkConfig, kind: str, plant: str, schedule: Scenario, told: bool
) -> tuple[DensityTrial, "Counter[str]"]:
    """One run of all vials, and what the interlock found."""
    model, schedule = known.env, replace(schedule, announce_min="auto" if told else 0.0)

    def make(vials: Plant) -> Controller:
        if kind == "shipped":
            return shipped()
        if kind.startswith(PLAN):
            return Plan(vials, schedule, model, kind.removeprefix(PLAN))
        law: Any = registry.build(known.controllers[kind.removesuffix(TRUE)], model=model, plant=vials)
        if kind.endswith(TRUE):
            law.estimator = Truth(vials, model.control_min, model.max_pump_rate)
        return law  # type: ignore[no-any-return]

    cell = Cell(kind, plant, "steps")
    with judged() as found:
        return run_trial(cell, known.plants[plant], schedule, make, model, known.replicates, known.seed), found


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


def worth(run: Density, kind: str, plant: str, schedule: Scenario) -> str:
    """Change of ISE and of mean |e| by announcing, %."""
    mine, theirs = (run(kind, plant, schedule, told)[0] for told in (True, False))
    cells = []
    for metric in METRICS:
        off, mean = Spread(scored(mine, metric) - scored(theirs, metric)), float(scored(theirs, metric).mean())
        cells.append(f"{100.0 * off.mean / mean:+.0f} ± {50.0 * (off.ci95[1] - off.ci95[0]) / mean:.0f}")
    return " / ".join(cells)


def bound(run: Density, plant: str, schedule: Scenario) -> list[str]:
    """What announcing is worth on the true state: the same rule beside `inverse`, the best plan beside each controller.

    In per cent of what the controller has on its estimate and without announcement.
    """

    def mean(kind: str, told: bool, metric: str) -> float:
        return float(scored(run(kind, plant, schedule, told)[0], metric).mean())

    rows = []
    for metric in METRICS:
        exact, half = (mean(f"inverse{TRUE}", told, metric) for told in (False, True))
        best = mean(f"{PLAN}{metric}", False, metric)
        parts = [(half, "inverse"), *((best, kind) for kind in CONTROLLERS)]
        rows.append([f"{100.0 * (found - exact) / mean(kind, False, metric):+.0f}" for found, kind in parts])
    return [" / ".join(pair) for pair in zip(*rows, strict=True)]


def alarms(run: Density, plants: tuple[str, ...]) -> list[list[str]]:
    """Faults of the interlock by kind in all those runs, announced / not."""
    cells = [(kind, schedule) for kind in CONTROLLERS for schedule in SCHEDULES]
    found = {(p, told): [run(k, p, s, told)[1] for k, s in cells] for p in plants for told in (True, False)}
    kinds = sorted({kind for each in found.values() for one in each for kind in one} - {"dose"})
    rows = [
        [k, *(" / ".join(str(sum(o[k] for o in found[p, told])) for told in (True, False)) for p in plants)]
        for k in kinds
    ]
    doses = [
        " / ".join(f"{max(o['dose'] for o in found[p, told]) / 1e3:.2f}" for told in (True, False)) for p in plants
    ]
    return [*rows, ["largest dose, mL", *doses]]


def ceilings(c: CeilingsConfig, folder: Path) -> None:
    """Write all tables."""
    known = replace(benchmark.config(["+experiment=coculture"]), replicates=c.vials, seed=c.seed)
    run: Density = cache(partial(density, known))
    rows = []
    for task, told in (("density", False), ("density, announced", True)):
        for plant in c.plants:
            runs = (run(kind, plant, SCHEDULES[0], told)[0] for kind in ("inverse", f"inverse{TRUE}", "oracle"))
            rows.append(parts(task, plant, [float(scored(each).mean()) for each in runs]))
    rows.append(parts("composition, announced", "coculture_mixed", composed(known, "coculture_mixed")))
    leave(folder, __file__, ["task", "plant", "mean abs error", "unavoidable, %", "controller, %", "estimate, %"], rows)
    named = [(plant, ", ".join(map(str, s.setpoints)), s) for plant in c.plants for s in SCHEDULES]
    body = [[plant, name, *(worth(run, kind, plant, s) for kind in CONTROLLERS)] for plant, name, s in named]
    leave(folder, __file__, ["plant", "setpoints", *CONTROLLERS], body, "announced")
    body = [[plant, name, *bound(run, plant, s)] for plant, name, s in named]
    columns = ["plant", "setpoints", "half-way, inverse", *(f"best plan, {kind}" for kind in CONTROLLERS)]
    leave(folder, __file__, columns, body, "announced_bound")
    leave(folder, __file__, ["kind", *c.plants], alarms(run, c.plants), "announced_alarms")


main = command(__file__, CeilingsConfig(), ceilings)


if __name__ == "__main__":
    main()
