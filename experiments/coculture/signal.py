"""The share of the second species as a signal that the thermostat controls, with warnings."""

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

ESTIMATE = ("ratio", "ratio_low", "ratio_high")  # values of `explain` that are columns of a recording
COLUMNS = ("fluorescence", "ratio_setpoint", *ESTIMATE, "temperature_target_degc")
TRUE = "true_ratio"
EDGE_C = 0.05  # degC; a target nearer than this to a limit counts as at the limit
NEARER = 0.1  # change of the logit that counts as coming nearer to the goal; 0.025 of the share at one half
OTHER = 0.02  # a goal that changes by more counts as a new goal
SURPRISING = 4.0  # a count further off than this many sds gives a warning
STUCK = "check that the vial follows the thermostat and that both species grow; the setpoint may change too fast"
UNCERTAIN = "check the fluorescence and calibrate its sensor (docs/coculture.md, Calibration of the sensor)"


@dataclass(frozen=True)
class ShareWarnings:
    """Limits of the warnings about a composition. Raises: ValueError with key, value and allowed range."""

    far: float = setting(0.1, "share_stuck: smallest distance of the share from its setpoint", within=(0.01, 1))
    stuck_h: float = setting(
        3.0,
        "share_stuck: time without getting nearer while the thermostat's target is at a limit",
        "h",
        above=0.0,
    )
    wide: float = setting(0.4, "share_uncertain: smallest width of the estimate's 95 % band", within=(0.01, 1))
    wide_h: float = setting(2.0, "share_uncertain: time with such a band", "h", at_least=0.0)

    def __post_init__(self) -> None:
        check(self, "share_warnings")


class LightSignal:
    """Fluorescence of reactors without a composition controller: recorded only."""

    name, actuator, columns, memory = "fluorescence", "", COLUMNS[:1], None
    sees_light = False  # it records fluorescence only if the device measures it anyway

    def decide(self, sample: Sample) -> Array:
        """Return nan, (N,): this signal commands no actuator."""
        return np.full(sample.rows.shape, np.nan)

    def find(self, sample: Sample, given: Array) -> Findings:
        light = sample.measured.fluorescence
        return Findings({"fluorescence": np.full(sample.rows.shape, np.nan) if light is None else light})

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        """Do nothing."""


@dataclass(frozen=True, eq=False)
class Decider:
    """Estimator and controller of the composition."""

    remembers = ("estimator", "law")
    estimator: Recall
    law: Periodic[Any]


class Share:
    """Signal of the second species' share in N reactors, each with its own program, controlled by the thermostat.

    The interlock limits the targets. Their rate of change is not limited: the device's thermostat accepts any step, and
    the interlock tolerates a vial that is still cooling (docs/biology.md, Vial temperature).
    Each sample has a warning while the share is stuck or its estimate uncertain, as defined by `ShareWarnings`. A new
    setpoint or announcement restarts the time of `stuck_h`.

    Args: estimator, law: estimator and controller. schedules: one per reactor. warnings: limits of the warnings.
      simulated: whether the recording has a column with the true share. species: name of the second species.
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
        self._goal, self._best = np.full((2, n), np.nan), np.full((2, n), np.nan)  # best: nearest share so far
        self._nearer_min, self._narrow_min = np.full((2, n), np.nan), np.full(n, np.nan)
        estimator.reset(n)
        law.reset(n)

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the recording; in a simulation the last column is the true share."""
        return (*COLUMNS, TRUE) if self.simulated else COLUMNS

    def known(self, plant: Plant, flow_ml_s: float, bench: Bench) -> None:
        self.truth = lambda: plant.culture.share

    def decide(self, sample: Sample) -> Array:
        """Return thermostat targets, degC, (N,); nan where the share has no setpoint."""
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
        """Return the setpoints of each reactor's program, `elapsed` min after its start; none where that is nan."""
        found = np.empty((3, elapsed.size))
        for schedule in set(self.schedules):
            rows = np.array([other == schedule for other in self.schedules])
            wanted = program_of(schedule).wanted(elapsed[rows], schedule.announced_min)
            found[:, rows] = wanted.setpoint, wanted.following, wanted.minutes
        return Wanted(*found)

    def _warned(
        self, found: dict[str, Array], goal: Array, inside: Mask, minute: Array, believed: Mask
    ) -> list[str | None]:
        """Return a warning or None per reactor. goal: announced or current setpoint. inside: target within limits."""
        stuck = self._stuck(found["ratio"], np.stack([found["ratio_setpoint"], goal]), inside, minute, believed)
        uncertain = self._uncertain(found, minute, believed)
        hours, c = (minute - self._nearer_min).min(axis=0) / 60.0, found
        lines: list[str | None] = []
        for i in range(minute.size):
            said = []
            if stuck[i]:
                at = f"share {c['ratio'][i]:.2f}, setpoint {goal[i]:.2f}"
                heat = f"the thermostat at {c['temperature_target_degc'][i]:.1f} degC"
                said.append(f"share_stuck: {at}, not nearer for {hours[i]:.1f} h with {heat}; reported; {STUCK}")
            if uncertain[i]:
                between = f"share between {c['ratio_low'][i]:.2f} and {c['ratio_high'][i]:.2f}"
                said.append(f"share_uncertain: {between}; reported; {UNCERTAIN}")
            lines.append(" | ".join(said) or None)
        return lines

    def _stuck(self, share: Array, goal: Array, inside: Mask, minute: Array, believed: Mask) -> Mask:
        """Return which shares are stuck, (N,): they approach neither goal. goal: current and announced one, (2, N)."""
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
            return "ignored: drawn more than two days ago, before the data that the estimator keeps", True
        off = abs(share - before) / math.hypot(sd, band / 3.92)
        doubt = f"; the count is {off:.0f} standard deviations off: check reactor and species, unless the share changed"
        after = "the estimate since then is being recomputed"
        if not self.estimator.behind:
            after = f"{self.estimator.explain()['ratio'][n]:.3f} with the count"
        surprising = off > SURPRISING
        return f"estimate {before:.3f} without the count; {after}{doubt if surprising else ''}", surprising

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
        """Report the delivered volume to the estimator; it counts deferred volumes when they are delivered."""
        self.estimator.dosed(volume_ml)

    def draw(self, table: Any, title: str) -> dict[str, Any]:
        from experiments.coculture.charts import composition_figure_of  # Matplotlib

        return {"composition": composition_figure_of(table, self.schedules, self.species, title)}
