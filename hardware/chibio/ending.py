"""How a dose ended: what it gave, and what the device repeated of it before its pumps were off."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hardware.chibio.protocol import PERIOD_S

__all__ = ["Ending", "repeats_until"]


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
            (self.on_s + PERIOD_S * k, self.feed_ml * (k <= self.feed_times), self.waste_ml * (k <= self.waste_times))
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


def repeats_until(off_s: float, on_s: float) -> int:
    """How often a pump that was switched on at `on_s` had begun its dose again by `off_s`."""
    return max(math.floor((off_s - on_s) / PERIOD_S), 0)
