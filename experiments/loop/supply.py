"""Who gives the next dose: the feed pump as the controller decides, or a spare pump that owes one.

There is one dose per sample, whichever pump gives it, so two pumps never feed at one time, and a spare pump's dose
passes the interlock, its ledger and the waste pump's law like any other. The controller's dose of that sample is left
out; it makes up for it at the next ones, because it sees the OD.
"""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from envs.scenario import DOSE_ML, MADE_UP_MIN, PUMPS, Scenario, outputs_of
from experiments.laws.base import Array, Mask

FEED_PUMP = 1


class Supply:
    """Volumes due from pumps 3 and 4 of N reactors, by the steps of their schedules or by a signal.

    The due volume grows by the mL/h of the step or the signal, and by the step's mL at its first sample. It is
    delivered in doses of `DOSE_ML` to `most_ml`, split equally if larger. The undelivered rest of a step is dropped.

    Args: schedules: one per reactor. most_ml: largest dose. asked: pumps that a signal commands.
    Attributes: any, whether these pumps are used; owed_ml, due volume, (N, 2); remembers, saved attributes.
    """

    def __init__(self, schedules: Sequence[Scenario], most_ml: float, asked: Collection[int] = ()) -> None:
        n, width = len(schedules), max(len(s.setpoints) for s in schedules)
        self._per_min, self._once = np.zeros((n, width, len(PUMPS))), np.zeros((n, width, len(PUMPS)))
        for i, schedule in enumerate(schedules):
            for k, text in enumerate(schedule.outputs):
                for output in outputs_of(text):
                    at = (i, k, PUMPS.index(output.pump))
                    self._per_min[at], self._once[at] = output.ml_h / 60.0, output.ml
        scheduled = (self._per_min + self._once).any(axis=(0, 1))
        self._asked = np.isin(PUMPS, list(asked))
        self.any = bool((scheduled | self._asked).any())
        self.remembers = ("owed_ml", "supplied_at", "supplied_step") if self.any else ()
        self._most_ml = most_ml
        self.owed_ml = np.zeros((n, len(PUMPS)))
        self._supplied_at, self._supplied_step = np.full(n, np.nan), np.full(n, -1)

    def ask(self, pump: int, rate: Array) -> None:
        """Take a signal's command from now on. Args: rate: mean rate, mL/s, (N,); nan is 0."""
        self._per_min[:, :, PUMPS.index(pump)] = 60.0 * np.nan_to_num(rate)[:, None]

    def due(self, elapsed: Array, phase: NDArray[np.intp], rows: Mask) -> tuple[NDArray[np.intp], Array]:
        """Return the pump that feeds each reactor, 1, 3 or 4, and the dose of a spare pump, mL, each (N,).

        Args: elapsed: min since the schedule began; phase: its step; rows: where a dose may be decided, inside it.
        """
        n = elapsed.size
        if not self.any:
            return np.full(n, FEED_PUMP, dtype=np.intp), np.zeros(n)
        row, step = np.arange(n), np.maximum(phase, 0)
        passed = np.clip(np.nan_to_num(elapsed - self._supplied_at), 0.0, MADE_UP_MIN)
        new = phase != self._supplied_step
        owed = self.owed_ml + self._per_min[row, step] * passed[:, None]
        owed = np.where(new[:, None] & ~self._asked, self._once[row, step], owed)
        self.owed_ml = np.where(rows[:, None], owed, self.owed_ml)
        self._supplied_at = np.where(rows, elapsed, self._supplied_at)
        self._supplied_step = np.where(rows, phase, self._supplied_step)
        largest = self.owed_ml.argmax(axis=1)
        ml = self.owed_ml[row, largest]
        given = rows & (ml >= DOSE_ML - 1e-9)
        dose = np.where(given, ml / np.maximum(np.ceil(ml / self._most_ml - 1e-9), 1.0), 0.0)
        return np.where(given, np.array(PUMPS)[largest], FEED_PUMP).astype(np.intp), dose

    def given(self, pump: NDArray[np.intp], ml: Array) -> None:
        """Book what was begun by each reactor's pump, mL, (N,)."""
        for k, spare in enumerate(PUMPS):
            self.owed_ml[:, k] -= np.where(pump == spare, ml, 0.0)
