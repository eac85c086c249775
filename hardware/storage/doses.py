"""What the journal says of doses, in the rows of every family: what each gave, and what was repeated of it.

`intent` before a dose, `feed_on` before its pump is switched on or asked for, `dose_end` after it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from hardware.errors import RecordingError
from hardware.storage.journal import REMEDY

__all__ = ["REPEAT_S", "Dosed", "Ending", "damaged", "dosed", "feeds_by"]

REPEAT_S = 63.0
"""A row tells repetitions of a dose by their number, each so long after the one before: the period of a Chi.Bio."""
FEEDS = {"Pump1": 1, "Pump3": 3, "Pump4": 4}  # pumps that an intent may name, and their numbers


@dataclass(frozen=True)
class Ending:
    """How a dose ended.

    on_s: run time at which its pumps were switched on, s. feed_ml, waste_ml: what it gave. feed_times, waste_times: how
    often the device gave the same again, every 63 s from `on_s` on, before the pump was off. pump: number of the spare
    pump that gave it, 0 for the feed.
    """

    on_s: float
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    feed_times: int = 0
    waste_times: int = 0
    pump: int = 0

    @property
    def repeated_ml(self) -> float:
        """Fresh medium beyond the dose itself, mL."""
        return self.feed_times * self.feed_ml

    def repeats(self) -> list[tuple[float, float, float]]:
        """Each repetition: run time, s, and volumes of feed and waste, mL."""
        return [
            (self.on_s + REPEAT_S * k, self.feed_ml * (k <= self.feed_times), self.waste_ml * (k <= self.waste_times))
            for k in range(1, max(self.feed_times, self.waste_times) + 1)
        ]

    def row(self) -> dict[str, Any]:
        """As the journal keeps it."""
        known = {key: value for key, value in asdict(self).items() if key != "pump" or value}
        return {"verified_off": True, "repeated_ml": self.repeated_ml, **known}

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Ending:
        """The inverse of `row`. Raises: KeyError, TypeError, ValueError for a damaged row."""
        on_s, feed_ml, waste_ml = (float(row[key]) for key in ("on_s", "feed_ml", "waste_ml"))
        return cls(on_s, feed_ml, waste_ml, int(row["feed_times"]), int(row["waste_times"]), int(row.get("pump", 0)))


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
    """The pump that an intent feeds by. Raises: ValueError for one that there is not."""
    pump = str(row.get("feed_pump", "Pump1"))
    if pump not in FEEDS:
        raise ValueError(f"feed_pump {pump}")
    return pump


def dosed(rows: Sequence[Mapping[str, Any]]) -> list[Dosed]:
    """Every dose of a journal with what it really gave, and what the device repeated of it, in the order of time.

    A dose whose feed pump was never switched on gave nothing. One whose end is not on record is counted whole; what the
    device repeated of it is told by the `dose_end` that a resumed run writes.

    Args: rows: of a journal, oldest first. Raises: RecordingError for a row that is not as the driver wrote it.
    """
    ledger = _Ledger()
    for row in rows:
        if row.get("kind") in ("intent", "feed_on", "dose_end"):
            try:
                ledger.take(row)
            except (KeyError, TypeError, ValueError) as error:
                raise damaged(row, error) from None
    return sorted([*ledger.given.values(), *ledger.repeated], key=lambda d: d.at_s)


class _Ledger:
    """Doses by the row of their intent, their repetitions, and by reactor the one that has not ended."""

    def __init__(self) -> None:
        self.given: dict[int, Dosed] = {}
        self.repeated: list[Dosed] = []
        self._begun: dict[str, Dosed] = {}

    def take(self, row: Mapping[str, Any]) -> None:
        """Enter what one row says."""
        kind, name = row["kind"], str(row["reactor"])
        if kind == "intent":
            volumes = float(row["feed_ml"]), float(row["waste_ml"])
            number = FEEDS[feeds_by(row)]
            self._begun[name] = Dosed(row["n"], name, float(row["on_s"]), *volumes, pump=number)
        elif kind == "feed_on" and name in self._begun:
            self.given[self._begun[name].n] = self._begun[name]
        elif kind == "dose_end" and "feed_times" in row:
            ending = Ending.of_row(row)
            dose = self._begun.pop(name, None)
            if dose is not None:
                self.given[dose.n] = replace(dose, at_s=ending.on_s, feed_ml=ending.feed_ml, waste_ml=ending.waste_ml)
            pump = 1 if dose is None else dose.pump
            self.repeated += [Dosed(row["n"], name, *one, again=True, pump=pump) for one in ending.repeats()]


def damaged(row: Mapping[str, Any], error: Exception) -> RecordingError:
    """A row that is not as a driver writes it."""
    what = f"row {row.get('n')} ({row['kind']}) is damaged ({type(error).__name__}: {error})"
    return RecordingError(f"journal.jsonl: {what}; {REMEDY}")
