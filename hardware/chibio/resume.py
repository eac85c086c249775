"""What a run must remember of each Chi.Bio reactor, and how the journal gives it back after a crash."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hardware.errors import RecordingError
from hardware.storage.journal import REMEDY

__all__ = ["ReactorHistory", "replay"]

KEYS: Mapping[str, Callable[[Any], Any]] = {
    "device_id": str, "blank": float, "carry_ml": float, "doses": int, "temperature": float, "feed_ml": float,
    "waste_ml": float, "on_s": float,
}  # fmt: skip


@dataclass(frozen=True)
class ReactorHistory:
    """What a run must remember of one reactor across a restart of this program.

    overflow_pump_on: it was verified on. handed_over: OD at which it was handed over to the on-board regulation.
    sample: (record time, cycles) of the last sample a dose was decided for. open: a dose was begun and its end was
    never recorded; then feed_ml, waste_ml are its volumes and on_s the run time at which it began, s.
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


def _take(entry: dict[str, Any], row: Mapping[str, Any]) -> None:
    """What one row says."""
    entry.update({key: kind(row[key]) for key, kind in KEYS.items() if row.get(key) is not None})
    if row["kind"] == "intent":
        sample, volumes = row["sample"], (float(row["feed_ml"]), float(row["waste_ml"]))
        entry.update(sample=(float(sample[0]), int(sample[1])), open=volumes[0] > 0.0)
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
    for row in rows:
        if row.get("kind") not in ("device", "intent", "dose_end", "temperature", "guard", "regulate"):
            continue
        try:
            _take(known.setdefault(str(row["reactor"]), {}), row)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            what = f"row {row.get('n')} ({row['kind']}) is damaged ({type(error).__name__}: {error})"
            raise RecordingError(f"journal.jsonl: {what}; {REMEDY}") from None
    return {name: ReactorHistory(**entry) for name, entry in known.items()}
