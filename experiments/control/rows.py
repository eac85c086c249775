"""The rows of a recording: their columns, the row of a step, and the rows of a run in memory."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.control.loop import Step

__all__ = ["COLUMNS", "NUMBERS", "Row", "Rows", "row_of"]

Array = NDArray[np.float64]
Row = dict[str, float | int | str | bool | None]

COLUMNS = (
    "time_min", "elapsed_min", "phase", "od", "setpoint", "pump_rate_ml_s", "proposed_ml_s", "volume_ml",
    "temperature_degc", "interlock",
)  # fmt: skip
NUMBERS = COLUMNS[:-1]


def row_of(step: Step, n: int) -> Row:
    """The CSV row of reactor n in a step."""
    return {
        "time_min": round(float(step.minute[n]), 4),
        "elapsed_min": round(float(step.elapsed[n]), 4),
        "phase": int(step.phase[n]),
        "od": float(step.od[n]),
        "setpoint": float(step.setpoint[n]),
        "pump_rate_ml_s": float(step.rate[n]),
        "proposed_ml_s": float(step.proposed[n]),
        "volume_ml": float(step.volume_ml[n]),
        "temperature_degc": round(float(step.temperature[n]), 3),
        "interlock": step.reasons[n] or "",
    }


class Rows:
    """All rows of one reactor's recording: the numbers by column, and in how many rows the interlock spoke."""

    def __init__(self) -> None:
        self.columns = {key: array("d") for key in NUMBERS}
        self.alarms = 0  # rows in which the interlock spoke

    def __len__(self) -> int:
        return len(self.columns["time_min"])

    def append(self, row: Mapping[str, Any]) -> None:
        """Take a row. Raises: ValueError for a cell that is no number, KeyError for a missing one."""
        for key, column in self.columns.items():
            column.append(float(row[key]))
        self.alarms += bool(row["interlock"])

    def last(self) -> dict[str, float]:
        """The numbers of the newest row; none for an empty recording."""
        return {key: column[-1] for key, column in self.columns.items()} if len(self) else {}
