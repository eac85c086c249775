"""Who gives the next dose: the feed pump as the controller decides, or a spare pump to which the step owes a dose.

There is one dose per sample, whichever pump gives it, so two pumps never feed at one time, and a spare pump's dose
passes the interlock, its ledger and the waste pump's law like any other. The controller's dose of that sample is left
out; it makes up for it at the next ones, because it sees the OD.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.outputs import DOSE_ML, MADE_UP_MIN, PUMPS, outputs_of
from envs.scenario import Scenario
from experiments.controllers.base import Array, Mask

__all__ = ["Supply"]

FEED_PUMP = 1


class Supply:
    """What N reactors' steps owe by pumps 3 and 4.

    owed grows by the step's mL/h, and by its mL once at the step's first sample; it is given in doses of `DOSE_ML` to
    `most_ml`, equal parts where it takes several. What a step still owes at its end is left out.

    Args: schedules: one per reactor. most_ml: largest dose.
    Attributes: any, whether any step has outputs; owed, mL, (N, 2).
    """

    def __init__(self, schedules: Sequence[Scenario], most_ml: float) -> None:
        n, width = len(schedules), max(len(s.setpoints) for s in schedules)
        self._per_min, self._once = np.zeros((n, width, len(PUMPS))), np.zeros((n, width, len(PUMPS)))
        for i, schedule in enumerate(schedules):
            for k, text in enumerate(schedule.outputs):
                for output in outputs_of(text):
                    at = (i, k, PUMPS.index(output.pump))
                    self._per_min[at], self._once[at] = output.ml_h / 60.0, output.ml
        self.any = bool((self._per_min + self._once).any())
        self._most_ml = most_ml
        self.owed = np.zeros((n, len(PUMPS)))
        self._last, self._step = np.full(n, np.nan), np.full(n, -1)

    def due(self, elapsed: Array, phase: NDArray[np.intp], rows: Mask) -> tuple[NDArray[np.intp], Array]:
        """Which pump each reactor is to be fed by, 1, 3 or 4, and the dose of a spare pump, mL, each (N,).

        Args: elapsed: min since the schedule began; phase: its step; rows: where a dose may be decided, inside it.
        """
        n = elapsed.size
        if not self.any:
            return np.full(n, FEED_PUMP, dtype=np.intp), np.zeros(n)
        row, step = np.arange(n), np.maximum(phase, 0)
        passed = np.clip(np.nan_to_num(elapsed - self._last), 0.0, MADE_UP_MIN)
        new = phase != self._step
        owed = np.where(new[:, None], self._once[row, step], self.owed + self._per_min[row, step] * passed[:, None])
        self.owed = np.where(rows[:, None], owed, self.owed)
        self._last = np.where(rows, elapsed, self._last)
        self._step = np.where(rows, phase, self._step)
        largest = self.owed.argmax(axis=1)
        ml = self.owed[row, largest]
        given = rows & (ml >= DOSE_ML - 1e-9)
        dose = np.where(given, ml / np.maximum(np.ceil(ml / self._most_ml - 1e-9), 1.0), 0.0)
        return np.where(given, np.array(PUMPS)[largest], FEED_PUMP).astype(np.intp), dose

    def given(self, pump: NDArray[np.intp], ml: Array) -> None:
        """What was begun by each reactor's pump, mL, (N,)."""
        for k, spare in enumerate(PUMPS):
            self.owed[:, k] -= np.where(pump == spare, ml, 0.0)

    def row(self, n: int) -> dict[str, Any]:
        """What a decision for reactor n has to keep; plain numbers."""
        if not self.any:
            return {}
        return {
            "owed_ml": self.owed[n].tolist(),
            "supplied_at": float(self._last[n]),
            "supplied_step": int(self._step[n]),
        }

    def take(self, n: int, row: Mapping[str, Any]) -> None:
        """Put reactor n where `row` was. Raises: ValueError naming what does not fit."""
        if not self.any:
            return
        try:
            owed = np.array(row["owed_ml"], dtype=np.float64)
            last = float("nan") if row["supplied_at"] is None else float(row["supplied_at"])
            step = int(row["supplied_step"])
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"supply: {str(row)[:60]}, expected owed_ml, supplied_at and supplied_step") from None
        if owed.shape != (len(PUMPS),) or not np.isfinite(owed).all():
            raise ValueError(f"supply: owed_ml {str(row['owed_ml'])[:40]}, expected {len(PUMPS)} numbers")
        self.owed[n], self._last[n], self._step[n] = owed, last, step

    def state(self) -> dict[str, Any]:
        """Every reactor's `row`; nothing where no step has outputs."""
        return {"supply": [self.row(n) for n in range(len(self.owed))]} if self.any else {}

    def restore(self, state: Any) -> None:
        """Continue as saved. Raises: ValueError as `take`."""
        if not self.any:
            return
        if not (isinstance(state, list) and len(state) == len(self.owed)):
            raise ValueError(f"supply: {str(state)[:40]}, expected one entry for each of {len(self.owed)} reactors")
        for n, row in enumerate(state):
            self.take(n, row if isinstance(row, Mapping) else {})
