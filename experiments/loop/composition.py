"""Composition in the loop: from believed samples to thermostat targets, within limits, with lasting warnings."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from conf.schema import check, setting
from envs.scenario import Scenario
from experiments.composition.base import Array, Mask, Wanted
from experiments.composition.program import Program
from hardware.memory import Remembers
from hardware.reactor import Measurement
from hardware.safety.interlock import Interlock

__all__ = ["COLUMNS", "TRUE", "Composed", "Composition", "Keeper", "ShareWarnings", "columns", "program_of"]

ESTIMATE = ("ratio", "ratio_low", "ratio_high")  # of what a controller explains, the columns of a recording
COLUMNS = ("fluorescence", "ratio_setpoint", *ESTIMATE, "temperature_target_degc")
TRUE = "true_ratio"
EDGE_C = 0.05  # a target so near a limit is at it
NEARER = 0.02  # a share that has moved so far towards its goal comes nearer; a goal that jumps by more is another one
STUCK = "check that the vial follows the thermostat and that both species grow; the program may ask for too much"
UNCERTAIN = "check the fluorescence and calibrate its sensor (docs/coculture.md, Calibration of the sensor)"


def columns(true: bool) -> tuple[str, ...]:
    """The columns that a composition adds at the end of a recording. Args: true: of a simulation, which knows it."""
    return (*COLUMNS, TRUE) if true else COLUMNS


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


class Keeper(Remembers, Protocol):
    """What is asked of a controller of the composition, structurally; arrays (N,)."""

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""
        ...

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """A sample: OD, counts, degC, min since the run began; rows: True where it is new and believed."""
        ...

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in since this was last called, mL."""
        ...

    def target(self, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """Thermostat targets, degC; minute: since the program began; rows: where readings are new and a share asked."""
        ...

    def explain(self) -> dict[str, Array]:
        """The estimate behind the last target: ratio, ratio_low, ratio_high and more."""
        ...


@dataclass(frozen=True, eq=False)
class Composed:
    """What came of a sample: thermostat targets, degC, (N,); columns of the recording; further reasons; warnings."""

    target: Array
    columns: dict[str, Array]
    why: dict[str, Array]
    warnings: list[str | None]


class Composition:
    """A controller of the composition on N reactors, each with its own program of shares.

    Targets are cut by the interlock. There is no limit of their rate: the device's thermostat takes any step, and the
    interlock allows for a vial that still cools (docs/biology.md, Vial temperature).
    A share is out of control, which is said in every sample until it is over, where it is stuck or its estimate is
    uncertain as `ShareWarnings` has it. Another share that is asked for or announced begins anew.

    Args: controller; schedules: one per reactor; warnings: when to warn. truth: the shares of a simulation, for its
      recording.
    """

    remembers = ("controller", "goal", "best", "nearer_min", "narrow_min")

    def __init__(
        self,
        controller: Keeper,
        schedules: Sequence[Scenario],
        warnings: ShareWarnings | None = None,
        truth: Callable[[], Array] | None = None,
    ) -> None:
        self.controller, self.schedules, self.warnings = controller, schedules, warnings or ShareWarnings()
        self._truth, n = truth, len(schedules)
        self._programs = [program_of(s) for s in schedules]
        self._goal, self._best = np.full(n, np.nan), np.full(n, np.nan)  # the nearest share to it so far
        self._nearer_min, self._narrow_min = np.full(n, np.nan), np.full(n, np.nan)
        controller.reset(n)

    def step(self, m: Measurement, interlock: Interlock, elapsed: Array, believed: Mask, scheduled: Array) -> Composed:
        """Watch a sample and decide.

        Args:
          m: the sample. interlock: says which fluorescence is believed, and cuts targets. elapsed: min since the
            schedule began, nan before, (N,). believed: rows whose OD is new and believed, (N,).
          scheduled: the schedule's targets, degC, (N,).
        """
        minute, none = m.time_s / 60.0, np.full(m.od.shape, np.nan)
        wanted = self.wanted(elapsed)
        asked = np.isfinite(wanted.setpoint)
        light = interlock.fluorescence(m)
        self.controller.watch(m.od, none if light is None else light, m.temperature, minute, believed)
        chosen = self.controller.target(wanted, elapsed, believed & asked)
        allowed = interlock.temperature(np.where(asked, chosen, np.nan))
        target = np.where(np.isfinite(allowed), allowed, scheduled)
        told = self.controller.explain()
        known = {"ratio_setpoint": wanted.setpoint, "temperature_target_degc": target}
        known |= {"fluorescence": none if m.fluorescence is None else m.fluorescence}
        known |= {key: told[key] for key in ESTIMATE}
        found = {key: known[key] for key in COLUMNS} | ({TRUE: self._truth()} if self._truth else {})
        why = {key: value for key, value in told.items() if key not in ESTIMATE}
        safety = interlock.config
        inside = (target > safety.composition_low + EDGE_C) & (target < safety.composition_high - EDGE_C)
        goal = np.where(wanted.minutes > 0.0, wanted.following, wanted.setpoint)
        return Composed(target, found, why, self._warned(found, goal, inside, minute, believed))

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

    def dosed(self, volume_ml: Array) -> None:
        """What went in, mL, (N,)."""
        self.controller.dosed(volume_ml)
