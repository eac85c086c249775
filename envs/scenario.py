"""What a culture is asked to do over time: a sequence of phases with a setpoint and a temperature each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Scenario"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """Phases one after another, counted from the end of the recovery.

    setpoints: OD of each phase. minutes: its length. temperatures: degC.
    recovery_od: before the first phase the culture grows undiluted until its OD first reaches this; 0 skips it.
    recovery_limit_min: how long that may take.
    Raises: ValueError naming key, value and allowed range.
    """

    setpoints: tuple[float, ...] = (0.5,)
    minutes: tuple[float, ...] = (60.0,)
    temperatures: tuple[float, ...] = (37.0,)
    recovery_od: float = 0.0
    recovery_limit_min: float = 600.0

    def __post_init__(self) -> None:
        """Check every range once, where the value enters."""
        lengths = {len(self.setpoints), len(self.minutes), len(self.temperatures)}
        checks = (
            (
                "setpoints, minutes, temperatures",
                (self.setpoints, self.minutes, self.temperatures),
                len(lengths) == 1 and lengths != {0},
                "three lists of the same length, one entry per phase",
            ),
            ("setpoints", self.setpoints, all(0.0 < s <= 1.5 for s in self.setpoints), "each 0 < OD <= 1.5"),
            ("minutes", self.minutes, all(0.0 < m <= 100_000.0 for m in self.minutes), "each > 0 min"),
            ("temperatures", self.temperatures, all(15.0 <= t <= 42.0 for t in self.temperatures), "15 to 42 degC"),
            ("recovery_od", self.recovery_od, 0.0 <= self.recovery_od <= 1.5, "0 (none) to 1.5 OD"),
            ("recovery_limit_min", self.recovery_limit_min, self.recovery_limit_min > 0.0, "> 0 min"),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"scenario.{key} = {value}: allowed {allowed}")

    @property
    def total_min(self) -> float:
        """Length of all phases, min."""
        return float(sum(self.minutes))

    @property
    def edges(self) -> Array:
        """Start of each phase and the end of the last, min, shape (phases + 1,)."""
        return np.concatenate([[0.0], np.cumsum(self.minutes)])

    def phase(self, minute: Array) -> NDArray[np.intp]:
        """Index of the phase at each minute; -1 before the start (and for nan), the last after the end."""
        index = np.searchsorted(self.edges[1:], np.nan_to_num(minute, nan=-1.0) + 1e-9, side="right")
        started = np.nan_to_num(minute, nan=-1.0) >= 0.0
        return np.where(started, np.minimum(index, len(self.setpoints) - 1), -1).astype(np.intp)

    def at(self, minute: Array) -> tuple[Array, Array]:
        """Setpoint and temperature at each minute since the recovery ended, each the shape of `minute`.

        Before the start (minute < 0 or nan) they are those of the first phase.
        """
        phase = np.maximum(self.phase(minute), 0)
        return np.asarray(self.setpoints)[phase], np.asarray(self.temperatures)[phase]
