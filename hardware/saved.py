"""What a run must remember of each Chi.Bio reactor, and how the journal gives it back after a crash."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

__all__ = ["Saved", "replay"]


@dataclass(frozen=True)
class Saved:
    """What a run must remember of one reactor across a restart of this program.

    guarded: its overflow guard was verified on.
    sample: (record time, cycles) of the last sample a dose was decided for. open: a dose was begun and its end was
    never recorded; then feed_ml, waste_ml are its volumes and on_s the run time at which it began, s.
    """

    device_id: str = ""
    blank: float = math.nan
    sample: tuple[float, int] | None = None
    carry_ml: float = 0.0
    doses: int = 0
    temperature: float = math.nan
    guarded: bool = False
    open: bool = False
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    on_s: float = 0.0


def replay(rows: Sequence[Mapping[str, Any]]) -> dict[str, Saved]:
    """What the journal of a run says of each reactor: identity, blank, last sample acted on, a dose left open.

    Args:
      rows: rows of a journal this driver has written into, oldest first.
    """
    known: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row.get("kind") not in ("device", "intent", "dose_end", "temperature", "guard"):
            continue
        entry = known.setdefault(str(row["reactor"]), {})
        keys = ("device_id", "blank", "carry_ml", "doses", "temperature", "feed_ml", "waste_ml", "on_s")
        entry.update({k: row[k] for k in keys if row.get(k) is not None})
        if row["kind"] == "intent":
            entry.update(sample=(float(row["sample"][0]), int(row["sample"][1])), open=row["feed_ml"] > 0.0)
        elif row["kind"] == "dose_end":
            entry["open"] = False
        elif row["kind"] == "guard":
            entry["guarded"] = True
    return {name: Saved(**entry) for name, entry in known.items()}
