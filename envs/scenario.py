"""Schedule of a culture: phases, each with a setpoint and a temperature."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.outputs import outputs_of
from envs.until import Condition

__all__ = ["HEATED", "Scenario"]

Array = NDArray[np.float64]

HEATED: list[Callable[["Scenario"], bool]] = []
"""Whether another controller decides on the temperature of a phase that gives none; a guest adds its own."""


@dataclass(frozen=True)
class Scenario:
    """Consecutive phases, counted from the end of the recovery.

    If `until` gives a phase a condition, its minutes are a limit, and `edges`, `phase` and `at` assume that no
    condition is met (`experiments/loop/progress.py` has the actual times). Raises: ValueError with key, value and
    allowed range.
    """

    setpoints: tuple[float, ...] = setting((0.5,), "setpoint of each phase", "OD", above=0.0, at_most=1.5)
    minutes: tuple[float, ...] = setting((60.0,), "length of each phase", "min", above=0.0, at_most=100_000.0)
    temperatures: tuple[float | None, ...] = setting(
        (37.0,), "thermostat in each phase; null: as another controller decides", "degC", within=(15, 42)
    )
    recovery_od: float = setting(
        0.0, "OD to which the culture grows undiluted before the first phase; 0: no recovery", "OD", within=(0, 1.5)
    )
    recovery: str = setting(
        "grow",
        "dilute: grow beyond `recovery_od` by `settled_band`, then dilute to it with full pump",
        choices=("grow", "dilute"),
    )
    recovery_limit_min: float = setting(600.0, "longest recovery", "min", above=0.0)
    announce_min: float | None = setting(
        None,
        "time by which controllers know a change of setpoint in advance; 0: never; null: 0, or what a further setpoint "
        "brings",
        "min",
        within=(0, 1440),
    )
    until: tuple[str | None, ...] = setting(
        (),
        "condition that ends a phase early: 'od >= 0.8', 'od <= 0.3', settled, or null; empty: none",
    )
    outputs: tuple[str | None, ...] = setting(
        (),
        "spare pump in each phase: 'pump3 2 mL/h', 'pump4 1.5 mL' at its start, or null; empty: none",
    )
    settled_band: float = setting(
        0.05,
        "settled: |OD - setpoint| within this fraction of the setpoint, as for the settling time of the summary",
        "",
        within=(0.005, 0.5),
    )
    settled_min: float = setting(10.0, "time without a reading outside that band", "min", within=(1, 1440))

    def __post_init__(self) -> None:
        phases, *beside = lengths = [len(each) for each in (self.setpoints, self.minutes, self.temperatures)]
        require(
            phases > 0 and set(beside) == {phases},
            "scenario.setpoints, minutes, temperatures",
            "lists of {}, {} and {}".format(*lengths),
            "one or more setpoints, and as many minutes and temperatures; decimals have a point: 0.5",
        )
        object.__setattr__(self, "until", tuple(None if u is None or u != u else str(u) for u in self.until))
        object.__setattr__(self, "outputs", tuple(None if o is None or o != o else str(o) for o in self.outputs))
        check(self, "scenario")
        diluted = self.recovery == "grow" or self.recovery_od > 0.0
        require(diluted, "scenario.recovery_od", self.recovery_od, "> 0 with scenario.recovery=dilute")
        given = None not in self.temperatures or any(heated(self) for heated in HEATED)
        require(given, "scenario.temperatures", self.temperatures, "numbers where nobody else decides on them")
        for name in ("until", "outputs"):
            self.one_each(name)
        self._check_until()
        for text in self.outputs:
            outputs_of(text)

    def one_each(self, name: str) -> None:
        """Check that a list is empty or has an entry for each phase. Raises: ValueError."""
        given, phases = getattr(self, name), len(self.setpoints)
        allowed = f"none or one for each of the {phases} phases"
        require(len(given) in (0, phases), f"scenario.{name}", given, allowed)

    def _check_until(self) -> None:
        for text in self.until:
            try:
                Condition(text)
            except ValueError as error:
                raise ValueError(f"scenario.until: {error}") from None

    @property
    def announced_min(self) -> float:
        """Time by which a change is announced, min; 0: never."""
        return 0.0 if self.announce_min is None else self.announce_min

    @property
    def supplied(self) -> frozenset[int]:
        """Spare pumps of all phases."""
        return frozenset(output.pump for text in self.outputs for output in outputs_of(text))

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
        """Return setpoint and temperature at each minute since the recovery ended, each the shape of `minute`.

        Before the start (minute < 0 or nan) they are those of the first phase.
        """
        phase = np.maximum(self.phase(minute), 0)
        return np.asarray(self.setpoints)[phase], np.asarray(self.temperatures)[phase]
