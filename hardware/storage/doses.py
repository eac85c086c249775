"""Doses in the journal, in the rows of every family: volume and repetitions of each.

Kinds of rows: `intent` before a commanded dose, `feed_on` before the command to its pump, `dose_end` after the dose,
`given` for a dose without a command. Each row has the run time, s, the volumes (largest: feed_ml and waste_ml;
smallest: feed_low_ml), and the pump if it is not the feed pump.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

from hardware.errors import RecordingError
from hardware.storage.messages import RowDamaged

REPEAT_S = 63.0
"""Seconds between two repetitions of a dose: the pump period of a Chi.Bio. A row has the number of repetitions."""
FEEDS = {"Pump1": 1, "Pump3": 3, "Pump4": 4}  # pumps that an intent may name, and their numbers


@dataclass(frozen=True)
class Given:
    """Volumes given beyond those booked, mL, negative where less was given; at_s: run time, s.

    low_ml: smallest feed that may have been given. pump: number of the spare pump that gave it, 0 for the feed pump.
    """

    at_s: float
    feed_ml: float
    low_ml: float
    waste_ml: float
    pump: int = 0

    def row(self, why: str) -> dict[str, Any]:
        volumes = {"feed_ml": self.feed_ml, "feed_low_ml": self.low_ml, "waste_ml": self.waste_ml}
        return {"at_s": self.at_s, "why": why, **volumes, **({"pump": self.pump} if self.pump else {})}


@dataclass(frozen=True)
class Ending:
    """Outcome of a dose. Volumes are the largest possible ones, mL, unless stated otherwise.

    on_s: run time at which its pumps were switched on, s. feed_ml, waste_ml: volumes of the dose itself. feed_times,
    waste_times: number of repetitions by the device, every 63 s after `on_s`. feed_last_ml, waste_last_ml: volume of
    the last repetition; nan: as the dose. pump: number of the spare pump that fed, 0 for the feed pump. feed_low_ml:
    smallest feed of the dose with its repetitions; nan: equal to the largest.
    """

    on_s: float
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    feed_times: int = 0
    waste_times: int = 0
    pump: int = 0
    feed_last_ml: float = math.nan
    waste_last_ml: float = math.nan
    feed_low_ml: float = math.nan

    @property
    def repeated_ml(self) -> float:
        """Fresh medium beyond the dose itself, mL."""
        return sum(feed_ml for _, feed_ml, _ in self.repeats())

    @property
    def least(self) -> float:
        """Smallest feed as a fraction of the largest, 0 to 1."""
        most_ml = self.feed_ml + self.repeated_ml
        return 1.0 if math.isnan(self.feed_low_ml) or most_ml <= 0.0 else min(self.feed_low_ml / most_ml, 1.0)

    def repeats(self) -> list[tuple[float, float, float]]:
        """List the repetitions: run time, s, and volumes of feed and waste, mL."""

        def nth(k: int, times: int, ml: float, last_ml: float) -> float:
            return (last_ml if k == times and not math.isnan(last_ml) else ml) if k <= times else 0.0

        return [
            (
                self.on_s + REPEAT_S * k,
                nth(k, self.feed_times, self.feed_ml, self.feed_last_ml),
                nth(k, self.waste_times, self.waste_ml, self.waste_last_ml),
            )
            for k in range(1, max(self.feed_times, self.waste_times) + 1)
        ]

    def beyond(self, booked_ml: float) -> list[Given]:
        """Return the volumes, feed and waste, beyond the feed that was booked when the dose began, in order of time."""
        low_ml, more_ml = self.least * self.feed_ml - booked_ml, self.feed_ml - booked_ml
        first = [Given(self.on_s, more_ml, low_ml, more_ml, self.pump)] if max(abs(more_ml), abs(low_ml)) > 1e-3 else []
        again = [Given(at_s, ml, self.least * ml, waste_ml, self.pump) for at_s, ml, waste_ml in self.repeats()]
        return first + again

    def row(self) -> dict[str, Any]:
        known = {key: value for key, value in asdict(self).items() if value == value and (key != "pump" or value)}
        return {"verified_off": True, "repeated_ml": self.repeated_ml, **known}

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """Invert `row`. Raises: KeyError, TypeError, ValueError for a damaged row."""
        on_s, feed_ml, waste_ml = (float(row[key]) for key in ("on_s", "feed_ml", "waste_ml"))
        last = (float(row.get(key, math.nan)) for key in ("feed_last_ml", "waste_last_ml", "feed_low_ml"))
        times = int(row["feed_times"]), int(row["waste_times"])
        return cls(on_s, feed_ml, waste_ml, *times, int(row.get("pump", 0)), *last)


@dataclass(frozen=True)
class Dosed:
    """One dose, or one repetition of a dose (again).

    n: number of its row in the journal: the intent of a dose, the end of the dose for a repetition. at_s: run time, s.
    feed_ml, waste_ml: volumes, mL. pump: number of the pump that fed.
    """

    n: int
    reactor: str
    at_s: float
    feed_ml: float
    waste_ml: float
    again: bool = False
    pump: int = 1


def feeds_by(row: Mapping[str, Any]) -> str:
    """Return the pump that feeds in the dose of an intent. Raises: ValueError for an unknown pump."""
    pump = str(row.get("feed_pump", "Pump1"))
    if pump not in FEEDS:
        raise ValueError(f"feed_pump {pump}")
    return pump


def dosed(rows: Sequence[Mapping[str, Any]]) -> list[Dosed]:
    """List every dose of a journal with the volumes it really gave, and its repetitions, in order of time.

    A dose whose feed pump was never switched on gave nothing. A dose without a recorded end counts in full; the
    `dose_end` of a resumed run has its repetitions. Raises: RecordingError for a damaged row.
    """
    given: dict[int, Dosed] = {}  # by the row of the intent
    begun: dict[str, Dosed] = {}  # by reactor, the dose that has not ended
    repeated: list[Dosed] = []
    for row in rows:
        if (kind := row.get("kind")) not in ("intent", "feed_on", "dose_end", "given"):
            continue
        try:
            name = str(row["reactor"])
            if kind == "intent":
                begun[name] = Dosed(row["n"], name, *_moved(row, "on_s"), pump=FEEDS[feeds_by(row)])
            elif kind == "feed_on" and name in begun:
                given[begun[name].n] = begun[name]
            elif kind == "given":  # without a dose of this run
                repeated.append(Dosed(row["n"], name, *_moved(row, "at_s"), again=True, pump=int(row.get("pump", 1))))
            elif kind == "dose_end" and "feed_times" in row:
                ending, pump = Ending.of_row(row), 1
                if (ended := begun.pop(name, None)) is not None:
                    pump = ended.pump
                    given[ended.n] = replace(ended, at_s=ending.on_s, feed_ml=ending.feed_ml, waste_ml=ending.waste_ml)
                repeated += [Dosed(row["n"], name, *one, again=True, pump=pump) for one in ending.repeats()]
        except (KeyError, TypeError, ValueError) as error:
            raise damaged(row, error) from None
    return sorted([*given.values(), *repeated], key=lambda d: d.at_s)


def _moved(row: Mapping[str, Any], when: str) -> tuple[float, float, float]:
    return float(row[when]), float(row["feed_ml"]), float(row["waste_ml"])


def damaged(row: Mapping[str, Any], error: Exception) -> RecordingError:
    """Build the error for a damaged row."""
    what = f"row {row.get('n')} ({row['kind']}) is damaged ({type(error).__name__}: {error})"
    return RowDamaged(path="journal.jsonl", what=what)
