"""The share of two species as a signal: held by the thermostat, within limits, with lasting warnings."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from conf.schema import check, setting
from envs.scenario import Scenario
from experiments.laws.share.base import Array, Law, Mask, ShareEstimator, Wanted
from experiments.laws.share.program import Program
from experiments.loop.signals import THERMOSTAT, Findings, Sample
from hardware.memory import Remembers

__all__ = ["COLUMNS", "TRUE", "Share", "ShareWarnings", "program_of"]

ESTIMATE = ("ratio", "ratio_low", "ratio_high")  # of what the estimator explains, the columns of a recording
COLUMNS = ("fluorescence", "ratio_setpoint", *ESTIMATE, "temperature_target_degc")
TRUE = "true_ratio"
EDGE_C = 0.05  # a target so near a limit is at it
NEARER = 0.02  # a share that has moved so far towards its goal comes nearer; a goal that jumps by more is another one
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


def program_of(schedule: Scenario) -> Program:
    """What a schedule asks for of the share."""
    if schedule.ratio_sine:
        mean, amplitude, period = schedule.ratio_sine
        return Program((), schedule.minutes, (mean, amplitude, period))
    ratios = schedule.ratios or (None,) * len(schedule.minutes)
    return Program(tuple(math.nan if r is None else r for r in ratios), schedule.minutes)


@dataclass(frozen=True, eq=False)
class Decider:
    """What is believed of the share, and what is done about it."""

    remembers = ("estimator", "law")
    estimator: ShareEstimator
    law: Law


class Share:
    """The share of the second species in N reactors, each with its own program; held by the thermostat.

    Targets are cut by the interlock. There is no limit of their rate: the device's thermostat takes any step, and the
    interlock allows for a vial that still cools (docs/biology.md, Vial temperature).
    A share is out of control, which is said in every sample until it is over, where it is stuck or its estimate is
    uncertain as `ShareWarnings` has it. Another share that is asked for or announced begins anew.

    Args: estimator: what is believed; law: what is done about it; schedules: one per reactor; warnings: when to warn.
      simulated: the recording has the true share, which `truth` gives.
    """

    name, actuator = "composition", THERMOSTAT
    remembers = ("controller", "goal", "best", "nearer_min", "narrow_min")

    def __init__(
        self,
        estimator: ShareEstimator,
        law: Law,
        schedules: Sequence[Scenario],
        warnings: ShareWarnings | None = None,
        simulated: bool = False,
    ) -> None:
        self.estimator, self.law, self.controller = estimator, law, Decider(estimator, law)
        self.schedules, self.warnings, self.simulated = schedules, warnings or ShareWarnings(), simulated
        self.truth: Callable[[], Array] = lambda: np.full(n, np.nan)
        n = len(schedules)
        self._programs = [program_of(s) for s in schedules]
        self._goal, self._best = np.full(n, np.nan), np.full(n, np.nan)  # the nearest share to it so far
        self._nearer_min, self._narrow_min = np.full(n, np.nan), np.full(n, np.nan)
        estimator.reset(n)
        law.reset(n)

    @property
    def columns(self) -> tuple[str, ...]:
        """See `Signal`; a simulation's true share is the last."""
        return (*COLUMNS, TRUE) if self.simulated else COLUMNS

    def decide(self, sample: Sample) -> Array:
        """See `Signal.decide`; nan where no share is asked for."""
        m, wanted = sample.measured, self.wanted(sample.elapsed)
        asked = np.isfinite(wanted.setpoint)
        self.estimator.watch(m.od, sample.light, m.temperature, sample.minute, sample.believed)
        on = sample.believed & asked & self.estimator.begun
        return np.where(asked, self.law.act(self.estimator.estimate(), wanted, sample.elapsed, on), np.nan)

    def find(self, sample: Sample, given: Array) -> Findings:
        """See `Signal.find`."""
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
        """What each reactor's program asks for, `elapsed` min after it began; nothing where that is nan."""
        each = [
            program.wanted(elapsed[i : i + 1], schedule.announce_min)
            for i, (program, schedule) in enumerate(zip(self._programs, self.schedules, strict=True))
        ]
        keys = ("setpoint", "following", "minutes")
        return Wanted(*(np.concatenate([getattr(wanted, key) for wanted in each]) for key in keys))

    def _warned(
        self, found: dict[str, Array], goal: Array, inside: Mask, minute: Array, believed: Mask
    ) -> list[str | None]:
        """What is out of control in each believed row, None elsewhere.

        Args: goal: the share that is announced, else the one asked for, (N,). inside: targets that are at no limit.
        """
        stuck = self._stuck(found["ratio"], goal, inside, minute, believed)
        uncertain = self._uncertain(found, minute, believed)
        hours, c = (minute - self._nearer_min) / 60.0, found
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
        rows, away = believed & np.isfinite(goal), goal - share
        same = np.abs(goal - self._goal) <= NEARER
        well = rows & (inside | ~(np.abs(away) > self.warnings.far) | ~same)
        nearer = well | (rows & (np.sign(away) * (share - self._best) > NEARER))
        self._best = np.where(nearer, share, self._best)
        self._nearer_min = np.where(nearer, minute, self._nearer_min)
        self._goal = np.where(believed, goal, self._goal)
        return np.asarray(rows & ~well & (minute - self._nearer_min >= 60.0 * self.warnings.stuck_h))

    def _uncertain(self, found: dict[str, Array], minute: Array, believed: Mask) -> Mask:
        narrow = believed & (found["ratio_high"] - found["ratio_low"] <= self.warnings.wide)
        first = believed & np.isnan(self._narrow_min)
        self._narrow_min = np.where(narrow | first, minute, self._narrow_min)
        return np.asarray(believed & ~narrow & (minute - self._narrow_min >= 60.0 * self.warnings.wide_h))

    @property
    def memory(self) -> Remembers:
        """See `Signal.memory`."""
        return self

    def dosed(self, volume_ml: Array, kept_ml: Array) -> None:
        """See `Signal.dosed`; what was put off comes later."""
        self.estimator.dosed(volume_ml)
