"""Schedule of a culture: phases with setpoint and temperature, and optionally an end condition and spare pumps."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LARGEST_OD = 2.0  # largest level of a condition
COMPARED = re.compile(r"od\s*(>=|<=)\s*(\d*\.?\d+)")
ENDS = "'od >= 0.8', 'od <= 0.3', settled, or null"

PUMPS = (3, 4)  # spare pumps: for a second medium, an inducer or a stressor
DOSE_ML = 0.5  # smallest dose; pumps of up to 1.5 mL/s deliver this volume reliably (docs/device.md, Pumps)
MADE_UP_MIN = 5.0  # longest pause of the program or the samples whose volume is delivered later; else it is omitted
MOST_ML_H, MOST_ML = 20.0, 20.0
GIVEN = re.compile(r"pump([34])\s+(\d*\.?\d+)\s*(mL/h|mL)", re.IGNORECASE)
FLUIDS = "'pump3 2 mL/h', 'pump4 1.5 mL' (at the start), both separated by a comma, or null"


def bounds(text: str | None) -> tuple[float, float]:
    """Return (high, low): the condition ends a phase when OD >= high or OD <= low; inf or -inf where it has no level.

    Args: text: "od >= LEVEL", "od <= LEVEL", "settled" or None (no condition). Raises: ValueError for any other text.
    """
    if text is None or text == "settled":
        return np.inf, -np.inf
    found = COMPARED.fullmatch(text)
    require(found is not None, "scenario.until", repr(text), ENDS)
    assert found is not None
    level = float(found[2])
    require(0.0 < level <= LARGEST_OD, "scenario.until", repr(text), f"a level with 0 < OD <= {LARGEST_OD:g}")
    return (level, -np.inf) if found[1] == ">=" else (np.inf, level)


class Conditions:
    """End conditions of the steps of N reactors, (N, P). Args: texts: as written; rows shorter than P end with None.

    Attributes: texts: see above. given: whether a step has a condition, (N, P). any: whether any step has a condition.
    """

    def __init__(self, texts: list[list[str | None]]) -> None:
        self.texts = texts
        self._least, self._most = np.moveaxis(np.array([[bounds(text) for text in row] for row in texts]), -1, 0)
        self._settled = np.array([[text == "settled" for text in row] for row in texts])
        self.given = np.array([[text is not None for text in row] for row in texts])
        self.any = bool(self.given.any())

    def met(self, phase: NDArray[np.intp], od: Array, settled: Mask) -> Mask:
        """Return whether the condition of each reactor's step is met, (N,).

        Args: phase: step of each reactor, >= 0. od: OD; nan meets no condition. settled: whether the OD is settled.
        """
        row = np.arange(phase.size)
        reached = (od >= self._least[row, phase]) | (od <= self._most[row, phase])
        return np.asarray(reached | (settled & self._settled[row, phase]))


@dataclass(frozen=True)
class Output:
    """Output of one spare pump in a step: `ml_h`, mL per hour, or `ml`, mL at the start of the step."""

    pump: int
    ml_h: float = 0.0
    ml: float = 0.0


def outputs_of(text: str | None) -> tuple[Output, ...]:
    """Parse the outputs of a step, at most one per pump. Raises: ValueError with the allowed forms."""
    found = []
    for part in text.split(",") if text else []:
        said = GIVEN.fullmatch(part.strip())
        require(said is not None, "scenario.outputs", repr(text), FLUIDS)
        assert said is not None
        amount, hourly = float(said[2]), said[3].lower() == "ml/h"
        low, high = (0.1, MOST_ML_H) if hourly else (DOSE_ML, MOST_ML)
        require(low <= amount <= high, "scenario.outputs", repr(text), f"{low:g} to {high:g} {said[3]}")
        found.append(Output(int(said[1]), amount if hourly else 0.0, 0.0 if hourly else amount))
    pumps = [output.pump for output in found]
    require(len(set(pumps)) == len(pumps), "scenario.outputs", repr(text), "each pump at most once in a step")
    return tuple(found)


class Phased:
    """Base class of a schedule of phases. minutes: length of each phase, min."""

    minutes: Sequence[float]

    @property
    def total_min(self) -> float:
        """Total length of all phases, min."""
        return float(sum(self.minutes))

    @property
    def edges(self) -> Array:
        """Start of each phase and end of the last phase, min, shape (phases + 1,)."""
        return np.concatenate([[0.0], np.cumsum(self.minutes)])


HEATED: list[Callable[["Scenario"], bool]] = []
"""Functions that return whether another controller sets the temperature of phases without one; guests add theirs."""


@dataclass(frozen=True)
class Scenario(Phased):
    """Consecutive phases; time starts at the end of the recovery.

    If `until` gives a phase a condition, its minutes are its longest duration. `edges` assumes that no condition is
    met; `experiments/loop/progress.py` has the actual times. Raises: ValueError with key, value and allowed range.
    """

    setpoints: tuple[float, ...] = setting((0.5,), "setpoint of each phase", "OD", above=0.0, at_most=1.5)
    minutes: tuple[float, ...] = setting((60.0,), "length of each phase", "min", above=0.0, at_most=100_000.0)
    temperatures: tuple[float | None, ...] = setting(
        (37.0,), "temperature in each phase; null: set by another controller", "degC", within=(15, 42)
    )
    recovery_od: float = setting(
        0.0, "OD to which the culture grows undiluted before the first phase; 0: no recovery", "OD", within=(0, 1.5)
    )
    recovery: str = setting(
        "grow",
        "grow: end at `recovery_od`; dilute: grow beyond it by `settled_band`, then dilute to it at full pump",
        choices=("grow", "dilute"),
    )
    recovery_limit_min: float = setting(600.0, "longest recovery", "min", above=0.0)
    announce_min: float | str | None = setting(
        None,
        "how long in advance controllers know a change of setpoint; 0: never; auto: the estimated time for half of the "
        "change; null: 0, unless a second signal has another default",
        "min",
        within=(0, 1440),
        words=("auto",),
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
        "`settled` needs |OD - setpoint| within this fraction of the setpoint; also for the summary's settling time",
        "",
        within=(0.005, 0.5),
    )
    settled_min: float = setting(10.0, "`settled` needs all readings in the band this long", "min", within=(1, 1440))

    def __post_init__(self) -> None:
        phases, *beside = lengths = [len(each) for each in (self.setpoints, self.minutes, self.temperatures)]
        require(
            phases > 0 and set(beside) == {phases},
            "scenario.setpoints, minutes, temperatures",
            "lists of {}, {} and {}".format(*lengths),
            "one or more setpoints, and equally many minutes and temperatures; decimals have a point: 0.5",
        )
        for name in ("until", "outputs"):
            texts = tuple(None if each is None or each != each else str(each) for each in getattr(self, name))
            object.__setattr__(self, name, texts)
        check(self, "scenario")
        diluted = self.recovery == "grow" or self.recovery_od > 0.0
        require(diluted, "scenario.recovery_od", self.recovery_od, "> 0 with scenario.recovery=dilute")
        given = None not in self.temperatures or any(heated(self) for heated in HEATED)
        require(given, "scenario.temperatures", self.temperatures, "numbers, as no other controller sets temperatures")
        for name, read in (("until", bounds), ("outputs", outputs_of)):
            self.one_each(name)
            for text in getattr(self, name):
                read(text)

    def one_each(self, name: str) -> None:
        """Check that the list `name` is empty or has an entry for each phase. Raises: ValueError."""
        given, phases = getattr(self, name), len(self.setpoints)
        allowed = f"no entry, or one for each of the {phases} phases"
        require(len(given) in (0, phases), f"scenario.{name}", given, allowed)

    @property
    def announced_min(self) -> float:
        """Time between announcement and change, min; 0: no announcement; inf: announced at the start of the step."""
        return math.inf if self.announce_min == "auto" else float(self.announce_min or 0.0)

    @property
    def supplied(self) -> frozenset[int]:
        """Spare pumps that any phase uses."""
        return frozenset(output.pump for text in self.outputs for output in outputs_of(text))
