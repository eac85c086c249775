"""State that a run keeps of a reactor of any family, and its recovery from the journal's rows after a crash."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from hardware.storage.doses import damaged


@dataclass(frozen=True)
class History:
    """One reactor's past; a family adds further fields.

    sample: key of the last sample for which a dose was decided. carry_ml: volume kept for the next dose, mL. doses:
      number of doses begun. temperature: thermostat target, degC. handed_over: OD at which the reactor was handed over
      to the device's own regulation, nan if it was not. seen_s: run time of the newest row, s.
    open: a dose was begun and its end is not on record. feed_ml, waste_ml: planned volumes of the open dose, mL. fed,
      wasted: its feed pump, its waste pump was commanded on. on_s: run time of its intent or, once fed is true, of the
      feed pump's command, s.
    """

    sample: tuple[float, int] | None = None
    carry_ml: float = 0.0
    doses: int = 0
    temperature: float = math.nan
    handed_over: float = math.nan
    seen_s: float = 0.0
    open: bool = False
    feed_ml: float = 0.0
    waste_ml: float = 0.0
    on_s: float = 0.0
    fed: bool = False
    wasted: bool = False

    KINDS: ClassVar[tuple[str, ...]] = ("device", "intent", "feed_on", "dose_end", "temperature", "regulate")
    KEYS: ClassVar[Mapping[str, Callable[[Any], Any]]] = {"carry_ml": float, "doses": int, "temperature": float}

    def after(self, row: Mapping[str, Any]) -> Self:
        """Return the history after one more row of this reactor. Raises: errors of a damaged row, see `replay`."""
        kind = row["kind"]
        if kind not in self.KINDS:
            return self
        known = replace(self, **{key: of(row[key]) for key, of in self.KEYS.items() if row.get(key) is not None})
        if kind == "intent":
            (at_s, number), feed_ml = row["sample"], float(row["feed_ml"])
            return replace(
                known, sample=(float(at_s), int(number)), open=feed_ml > 0.0, feed_ml=feed_ml,
                waste_ml=float(row["waste_ml"]), on_s=float(row["on_s"]), fed=False, wasted=False,
            )  # fmt: skip
        if kind == "feed_on":
            return replace(known, fed=True, on_s=float(row["on_s"]))
        if kind == "dose_end":
            return replace(known, open=False)
        if kind == "regulate":  # its pumps were verified off before; None: control was taken back
            setpoint = math.nan if row["setpoint"] is None else float(row["setpoint"])
            return replace(known, handed_over=setpoint, open=False)
        return known

    @classmethod
    def replay(cls, rows: Sequence[Mapping[str, Any]]) -> dict[str, Self]:
        """Replay the rows of a journal, oldest first, for each reactor. Raises: RecordingError for a damaged row."""
        known: dict[str, Self] = {}
        seen_s = 0.0
        for row in rows:
            seen_s = max(seen_s, float(row.get("time_s") or 0.0))
            if row.get("kind") in cls.KINDS:
                try:
                    name = str(row["reactor"])
                    known[name] = known.get(name, cls()).after(row)
                except (IndexError, KeyError, TypeError, ValueError) as error:
                    raise damaged(row, error) from None
        return {name: replace(entry, seen_s=seen_s) for name, entry in known.items()}
