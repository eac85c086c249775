"""What a run must remember of each Chi.Bio reactor and its doses, and how the journal gives it back after a crash."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hardware.chibio.protocol import FEED, PERIOD_S, PUMPS, WASTE, DeviceState
from hardware.storage.doses import Ending, damaged, feeds_by

__all__ = ["ReactorHistory", "conclude", "repeats_until", "replay"]

SWITCH_S = 10.0  # after its silence the board agent needs a moment, and the last request before it is not on record

KEYS: Mapping[str, Callable[[Any], Any]] = {
    "device_id": str, "blank": float, "carry_ml": float, "doses": int, "temperature": float, "feed_ml": float,
    "waste_ml": float, "on_s": float, "start_time": str,
}  # fmt: skip
KINDS = ("device", "intent", "feed_on", "command", "dose_end", "temperature", "guard", "regulate")


@dataclass(frozen=True)
class ReactorHistory:
    """What a run must remember of one reactor across a restart of this program.

    overflow_pump_on: it was verified on. handed_over: OD at which it was handed over to the on-board regulation.
    sample: (record time, cycles) of the last sample a dose was decided for. start_time: of the device's experiment.
    open: a dose was begun and its end was never recorded; then feed_ml, waste_ml are its volumes, on_s the run time at
    which it began, s, feed_pump, which pump fed ("": the feed pump), fed, whether it was switched on, feed_off,
    whether it was switched off again.
    seen_s: run time of the newest row, s.
    """

    device_id: str = ""
    blank: float = math.nan
    sample: tuple[float, int] | None = None
    carry_ml: float = 0.0
    doses: int = 0
    temperature: float = math.nan
    overflow_pump_on: bool = False
    handed_over: float = math.nan
    open: bool = False
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    on_s: float = 0.0
    feed_pump: str = ""
    fed: bool = False
    feed_off: bool = False
    start_time: str = ""
    seen_s: float = 0.0


def _take(entry: dict[str, Any], row: Mapping[str, Any]) -> None:
    """What one row says."""
    entry.update({key: kind(row[key]) for key, kind in KEYS.items() if row.get(key) is not None})
    if row["kind"] == "intent":
        sample, volumes = row["sample"], (float(row["feed_ml"]), float(row["waste_ml"]))
        entry["feed_pump"] = "" if feeds_by(row) == FEED else feeds_by(row)
        entry.update(sample=(float(sample[0]), int(sample[1])), open=volumes[0] > 0.0, fed=False, feed_off=False)
    elif row["kind"] == "feed_on":
        entry["fed"] = True
    elif row["kind"] == "command":
        if row["path"] == f"/SetOutputOn/{entry.get('feed_pump') or FEED}/0/{row['reactor']}" and row["answer"] == 204:
            entry["feed_off"] = True
    elif row["kind"] == "dose_end":
        entry["open"] = False
    elif row["kind"] == "guard":
        entry["overflow_pump_on"] = True
    elif row["kind"] == "regulate":
        setpoint = math.nan if row["setpoint"] is None else float(row["setpoint"])  # None: control was taken back
        entry.update(handed_over=setpoint, open=False)  # its pumps were verified off before


def replay(rows: Sequence[Mapping[str, Any]]) -> dict[str, ReactorHistory]:
    """What the journal of a run says of each reactor: identity, blank, last sample acted on, a dose left open.

    Args:
      rows: rows of a journal this driver has written into, oldest first.
    Raises: RecordingError for a row that is not as the driver wrote it.
    """
    known: dict[str, dict[str, Any]] = {}
    seen_s = 0.0
    for row in rows:
        seen_s = max(seen_s, float(row.get("time_s") or 0.0))
        if row.get("kind") not in KINDS:
            continue
        try:
            _take(known.setdefault(str(row["reactor"]), {}), row)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise damaged(row, error) from None
    return {name: ReactorHistory(**entry, seen_s=seen_s) for name, entry in known.items()}


def repeats_until(off_s: float, on_s: float) -> int:
    """How often a pump that was switched on at `on_s` had begun its dose again by `off_s`."""
    return max(math.floor((off_s - on_s) / PERIOD_S), 0)


def conclude(history: ReactorHistory, state: DeviceState, now_s: float, silence_s: float) -> tuple[Ending, str]:
    """What became of the dose that an earlier life of the program left open, and that in words.

    A pump that is still on has repeated its dose until now. One that is off, although this program never switched it
    off, was switched off by something else, as the board agent does after a silence: it may have repeated until then.
    A device that was restarted meanwhile forgot its pumps.

    Args:
      state: as the device was found, before its pumps were switched off. now_s: run time at which they were, s.
      silence_s: after which the board agent switches pumps off.
    """
    feed_on, waste_on = (state.pumps_on[PUMPS.index(pump)] for pump in (history.feed_pump or FEED, WASTE))
    fed, what = history.fed or feed_on, f"a dose of {history.feed_ml:.2f} mL was left open"
    pump = PUMPS.index(history.feed_pump) + 1 if history.feed_pump else 0
    whole = Ending(history.on_s, history.feed_ml if fed else 0.0, history.waste_ml, pump=pump)
    if history.start_time and (state.start_time != history.start_time or not state.started):
        return whole, f"{what}; the device was restarted since, which ends every dose: nothing more is booked"
    found_on = feed_on or waste_on
    off_s = now_s if found_on else min(now_s, history.seen_s + silence_s + SWITCH_S)
    times = repeats_until(off_s, history.on_s)
    feeding = feed_on or (fed and not history.feed_off and not waste_on)
    wasting = waste_on or (fed and not found_on)
    ending = replace(whole, feed_times=times * feeding, waste_times=times * wasting)
    if not fed:
        return ending, f"{what} before its feed pump was switched on: no medium was given"
    if not feeding:
        return ending, f"{what} after its feed pump had been switched off: no medium followed"
    followed = f"repeated {times} times, {ending.repeated_ml:.2f} mL, booked at their times"
    if found_on:
        return ending, f"{what}; {followed}"
    by = f"something else switched its pumps off, after a silence of {silence_s:g} s if it was the board agent"
    return ending, f"{what}; {by}; {followed}"
