"""What became of one fault at one moment of a rehearsed run, and whether that is what its declaration says."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from experiments.reliability.faults import Fault

__all__ = ["Outcome", "judge"]


@dataclass
class Outcome:
    """What happened. Times s after the fault, volumes mL; nan where there is nothing to tell.

    guarded: whether the rig has an overflow guard.
    detected_s, reason: first declared word on the fault. response: of the interlock to it. kinds: all reasons after
      it; notes: of the driver.
    peak_ml, overflowed: of the worst vial.
    peak_error: largest distance of the faulty reactor's true OD, after the fault, from what the schedule asks and the
      pump can do; 4 stands for anything above.
    rows_missed: samples nobody could read; rows_lost: samples that could have been read and are in no row;
      rows_doubled.
    doses_doubled: runs of the feed motor beyond one per decision; repeats: those that are the device's own (every
      63 s), while nobody could stop it.
    exits: how often the device's software ended itself although the fault was over, or was not of that kind: a command
      to an absent reactor does that. neighbours_lost: healthy neighbours whose schedule did not end.
    pumps_off: every motor at rest at the end, as the program claims.
    early_alarms, neighbour_alarms: reasons given before the fault, and for healthy neighbours.
    outcome: how the run ended. wrong: what is not as declared.
    """

    fault: str
    moment: str
    guarded: bool = True
    at_min: float = math.nan
    detected_s: float = math.nan
    reason: str = ""
    response: str = ""
    kinds: dict[str, int] = field(default_factory=dict)
    notes: dict[str, int] = field(default_factory=dict)
    peak_ml: float = math.nan
    overflowed: bool = False
    peak_error: float = 0.0
    rows_missed: int = 0
    rows_lost: int = 0
    rows_doubled: int = 0
    doses_doubled: int = 0
    repeats: int = 0
    exits: int = 0
    neighbours_lost: int = 0
    pumps_off: bool = False
    early_alarms: int = 0
    neighbour_alarms: int = 0
    outcome: str = ""
    wrong: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Nothing is wrong."""
        return not self.wrong

    @property
    def label(self) -> str:
        """The fault's name, and the rig if it is the standard one."""
        return self.fault if self.guarded else f"{self.fault}, no guard"

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return {**asdict(self), "ok": self.ok}


def judge(out: Outcome, fault: Fault | None) -> list[str]:
    """What is not as declared; of a healthy run (None), every word is a false alarm."""
    checks = {
        "overflow": out.overflowed and (out.guarded or not (fault and fault.overflow)),
        "rows lost": out.rows_lost > 0,
        "rows doubled": out.rows_doubled > 0,
        "doses doubled": out.doses_doubled > 0,
        "device ended": out.exits > 0,
        "neighbour lost": out.neighbours_lost > 0,
        "pumps not off": not out.pumps_off and not (fault and fault.stuck),
        "not detected": fault is not None and bool(fault.by) and not out.reason,
        "false alarm": out.early_alarms + out.neighbour_alarms > 0 or (fault is None and bool(out.kinds)),
    }
    return [name for name, is_wrong in checks.items() if is_wrong]
