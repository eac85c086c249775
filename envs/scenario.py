"""Schedule of a culture: phases, each with a setpoint and a temperature, maybe with a condition and other fluids."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LARGEST_OD = 2.0  # of a condition
COMPARED = re.compile(r"od\s*(>=|<=)\s*(\d*\.?\d+)")
ENDS = "'od >= 0.8', 'od <= 0.3', settled, or null: its minutes"

PUMPS = (3, 4)  # spare ones: a second medium, an inducer or a stressor
DOSE_ML = 0.5  # smallest dose: above what a pump of up to 1.5 mL/s delivers dependably (docs/device.md, Pumps)
MADE_UP_MIN = 5.0  # of a pause of the program or of the samples; the volume due in a longer one is omitted
MOST_ML_H, MOST_ML = 20.0, 20.0
GIVEN = re.compile(r"pump([34])\s+(\d*\.?\d+)\s*(mL/h|mL)", re.IGNORECASE)
FLUIDS = "'pump3 2 mL/h', 'pump4 1.5 mL' (at its start), both with a comma between, or null"


def bounds(text: str | None) -> tuple[float, float]:
    """Return the OD from which, and the OD down to which a condition ends a phase; inf and -inf for none.

    Args: text: "od >= LEVEL", "od <= LEVEL", "settled"; None: only its time. Raises: ValueError for any other text.
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
    """The conditions of N reactors' steps, (N, P); rows shorter than P are padded with None.

    Attributes: given, (N, P), whether there is a condition; any, whether there is one at all; texts, as written.
    """

    def __init__(self, texts: list[list[str | None]]) -> None:
        self.texts = texts
        self._least, self._most = np.moveaxis(np.array([[bounds(text) for text in row] for row in texts]), -1, 0)
        self._settled = np.array([[text == "settled" for text in row] for row in texts])
        self.given = np.array([[text is not None for text in row] for row in texts])
        self.any = bool(self.given.any())

    def met(self, phase: NDArray[np.intp], od: Array, settled: Mask) -> Mask:
        """Return whether each reactor's step ends, (N,): OD at its level, or settled if required.

        Args: phase: of each reactor, >= 0. od: nan meets no condition. settled: determined by the caller.
        """
        row = np.arange(phase.size)
        reached = (od >= self._least[row, phase]) | (od <= self._most[row, phase])
        return np.asarray(reached | (settled & self._settled[row, phase]))


@dataclass(frozen=True)
class Output:
    """Output of one spare pump in a step: a volume per hour, or a volume at its start."""

    pump: int
    ml_h: float = 0.0
    ml: float = 0.0


def outputs_of(text: str | None) -> tuple[Output, ...]:
    """Parse the outputs of a step, one per pump. Raises: ValueError for any other text, with the allowed forms."""
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
    require(len(set(pumps)) == len(pumps), "scenario.outputs", repr(text), "each pump once in a step")
    return tuple(found)


class Phased:
    """What has phases of a length in min."""

    minutes: Sequence[float]

    @property
    def total_min(self) -> float:
        """Length of all phases, min."""
        return float(sum(self.minutes))

    @property
    def edges(self) -> Array:
        """Start of each phase and the end of the last, min, shape (phases + 1,)."""
        return np.concatenate([[0.0], np.cumsum(self.minutes)])


HEATED: list[Callable[["Scenario"], bool]] = []
"""Whether another controller decides on the temperature of a phase that gives none; a guest adds its own."""


@dataclass(frozen=True)
class Scenario(Phased):
    """Consecutive phases, counted from the end of the recovery.

    If `until` gives a phase a condition, its minutes are a limit, and `edges` assumes that no
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
    announce_min: float | str | None = setting(
        None,
        "time by which controllers know a change of setpoint in advance; 0: never; auto: as long as half of the change "
        "takes by the estimate; null: 0, or what a further setpoint brings",
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
        for name in ("until", "outputs"):
            texts = tuple(None if each is None or each != each else str(each) for each in getattr(self, name))
            object.__setattr__(self, name, texts)
        check(self, "scenario")
        diluted = self.recovery == "grow" or self.recovery_od > 0.0
        require(diluted, "scenario.recovery_od", self.recovery_od, "> 0 with scenario.recovery=dilute")
        given = None not in self.temperatures or any(heated(self) for heated in HEATED)
        require(given, "scenario.temperatures", self.temperatures, "numbers where nobody else decides on them")
        for name, read in (("until", bounds), ("outputs", outputs_of)):
            self.one_each(name)
            for text in getattr(self, name):
                read(text)

    def one_each(self, name: str) -> None:
        """Check that a list is empty or has an entry for each phase. Raises: ValueError."""
        given, phases = getattr(self, name), len(self.setpoints)
        allowed = f"none or one for each of the {phases} phases"
        require(len(given) in (0, phases), f"scenario.{name}", given, allowed)

    @property
    def announced_min(self) -> float:
        """Time by which a change is announced, min; 0: never, inf: from the start of its step on."""
        return math.inf if self.announce_min == "auto" else float(self.announce_min or 0.0)

    @property
    def supplied(self) -> frozenset[int]:
        """Spare pumps of all phases."""
        return frozenset(output.pump for text in self.outputs for output in outputs_of(text))
