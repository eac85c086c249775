"""What a run must remember of each unit and its doses, and how the journal gives it back after a crash.

The rows are those of every family: intent before a dose, feed_on before its request, dose_end after it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hardware.pioreactor.mailbox import PUMPS
from hardware.storage.doses import damaged

__all__ = ["History", "replay"]


@dataclass(frozen=True)
class History:
    """One unit's past.

    sample: key of the last sample that a dose was decided for. carry_ml: put off to the next dose. doses: ids given
    out. handed_over: OD at which the vendor's turbidostat was started, nan if it was not. boot: when the unit had been
    started. open: a dose has no end on record; then id, feed_ml, waste_ml are its, on_s the run time at which it was
    intended, fed whether its request was sent, task what the unit answered to it, wasted whether that of its waste was.
    """

    sample: tuple[float, int] | None = None
    carry_ml: float = 0.0
    doses: int = 0
    temperature: float = math.nan
    handed_over: float = math.nan
    boot: str = ""
    open: bool = False
    fed: bool = False
    wasted: bool = False
    id: str = ""
    task: str = ""
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    on_s: float = 0.0


def _after(known: History, row: Mapping[str, Any]) -> History:
    """What is known after one more row."""
    kind = row["kind"]
    if kind == "intent":
        time, number = row["sample"]
        return replace(
            known, sample=(float(time), int(number)), carry_ml=float(row["carry_ml"]), doses=int(row["doses"]),
            open=float(row["feed_ml"]) > 0.0, fed=False, wasted=False, id=str(row["id"]), task="",
            feed_ml=float(row["feed_ml"]), waste_ml=float(row["waste_ml"]), on_s=float(row["on_s"]),
        )  # fmt: skip
    if kind == "feed_on":
        return replace(known, fed=True)
    if kind == "task" and row["id"] == known.id:
        return replace(known, task=str(row["task"]), wasted=row["job"] != PUMPS[0])
    if kind == "dose_end":
        return replace(known, open=False)
    if kind == "regulate":
        return replace(known, handed_over=float(row["setpoint"]))
    if kind == "temperature":
        return replace(known, temperature=float(row["temperature"]))
    if kind == "device":
        return replace(known, boot=str(row.get("boot", "")))
    return known


def replay(rows: Sequence[Mapping[str, Any]]) -> dict[str, History]:
    """What the journal of a run says of each unit. Args: rows: oldest first.

    Raises: RecordingError for a row that is not as the driver wrote it.
    """
    known: dict[str, History] = {}
    for row in rows:
        if row.get("kind") in ("intent", "feed_on", "dose_end", "regulate", "temperature", "device", "task"):
            try:
                name = str(row["reactor"])
                known[name] = _after(known.get(name, History()), row)
            except (KeyError, TypeError, ValueError) as error:
                raise damaged(row, error) from None
    return known
