"""State that a run keeps of each Chi.Bio reactor: all of it follows from the rows of the journal, oldest first.

The program updates this state with each row that it writes; a resumed program first replays the earlier rows.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from hardware.chibio.protocol import FEED, PERIOD_S, WASTE
from hardware.storage.doses import feeds_by
from hardware.storage.history import History

SPANS = {f"{part}_{what}" for part in ("feed", "waste") for what in ("on", "off", "anew")}
NEVER = (math.nan, math.nan)

Span = tuple[float, float]


@dataclass(frozen=True)
class ReactorHistory(History):
    """State of one reactor, beyond that of `History`. A sample's key is (record time, cycles).

    overflow_pump_on: the overflow pump was verified on. start_time: start of the device's experiment. The rest is about
    an open dose. feed_s, waste_s: planned on-times, s. feed_pump: pump that feeds. experiment: start_time when the dose
    began. feed_on, waste_on, feed_off, waste_off: run times between which this pump went on or off, from the answer to
    its command or from a read; nan if unknown. feed_tried, waste_tried: run time of the first off command that failed.
    feed_anew, waste_anew: run time since which somebody else may have switched the pump on, and its on-time, or nan.
    """

    device_id: str = ""
    blank: float = math.nan
    overflow_pump_on: bool = False
    start_time: str = ""
    feed_s: float = 0.0
    waste_s: float = 0.0
    feed_pump: str = FEED
    experiment: str = ""
    feed_on: Span = NEVER
    waste_on: Span = NEVER
    feed_off: Span = NEVER
    waste_off: Span = NEVER
    feed_tried: float = math.nan
    waste_tried: float = math.nan
    feed_anew: Span = NEVER
    waste_anew: Span = NEVER

    KINDS: ClassVar = (*History.KINDS, "command", "found", "overflow_pump")
    KEYS: ClassVar = {**History.KEYS, "device_id": str, "blank": float, "start_time": str}

    def after(self, row: Mapping[str, Any]) -> Self:
        kind, known = row["kind"], super().after(row)
        if kind == "intent":
            feed_s, waste_s = (PERIOD_S * float(row[f"{part}_duty"]) for part in ("feed", "waste"))
            return replace(
                known, experiment=known.start_time, feed_pump=feeds_by(row), feed_s=feed_s, waste_s=waste_s,
                feed_tried=math.nan, waste_tried=math.nan, **dict.fromkeys(SPANS, NEVER),  # type: ignore[arg-type]
            )  # fmt: skip
        if kind == "command" and known.open:
            return known._switched(
                str(row["path"]), row["answer"], float(row["time_s"]), float(row.get("took_s") or 0.0)
            )
        if kind == "found":
            said = {k: NEVER if (at := row[k]) is None else (float(at[0]), float(at[1])) for k in SPANS & row.keys()}
            seen_s = float(row.get("time_s", math.nan))  # still on after an off command, so it goes off later
            over = {
                f"{key[:-4]}_tried": seen_s if at is NEVER else math.nan for key, at in said.items() if "off" in key
            }
            return replace(known, wasted=known.wasted or "waste_on" in said, **said, **over)  # type: ignore[arg-type]
        return replace(known, overflow_pump_on=True) if kind == "overflow_pump" else known

    def _switched(self, path: str, answer: int | str, at_s: float, took_s: float) -> Self:
        """Note a pump command in an open dose; only the first successful answer to on and to off counts."""
        known = replace(self, wasted=self.wasted or path.startswith(f"/SetOutputOn/{WASTE}/1/"))
        for part, pump in (("feed", known.feed_pump), ("waste", WASTE)):
            for force, word in ((1, "on"), (0, "off")):
                key = f"{part}_{word}"
                if not path.startswith(f"/SetOutputOn/{pump}/{force}/") or not math.isnan(getattr(known, key)[1]):
                    continue
                if answer == 204:
                    return replace(known, **{key: (at_s - took_s, at_s)})  # type: ignore[arg-type]
                if word == "off" and isinstance(answer, str) and math.isnan(getattr(known, f"{part}_tried")):
                    return replace(known, **{f"{part}_tried": at_s - took_s})  # type: ignore[arg-type]
        return known


replay = ReactorHistory.replay
