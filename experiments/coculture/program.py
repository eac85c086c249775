"""Setpoints of the share over time, and their announcement to the controller."""

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from conf.schema import require, setting
from envs.scenario import Phased, Scenario
from experiments.coculture.base import Array, Wanted

ANNOUNCED_MIN = 360.0  # default time by which a change of the share's setpoint is announced before it happens

SINE_LEAD_MIN, SINE_STEP = 300.0, 0.4
"""For a sine, the controller always receives the share SINE_LEAD_MIN ahead as a change that happens in SINE_STEP
times SINE_LEAD_MIN minutes."""


class Ratios:
    """Settings of a scenario for the share of the second species: one setpoint per phase, or a sine.

    While the share has a setpoint, the composition controller decides the temperature; otherwise the schedule does.
    """

    ratios: tuple[float | None, ...] = setting(
        (),
        "setpoint of the second species' share in each phase, null: none; empty: none in any phase",
        above=0.0,
        below=1.0,
    )
    ratio_sine: tuple[float, ...] = setting(
        (), "setpoint of this share as a sine that first falls: mean, amplitude, period in min; empty: none"
    )

    def __post_init__(self) -> None:
        scenario = cast(Scenario, self)
        object.__setattr__(self, "ratios", tuple(None if r is None or r != r else r for r in self.ratios))
        if composed(scenario):
            why = "[] with setpoints of a share, because composition controllers need fixed times"
            require(not any(scenario.until), "scenario.until", scenario.until, why)
            if scenario.announce_min in (None, "auto"):
                object.__setattr__(self, "announce_min", ANNOUNCED_MIN)
        scenario.one_each("ratios")
        if self.ratio_sine:
            require(not self.ratios, "scenario.ratios", self.ratios, "[] with ratio_sine")
            given = tuple(self.ratio_sine)
            words = "mean, amplitude and period in min > 0, with |amplitude| < mean and |amplitude| < 1 - mean"
            require(len(given) == 3 and given[2] > 0.0, "scenario.ratio_sine", given, words)
            mean, amplitude, _ = given
            require(abs(amplitude) < mean and mean + abs(amplitude) < 1.0, "scenario.ratio_sine", given, words)


def ratios_of(scenario: Scenario) -> Ratios:
    return cast(Ratios, scenario)


def composed(scenario: Scenario) -> bool:
    """Return whether a scenario has a setpoint of the share at any time."""
    asked = ratios_of(scenario)
    return bool(asked.ratio_sine) or any(r is not None for r in asked.ratios)


def resting(scenario: Scenario, even_c: float) -> Scenario:
    """Return a scenario with a temperature in every phase, by default `even_c`, degC, where both species grow alike."""
    return replace(scenario, temperatures=tuple(even_c if t is None else t for t in scenario.temperatures))


def program_of(scenario: Scenario) -> "Program":
    asked = ratios_of(scenario)
    if asked.ratio_sine:
        mean, amplitude, period = asked.ratio_sine
        return Program((), scenario.minutes, (mean, amplitude, period))
    ratios = asked.ratios or (None,) * len(scenario.minutes)
    return Program(tuple(math.nan if r is None else r for r in ratios), scenario.minutes)


@dataclass(frozen=True)
class Program(Phased):
    """Setpoints of the share of the second species over time: one per phase, or a sine.

    ratios: setpoint of each phase, nan for none. minutes: length of each phase. sine: mean, amplitude and period (min)
    of s(t) = mean - amplitude sin(2 pi t / period), with t in min since the program began.
    """

    ratios: tuple[float, ...] = ()
    minutes: tuple[float, ...] = (60.0,)
    sine: tuple[float, float, float] | None = None

    def _phase(self, minute: Array) -> NDArray[np.intp]:
        return np.minimum(np.searchsorted(self.edges[1:], minute + 1e-9, side="right"), len(self.minutes) - 1)

    def setpoint(self, minute: Array) -> Array:
        """Return the setpoint at each minute: nan without one and before the start; after the end the last one."""
        at = np.nan_to_num(np.asarray(minute, dtype=np.float64), nan=-1.0)
        if self.sine is None:
            wanted = np.asarray(self.ratios)[self._phase(np.maximum(at, 0.0))]
        else:
            mean, amplitude, period = self.sine
            wanted = mean - amplitude * np.sin(2.0 * np.pi * np.clip(at, 0.0, self.total_min) / period)
        return np.where(at < 0.0, np.nan, wanted)

    def wanted(self, minute: Array, preview_min: float = 0.0) -> Wanted:
        """Return the setpoints that a controller receives at each minute since the program began, (N,).

        Args: preview_min: how long before a change from one share to another it is announced; 0: never. For a sine, the
          share 300 min ahead is announced as a change in 120 min; a `preview_min` below 300 shortens both times.
        """
        now = self.setpoint(minute)
        at = np.nan_to_num(np.asarray(minute, dtype=np.float64), nan=-1.0)
        if self.sine is None:
            phase, (change, following) = self._phase(np.maximum(at, 0.0)), self._changes()
            ahead, left = following[phase], change[phase] - at
            known = left <= preview_min + 1e-9
        else:
            lead = min(SINE_LEAD_MIN, preview_min)
            ahead, left = self.setpoint(at + lead), np.full(at.shape, SINE_STEP * lead)
            known = np.isfinite(ahead) & (at + lead <= self.total_min)
        known &= np.isfinite(now) & (preview_min > 0.0)
        return Wanted(now, np.where(known, ahead, now), np.where(known, left, 0.0))

    @property
    def extremes(self) -> tuple[float, ...]:
        """All setpoints of the phases, or the smallest and largest setpoint of the sine."""
        if self.sine is not None:
            mean, amplitude, _ = self.sine
            return mean - abs(amplitude), mean + abs(amplitude)
        return tuple(r for r in self.ratios if not math.isnan(r))

    def announcements(self, preview_min: float) -> tuple[Array, Array]:
        """Return the minutes at which changes are announced, and the new setpoints; both empty for a sine."""
        if self.sine is not None or preview_min <= 0.0:
            return np.empty(0), np.empty(0)
        when, which = self._changes()
        known = np.isfinite(self.ratios) & np.isfinite(when)
        first = known & np.append(True, when[1:] != when[:-1])  # of phases that follow each other with one share
        return np.maximum(when - preview_min, self.edges[:-1])[first], which[first]

    def _changes(self) -> tuple[Array, Array]:
        """Return for each phase the minute of the next change to another setpoint (inf: never), and that setpoint."""
        when, which = np.full(len(self.minutes), np.inf), np.array(self.ratios, dtype=np.float64)
        for k in range(len(which) - 2, -1, -1):
            now, after = self.ratios[k], self.ratios[k + 1]
            if after == now:
                when[k], which[k] = when[k + 1], which[k + 1]
            elif not math.isnan(after):
                when[k], which[k] = self.edges[k + 1], after
        return when, which
