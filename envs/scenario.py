"""What a culture is asked to do over time: a sequence of phases with a setpoint and a temperature each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting

__all__ = ["Scenario"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """Phases one after another, counted from the end of the recovery.

    Raises: ValueError naming key, value and allowed range.
    """

    setpoints: tuple[float, ...] = setting((0.5,), "one of each phase", "OD", above=0.0, at_most=1.5)
    minutes: tuple[float, ...] = setting((60.0,), "length of each phase", "min", above=0.0, at_most=100_000.0)
    temperatures: tuple[float, ...] = setting((37.0,), "thermostat in each phase", "degC", within=(15, 42))
    recovery_od: float = setting(
        0.0, "before the first phase the culture grows undiluted to here; 0: no recovery", "OD", within=(0, 1.5)
    )
    recovery_limit_min: float = setting(600.0, "how long that may take", "min", above=0.0)

    def __post_init__(self) -> None:
        lists = (self.setpoints, self.minutes, self.temperatures)
        lengths = {len(phases) for phases in lists}
        require(
            len(lengths) == 1 and lengths != {0},
            "scenario.setpoints, minutes, temperatures",
            lists,
            "three lists of the same length, one entry per phase",
        )
        check(self, "scenario")

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
