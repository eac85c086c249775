"""What a run remembers of each Chi.Bio reactor: all of it stands in the rows of its journal, oldest first.

A life of the program enters each row as it writes it; a resumed one begins with the rows of the lives before.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hardware.chibio.protocol import FEED, PERIOD_S, WASTE
from hardware.storage.doses import damaged, feeds_by

__all__ = ["NEVER", "ReactorHistory", "Span", "remember", "replay"]

KEYS: Mapping[str, Callable[[Any], Any]] = {
    "device_id": str, "blank": float, "carry_ml": float, "doses": int, "temperature": float, "start_time": str,
}  # fmt: skip
KINDS = ("device", "intent", "feed_on", "command", "found", "dose_end", "temperature", "guard", "regulate")
SPANS = {"feed_on", "waste_on", "feed_off", "waste_off"}
NEVER = (math.nan, math.nan)

Span = tuple[float, float]


@dataclass(frozen=True)
class ReactorHistory:
    """What a run must remember of one reactor.

    overflow_pump_on: it was verified on. handed_over: OD at which it was handed over to the on-board regulation.
    sample: (record time, cycles) of the last sample a dose was decided for. start_time: of the device's experiment.
    seen_s: run time of the newest row, s.
    open: a dose was begun and its end is not on record. Then feed_ml, waste_ml, feed_s, waste_s are its volumes and
      on-times as planned; feed_pump, which pump feeds; on_s, run time at which it was intended, or, once it was fed,
      at which its feed pump was asked on; fed, whether that was; wasted, whether its waste pump was; experiment,
      start_time then. feed_on, waste_on, feed_off, waste_off: run times between which that pump went on or off, by the
      answer to its command or by what was found; nan if not known. feed_tried, waste_tried: run time at which it was
      first asked off without an answer.
    """

    device_id: str = ""
    blank: float = math.nan
    sample: tuple[float, int] | None = None
    carry_ml: float = 0.0
    doses: int = 0
    temperature: float = math.nan
    overflow_pump_on: bool = False
    handed_over: float = math.nan
    start_time: str = ""
    seen_s: float = 0.0
    open: bool = False
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    feed_s: float = 0.0
    waste_s: float = 0.0
    feed_pump: str = FEED
    on_s: float = 0.0
    fed: bool = False
    wasted: bool = False
    experiment: str = ""
    feed_on: Span = NEVER
    waste_on: Span = NEVER
    feed_off: Span = NEVER
    waste_off: Span = NEVER
    feed_tried: float = math.nan
    waste_tried: float = math.nan


def remember(known: ReactorHistory, row: Mapping[str, Any]) -> ReactorHistory:
    """What is known after one more row of this reactor. Raises: as a row that is damaged makes it."""
    kind = row["kind"]
    if kind not in KINDS:
        return known
    known = replace(known, **{key: of(row[key]) for key, of in KEYS.items() if row.get(key) is not None})
    if kind == "intent":
        (at_s, number), feed_ml, on_s = row["sample"], float(row["feed_ml"]), float(row["on_s"])
        feed_s, waste_s = (PERIOD_S * float(row[f"{part}_duty"]) for part in ("feed", "waste"))
        return replace(
            known, sample=(float(at_s), int(number)), open=feed_ml > 0.0, feed_ml=feed_ml, on_s=on_s, fed=False,
            wasted=False, experiment=known.start_time, waste_ml=float(row["waste_ml"]), feed_pump=feeds_by(row),
            feed_on=NEVER, waste_on=NEVER, feed_off=NEVER, waste_off=NEVER, feed_s=feed_s,
            waste_s=waste_s, feed_tried=math.nan, waste_tried=math.nan,
        )  # fmt: skip
    if kind == "feed_on":
        return replace(known, fed=True, on_s=float(row["on_s"]))
    if kind == "command" and known.open:
        return _switched(
            known, str(row["path"]), row["answer"] == 204, float(row["time_s"]), float(row.get("took_s") or 0.0)
        )
    if kind == "found":
        said = {key: _span(row[key]) for key in SPANS & row.keys()}
        over = {f"{part}_tried": math.nan for part in ("feed", "waste") if f"{part}_off" in said}
        return replace(known, wasted=known.wasted or "waste_on" in said, **said, **over)  # type: ignore[arg-type]
    if kind == "dose_end":
        return replace(known, open=False)
    if kind == "guard":
        return replace(known, overflow_pump_on=True)
    if kind == "regulate":  # its pumps were verified off before; None: control was taken back
        setpoint = math.nan if row["setpoint"] is None else float(row["setpoint"])
        return replace(known, handed_over=setpoint, open=False)
    return known


def _span(said: Any) -> Span:
    """Two run times; None: not known."""
    return NEVER if said is None else (float(said[0]), float(said[1]))


def _switched(known: ReactorHistory, path: str, heard: bool, at_s: float, took_s: float) -> ReactorHistory:
    """A pump was switched in an open dose; the first answer of its kind counts."""
    known = replace(known, wasted=known.wasted or path.startswith(f"/SetOutputOn/{WASTE}/1/"))
    for part, pump in (("feed", known.feed_pump), ("waste", WASTE)):
        for force, word in ((1, "on"), (0, "off")):
            key = f"{part}_{word}"
            if not path.startswith(f"/SetOutputOn/{pump}/{force}/") or not math.isnan(getattr(known, key)[1]):
                continue
            if heard:
                return replace(known, **{key: (at_s - took_s, at_s)})  # type: ignore[arg-type]
            if word == "off" and math.isnan(getattr(known, f"{part}_tried")):
                return replace(known, **{f"{part}_tried": at_s - took_s})  # type: ignore[arg-type]
    return known


def replay(rows: Sequence[Mapping[str, Any]]) -> dict[str, ReactorHistory]:
    """What the journal of a run says of each reactor: identity, blank, last sample acted on, a dose left open.

    Args: rows: of a journal this driver has written into, oldest first.
    Raises: RecordingError for a row that is not as the driver wrote it.
    """
    known: dict[str, ReactorHistory] = {}
    seen_s = 0.0
    for row in rows:
        seen_s = max(seen_s, float(row.get("time_s") or 0.0))
        if row.get("kind") not in KINDS:
            continue
        try:
            name = str(row["reactor"])
            known[name] = remember(known.get(name, ReactorHistory()), row)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise damaged(row, error) from None
    return {name: replace(entry, seen_s=seen_s) for name, entry in known.items()}
