"""Schedule of a culture: phases, each with a setpoint, a temperature and possibly a composition."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.outputs import outputs_of
from envs.until import Condition

__all__ = ["Scenario"]

Array = NDArray[np.float64]

ANNOUNCED_MIN = 360.0  # default announcement of a change of the composition


@dataclass(frozen=True)
class Scenario:
    """Consecutive phases, counted from the end of the recovery.

    If `until` gives a phase a condition, its minutes are a limit, and `edges`, `phase` and `at` assume that no
    condition is met (`experiments/loop/progress.py` has the actual times). The setpoint of the share of B may be given
    per phase, or as mean - amplitude sin(2 pi t / period), t since the end of the recovery. With such a setpoint the
    composition controller sets the temperature, otherwise `temperatures` applies. Raises: ValueError with key, value
    and allowed range.
    """

    setpoints: tuple[float, ...] = setting((0.5,), "setpoint of each phase", "OD", above=0.0, at_most=1.5)
    minutes: tuple[float, ...] = setting((60.0,), "length of each phase", "min", above=0.0, at_most=100_000.0)
    temperatures: tuple[float | None, ...] = setting(
        (37.0,), "thermostat in each phase; null, two species: where both grow alike", "degC", within=(15, 42)
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
    ratios: tuple[float | None, ...] = setting(
        (),
        "setpoint of the share of B in each phase, null for none; empty: in no phase",
        above=0.0,
        below=1.0,
    )
    ratio_sine: tuple[float, ...] = setting(
        (), "setpoint of the share of B as a sine, falling first: mean, amplitude, period in min; empty: none"
    )
    announce_min: float | None = setting(
        None,
        "time by which controllers know a change of setpoint in advance; 0: never; null: 360 with a composition, else "
        "0",
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
        object.__setattr__(self, "ratios", tuple(None if r is None or r != r else r for r in self.ratios))
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
        alone = self.composed or None not in self.temperatures
        require(alone, "scenario.temperatures", self.temperatures, "numbers where no share is asked for")
        for name in ("until", "outputs", "ratios"):
            given, phases = getattr(self, name), len(self.setpoints)
            allowed = f"none or one for each of the {phases} phases"
            require(len(given) in (0, phases), f"scenario.{name}", given, allowed)
        self._check_until()
        for text in self.outputs:
            outputs_of(text)
        self._check_composition()

    def _check_until(self) -> None:
        for text in self.until:
            try:
                Condition(text)
            except ValueError as error:
                raise ValueError(f"scenario.until: {error}") from None
        if any(self.until):
            why = "[] where a share is asked for, whose controller plans by the minutes"
            require(not self.composed, "scenario.until", self.until, why)

    def _check_composition(self) -> None:
        if not self.ratio_sine:
            return
        require(not self.ratios, "scenario.ratios", self.ratios, "[] beside ratio_sine")
        given = tuple(self.ratio_sine)
        words = "mean, amplitude and period in min > 0, with |amplitude| < mean and |amplitude| < 1 - mean"
        require(len(given) == 3 and given[2] > 0.0, "scenario.ratio_sine", given, words)
        mean, amplitude, _ = given
        require(abs(amplitude) < mean and mean + abs(amplitude) < 1.0, "scenario.ratio_sine", given, words)

    @property
    def composed(self) -> bool:
        """Whether the schedule has a composition."""
        return bool(self.ratio_sine) or any(r is not None for r in self.ratios)

    @property
    def announced_min(self) -> float:
        """Time by which a change is announced, min; 0: never."""
        usual = ANNOUNCED_MIN if self.composed else 0.0
        return usual if self.announce_min is None else self.announce_min

    def resting(self, even_c: float) -> "Scenario":
        """Return the schedule with a temperature in every phase; the default is that of equal growth, degC."""
        return replace(self, temperatures=tuple(even_c if t is None else t for t in self.temperatures))

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
