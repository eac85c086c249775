"""Doses in the journal, in the rows of every family: volume and repetitions of each.

`intent` before a dose that was commanded, `feed_on` before its pump is switched on or asked for, `dose_end` after it,
`given` for what was dosed without a command. Each says when (run time, s), how much (feed_ml and waste_ml at most,
feed_low_ml at least), and by which pump where that is not the feed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

from hardware.errors import RecordingError
from hardware.storage.messages import RowDamaged

REPEAT_S = 63.0
"""Seconds between two repetitions of a dose, of which a row has the number: the period of a Chi.Bio."""
FEEDS = {"Pump1": 1, "Pump3": 3, "Pump4": 4}  # pumps that an intent may name, and their numbers


@dataclass(frozen=True)
class Given:
    """What was given beyond what was booked: run time, s; volumes, mL, negative where less was given.

    low_ml: the least that can have been fed. pump: number of the spare pump that gave it, 0 for the feed.
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
    """How a dose ended.

    on_s: run time at which its pumps were switched on, s. feed_ml, waste_ml: what it gave, at most. feed_times,
    waste_times: how often the device gave the same again, every 63 s from `on_s` on, before the pump was off; the last
    time feed_last_ml, waste_last_ml, nan: the same too. pump: number of the spare pump that gave it, 0 for the feed.
    feed_low_ml: the least that it gave with its repetitions, nan: as much as the most.
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
        """Which part of the most it gave at least, 0 to 1."""
        most_ml = self.feed_ml + self.repeated_ml
        return 1.0 if math.isnan(self.feed_low_ml) or most_ml <= 0.0 else min(self.feed_low_ml / most_ml, 1.0)

    def repeats(self) -> list[tuple[float, float, float]]:
        """Each repetition: run time, s, and volumes of feed and waste, mL."""

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
        """Return what the dose gave beyond the feed booked when it began, its waste with it, in the order of time."""
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
    """What was dosed at one moment.

    n: row of the journal that tells: the intent, or, where the device repeated a dose (again), its end. at_s: run time,
    s. Volumes in mL. pump: number of the pump that gave the medium.
    """

    n: int
    reactor: str
    at_s: float
    feed_ml: float
    waste_ml: float
    again: bool = False
    pump: int = 1


def feeds_by(row: Mapping[str, Any]) -> str:
    """Return the pump that an intent feeds by. Raises: ValueError for one that there is not."""
    pump = str(row.get("feed_pump", "Pump1"))
    if pump not in FEEDS:
        raise ValueError(f"feed_pump {pump}")
    return pump


def dosed(rows: Sequence[Mapping[str, Any]]) -> list[Dosed]:
    """Every dose of a journal with what it really gave, and what the device repeated of it, in the order of time.

    A dose whose feed pump was never switched on gave nothing. One whose end is not on record is counted whole; a
    resumed run's `dose_end` tells what was repeated of it. Raises: RecordingError for a row that is not as the driver
    wrote it.
    """
    given: dict[int, Dosed] = {}  # by the row of the intent
    begun: dict[str, Dosed] = {}  # by reactor, the one that has not ended
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
            elif kind == "given":  # beside our doses
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
    """Build the error of a row that is not as a driver writes it."""
    what = f"row {row.get('n')} ({row['kind']}) is damaged ({type(error).__name__}: {error})"
    return RowDamaged(path="journal.jsonl", what=what)
