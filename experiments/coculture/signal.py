"""The share of two species as a signal: held by the thermostat, within limits, with lasting warnings."""

import bisect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.bench import Bench
from envs.coculture.task import logit
from envs.plant.plant import Plant
from envs.scenario import Scenario
from experiments.coculture.base import Array, Mask, Wanted
from experiments.coculture.laws import Periodic
from experiments.coculture.program import program_of
from experiments.coculture.recall import Recall
from experiments.loop.signals import Answer, Count, Findings, Sample, Span
from hardware.actuator import THERMOSTAT
from hardware.memory import Remembers

ESTIMATE = ("ratio", "ratio_low", "ratio_high")  # of what the estimator explains, the columns of a recording
COLUMNS = ("fluorescence", "ratio_setpoint", *ESTIMATE, "temperature_target_degc")
TRUE = "true_ratio"
EDGE_C = 0.05  # a target so near a limit is at it
NEARER = 0.1  # of the logit: a share that has moved so far towards its goal comes nearer; 0.025 at one half
OTHER = 0.02  # a goal that jumps by more is another one
SURPRISING = 4.0  # sds
STUCK = "check that the vial follows the thermostat and that both species grow; the program may ask for too much"
UNCERTAIN = "check the fluorescence and calibrate its sensor (docs/coculture.md, Calibration of the sensor)"


@dataclass(frozen=True)
class ShareWarnings:
    """When a share is said to be out of control. Raises: ValueError naming key, value and allowed range."""

    far: float = setting(0.1, "a share farther than this from its setpoint is far", within=(0.01, 1))
    stuck_h: float = setting(
        3.0,
        "a share is stuck that is far and came no nearer for so long with the thermostat's target at a limit",
        "h",
        above=0.0,
    )
    wide: float = setting(0.4, "an estimate whose 95 % band is wider than this is uncertain", within=(0.01, 1))
    wide_h: float = setting(2.0, "if it is so for this long", "h", at_least=0.0)

    def __post_init__(self) -> None:
        check(self, "share_warnings")


class LightSignal:
    """Fluorescence of reactors without a composition controller: recorded only."""

    name, actuator, columns, memory = "fluorescence", "", COLUMNS[:1], None
    sees_light = False  # what is measured anyhow

    def decide(self, sample: Sample) -> Array:
        """See `Signal.decide`: it asks for no temperature."""
        return np.full(sample.rows.shape, np.nan)

    def find(self, sample: Sample, given: Array) -> Findings:
        light = sample.measured.fluorescence
        return Findings({"fluorescence": np.full(sample.rows.shape, np.nan) if light is None else light})

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        """See `Signal.dosed`."""


@dataclass(frozen=True, eq=False)
class Decider:
    """Estimator and controller of the composition."""

    remembers = ("estimator", "law")
    estimator: Recall
    law: Periodic[Any]


class Share:
    """The share of the second species in N reactors, each with its own program; held by the thermostat.

    Targets are cut by the interlock. There is no limit of their rate: the device's thermostat takes any step, and the
    interlock allows for a vial that still cools (docs/biology.md, Vial temperature).
    A share is out of control, which is said in every sample until it is over, where it is stuck or its estimate is
    uncertain as `ShareWarnings` has it. Another share that is asked for or announced begins anew.

    Args: estimator: what is believed; law: what is done about it; schedules: one per reactor; warnings: when to warn.
      simulated: the recording has the true share, which `truth` gives. species: whose share it is, in figures.
    """

    name, actuator, sees_light = "composition", THERMOSTAT.name, True
    remembers = ("controller", "goal", "best", "nearer_min", "narrow_min")

    def __init__(
        self,
        estimator: Recall,
        law: Periodic[Any],
        schedules: Sequence[Scenario],
        warnings: ShareWarnings | None = None,
        simulated: bool = False,
        species: str = "the second species",
    ) -> None:
        self.estimator, self.law, self.controller = estimator, law, Decider(estimator, law)
        self.schedules, self.warnings, self.simulated = schedules, warnings or ShareWarnings(), simulated
        self.species = species
        self.truth: Callable[[], Array] = lambda: np.full(n, np.nan)
        n = len(schedules)
        self._goal, self._best = np.full((2, n), np.nan), np.full((2, n), np.nan)  # the nearest share to it so far
        self._nearer_min, self._narrow_min = np.full((2, n), np.nan), np.full(n, np.nan)
        estimator.reset(n)
        law.reset(n)

    @property
    def columns(self) -> tuple[str, ...]:
        """See `Signal`; a simulation's true share is the last."""
        return (*COLUMNS, TRUE) if self.simulated else COLUMNS

    def known(self, plant: Plant, flow_ml_s: float, bench: Bench) -> None:
        self.truth = lambda: plant.culture.share

    def decide(self, sample: Sample) -> Array:
        """See `Signal.decide`; nan where no share is asked for."""
        m, wanted = sample.measured, self.wanted(sample.elapsed)
        asked = np.isfinite(wanted.setpoint)
        self.estimator.watch(m.od, sample.light, m.temperature, sample.minute, sample.believed)
        on = sample.believed & asked & self.estimator.begun
        return np.where(asked, self.law.act(self.estimator.estimate(), wanted, sample.elapsed, on), np.nan)

    def find(self, sample: Sample, given: Array) -> Findings:
        m, wanted, believed = sample.measured, self.wanted(sample.elapsed), self.estimator.explain()
        known = {"ratio_setpoint": wanted.setpoint, "temperature_target_degc": given}
        known |= {"fluorescence": np.full(m.od.shape, np.nan) if m.fluorescence is None else m.fluorescence}
        known |= {key: believed[key] for key in ESTIMATE}
        found = {key: known[key] for key in COLUMNS}
        if self.simulated:
            found[TRUE] = self.truth()
        why = {key: value for key, value in believed.items() if key not in ESTIMATE}
        low, high = sample.limits
        inside = (given > low + EDGE_C) & (given < high - EDGE_C)
        goal = np.where(wanted.minutes > 0.0, wanted.following, wanted.setpoint)
        return Findings(found, why, self._warned(found, goal, inside, sample.minute, sample.believed))

    def wanted(self, elapsed: Array) -> Wanted:
        """Return what each reactor's program asks for, `elapsed` min after it began; nothing where that is nan."""
        found = np.empty((3, elapsed.size))
        for schedule in set(self.schedules):
            rows = np.array([other == schedule for other in self.schedules])
            wanted = program_of(schedule).wanted(elapsed[rows], schedule.announced_min)
            found[:, rows] = wanted.setpoint, wanted.following, wanted.minutes
        return Wanted(*found)

    def _warned(
        self, found: dict[str, Array], goal: Array, inside: Mask, minute: Array, believed: Mask
    ) -> list[str | None]:
        """Warn of what is out of control in each used row, None elsewhere.

        Args: goal: the share that is announced, else the one asked for, (N,). inside: targets that are at no limit.
        """
        stuck = self._stuck(found["ratio"], np.stack([found["ratio_setpoint"], goal]), inside, minute, believed)
        uncertain = self._uncertain(found, minute, believed)
        hours, c = (minute - self._nearer_min).min(axis=0) / 60.0, found
        lines: list[str | None] = []
        for i in range(minute.size):
            said = []
            if stuck[i]:
                at = f"share {c['ratio'][i]:.2f}, wanted {goal[i]:.2f}"
                heat = f"the thermostat at {c['temperature_target_degc'][i]:.1f} degC"
                said.append(f"share_stuck: {at}, no nearer for {hours[i]:.1f} h with {heat}; reported; {STUCK}")
            if uncertain[i]:
                between = f"share between {c['ratio_low'][i]:.2f} and {c['ratio_high'][i]:.2f}"
                said.append(f"share_uncertain: {between}; reported; {UNCERTAIN}")
            lines.append(" | ".join(said) or None)
        return lines

    def _stuck(self, share: Array, goal: Array, inside: Mask, minute: Array, believed: Mask) -> Mask:
        """Which come nearer to neither of two goals, (2, N), the share asked for and the one announced."""
        rows, away = believed & np.isfinite(goal), goal - share
        same = np.abs(goal - self._goal) <= OTHER
        well = rows & (inside | ~(np.abs(away) > self.warnings.far) | ~same)
        nearer = well | (rows & (np.sign(away) * (logit(share) - logit(self._best)) > NEARER))
        self._best = np.where(nearer, share, self._best)
        self._nearer_min = np.where(nearer, minute, self._nearer_min)
        self._goal = np.where(believed, goal, self._goal)
        return np.asarray((rows & ~well & (minute - self._nearer_min >= 60.0 * self.warnings.stuck_h)).all(axis=0))

    def _uncertain(self, found: dict[str, Array], minute: Array, believed: Mask) -> Mask:
        narrow = believed & (found["ratio_high"] - found["ratio_low"] <= self.warnings.wide)
        first = believed & np.isnan(self._narrow_min)
        self._narrow_min = np.where(narrow | first, minute, self._narrow_min)
        return np.asarray(believed & ~narrow & (minute - self._narrow_min >= 60.0 * self.warnings.wide_h))

    def counted(self, n: int, share: float, sd: float, minute: float) -> Answer:
        mine = np.arange(len(self.schedules)) == n
        told = self.estimator.explain()
        before, band = told["ratio"][n], told["ratio_high"][n] - told["ratio_low"][n]
        if not self.estimator.sample(np.where(mine, share, np.nan), np.full(mine.size, sd), minute, mine):
            return "left out: longer ago than the two days that the estimate goes back", True
        off = abs(share - before) / math.hypot(sd, band / 3.92)
        doubt = f"; {off:.0f} sds from it, if the share has not moved since: right reactor, right species?"
        after = "its day is taken again, some hours with each reading"
        if not self.estimator.behind:
            after = f"{self.estimator.explain()['ratio'][n]:.3f} after it"
        surprising = off > SURPRISING
        return f"estimated {before:.3f} before it; {after}{doubt if surprising else ''}", surprising

    def retell(self, rows: Sequence[Mapping[str, Sequence[float]]], counted: Sequence[Count], light: Span) -> None:
        known, told = self.estimator.known + 1e-3, []  # minutes are recorded to 1e-4
        mine = np.eye(len(rows), dtype=np.bool_)
        for n, c in enumerate(rows):
            for k in range(bisect.bisect_right(c["time_min"], known[n]), len(c["time_min"])):
                minute, counts = c["time_min"][k], c["fluorescence"][k]
                seen = counts if light[0] <= counts <= light[1] else np.nan
                read = (c["od"][k], seen, c["temperature_degc"][k], minute)
                if c["believed"][k]:
                    told.append((minute, 0, "watch", (*(np.where(mine[n], v, np.nan) for v in read), mine[n])))
                if (volume := c["volume_ml"][k]) > 0.0:
                    told.append((minute, 2, "dosed", (np.where(mine[n], volume, 0.0),)))
        for n, share, sd, minute in counted:
            sample = (np.where(mine[n], share, np.nan), np.full(len(rows), sd), mine[n])
            if minute > known[n]:
                told.append((minute, 1, "sample", sample))
        told.sort(key=lambda event: event[:2])
        self.estimator.retell((minute, method, arguments) for minute, _, method, arguments in told)

    @property
    def memory(self) -> Remembers:
        return self

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        """See `Signal.dosed`; deferred volumes (`kept_ml`) are counted when they are delivered."""
        self.estimator.dosed(volume_ml)

    def draw(self, table: Any, title: str) -> dict[str, Any]:
        from experiments.coculture.charts import composition_figure_of  # Matplotlib

        return {"composition": composition_figure_of(table, self.schedules, self.species, title)}
