"""Position of each reactor in its schedule. A step may end early, as soon as its condition is met."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from envs.scenario import Conditions, Scenario
from experiments.laws.base import Array, Mask

CONDITION, TIME = "condition", "time"  # reason why a step ended
Phases = NDArray[np.intp]


def _padded(rows: Sequence[Sequence[float]], by: float | None = None) -> Array:
    """Return rows of unequal length as an array; fill short rows with `by`, or with their last value."""
    longest = max(map(len, rows))
    return np.array([[*row, *[row[-1] if by is None else by] * (longest - len(row))] for row in rows], dtype=np.float64)


class Progress:
    """Schedules of N reactors with the current times of their steps.

    A step with a condition ends at the sample that meets the condition, which is also the first sample of the next
    step; all later steps of that reactor then begin earlier. The condition is checked at each valid sample except the
    step's first, so a step lasts at least one control period. `settled` means that |OD - setpoint| is within
    `settled_band` times the setpoint at every valid sample for `settled_min` minutes of the step.

    Attributes: edges: start of each step and end of the last, min since the schedule began, (N, P + 1), filled up with
    inf. conditional: whether any step has a condition. remembers: names of saved attributes.
    """

    def __init__(self, schedules: Sequence[Scenario]) -> None:
        self._counts = np.array([len(s.setpoints) for s in schedules])
        self._minutes = _padded([s.minutes for s in schedules])
        self._setpoints = _padded([s.setpoints for s in schedules])
        self._temperatures = _padded([[math.nan if t is None else t for t in s.temperatures] for s in schedules])
        width = int(self._counts.max())
        self.conditions = Conditions([[*s.until, *[None] * (width - len(s.until))] for s in schedules])
        self.conditional = self.conditions.any
        self._dilutes = np.array([s.recovery == "dilute" for s in schedules])
        watched = ("edges", "within_since", "judged_at") if self.conditional else ()
        self.remembers = (*watched, *(["grown"] if self._dilutes.any() else []))
        self._recovery_od = np.array([s.recovery_od for s in schedules])
        self._recovery_limit_min = np.array([s.recovery_limit_min for s in schedules])
        self._announced_min = np.array([s.announced_min for s in schedules])
        self._band = np.array([s.settled_band for s in schedules])
        self._settled_min = np.array([s.settled_min for s in schedules])
        self.edges = _padded([s.edges.tolist() for s in schedules], np.inf)
        self._within_since = np.full(len(schedules), np.nan)  # min; since then all readings are inside the band
        self._judged_at = np.full(len(schedules), np.nan)  # min; newest sample at which a condition was checked
        self._grown = np.zeros(len(schedules), dtype=np.bool_)  # grown beyond the OD to which the recovery dilutes

    @property
    def totals(self) -> Array:
        """Currently expected end of each reactor's schedule, min, (N,)."""
        return np.asarray(self.edges[np.arange(self._counts.size), self._counts])

    def phase(self, elapsed: Array) -> Phases:
        """Return the index of each reactor's step, (N,): -1 before the start and for nan, the last after the end."""
        minute = np.nan_to_num(elapsed, nan=-1.0)
        index = (minute[:, None] + 1e-9 >= self.edges[:, 1:]).sum(axis=1)
        return np.where(minute >= 0.0, np.minimum(index, self._counts - 1), -1).astype(np.intp)

    def asked(self, elapsed: Array) -> tuple[Phases, Array, Array]:
        """Return each reactor's step (-1 before the start), setpoint and temperature (then of the first step), (N,)."""
        phase = self.phase(elapsed)
        at = np.arange(phase.size), np.maximum(phase, 0)
        return phase, self._setpoints[at], self._temperatures[at]

    @property
    def announced(self) -> bool:
        """Whether any change of a setpoint is announced to the controller."""
        changes = (np.diff(self._setpoints, axis=1) != 0.0).any(axis=1)
        return bool((changes & (self._announced_min > 0.0)).any())

    def following(self, elapsed: Array) -> tuple[Array, Array]:
        """Return the next setpoint and the minutes until it, (N,) each; inf if it is not announced.

        The end of a step with a condition is never announced, because it is unknown.
        """
        phase, setpoint, _ = self.asked(elapsed)
        rows, step = np.arange(phase.size), np.maximum(phase, 0)
        following = np.minimum(step + 1, self._counts - 1)
        left = self.edges[rows, step + 1] - elapsed
        known = (phase >= 0) & (following > step) & (left <= self._announced_min) & ~self.conditions.given[rows, step]
        return np.where(known, self._setpoints[rows, following], setpoint), np.where(known, left, np.inf)

    def recover(self, minute: Array, od: Array, believed: Mask) -> tuple[Mask, Mask]:
        """Process a sample in recovery; return where the recovery ends, and where to dilute at full rate, (N,) each.

        Args: minute: of the run. believed: rows whose OD is new and valid.
        """
        beyond = od >= self._recovery_od * (1.0 + self._band)
        self._grown = self._grown | (believed & beyond & self._dilutes)
        there = np.where(self._dilutes, self._grown & (od <= self._recovery_od), od >= self._recovery_od)
        over = (believed & there) | (minute >= self._recovery_limit_min)
        return over, believed & self._grown & ~over

    def watch(self, elapsed: Array, od: Array, believed: Mask) -> Mask:
        """Process a sample; return where it ends a step, (N,). Args: believed: rows whose OD is new and valid."""
        if not self.conditional:
            return np.zeros(elapsed.size, dtype=np.bool_)
        phase, setpoint, _ = self.asked(elapsed)
        rows, step = np.arange(phase.size), np.maximum(phase, 0)
        begun = self.edges[rows, step]
        judged = believed & (phase >= 0) & (elapsed < self.totals - 1e-6)
        within = judged & self._near(od, setpoint)
        anew = ~(self._within_since >= begun - 1e-9)  # true for nan, and for a time in an earlier step
        since = np.where(anew, elapsed, self._within_since)
        self._within_since = np.where(judged, np.where(within, since, np.nan), self._within_since)
        settled = within & (elapsed - since >= self._settled_min - 1e-6)
        ends = judged & (self._judged_at >= begun - 1e-6) & self.conditions.met(step, od, settled)
        self._judged_at = np.where(judged, elapsed, self._judged_at)
        shift = np.where(ends, elapsed - self.edges[rows, step + 1], 0.0)
        later = np.arange(self.edges.shape[1]) > step[:, None]
        self.edges = np.where(later, self.edges + shift[:, None], self.edges)
        first = np.where(self._near(od, self.asked(elapsed)[1]), elapsed, np.nan)  # also the next step's first sample
        self._within_since = np.where(ends, first, self._within_since)
        return ends

    def _near(self, od: Array, setpoint: Array) -> Mask:
        return np.asarray(np.abs(od - setpoint) <= self._band * setpoint)

    def steps(self, n: int) -> list[tuple[float, float, str]]:
        """List reactor n's steps: start, end, and why it ended; future steps are listed with their longest time."""
        edges = self.edges[n, : self._counts[n] + 1]
        early = np.diff(edges) < self._minutes[n, : self._counts[n]] - 1e-6
        why = [CONDITION if e else TIME for e in early]
        return list(zip(edges[:-1].tolist(), edges[1:].tolist(), why, strict=True))

    def resumed(self) -> None:
        """Check the edges after they were restored. Raises: ValueError if they are impossible."""
        for edges in (self.edges[n, : self._counts[n] + 1] for n in range(self._counts.size)):
            if edges[0] != 0.0 or not (np.diff(edges) > 0.0).all():
                raise ValueError(f"steps: edges {str(edges.tolist())[:60]}, expected {edges.size} rising from 0")
