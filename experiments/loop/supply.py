"""Choice of the pump that gives the next dose: the feed pump, or a spare pump with a volume due.

Each sample has at most one dose, from one pump, so two pumps never feed at the same time. A spare pump's dose passes
interlock, ledger and waste control like any other dose, and replaces the controller's dose of that sample. The
controller compensates at the next samples, because it sees the OD.
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

    Args: schedules: one per reactor. most_ml: largest dose, mL. asked: pumps that a signal commands.
    Attributes: any: whether these pumps are used. owed_ml: due volume, mL, (N, 2). remembers: saved attributes.
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
        """Set the rate of a pump that a signal commands. Args: rate: mean rate, mL/s, (N,); nan means 0."""
        self._per_min[:, :, PUMPS.index(pump)] = 60.0 * np.nan_to_num(rate)[:, None]

    def due(self, elapsed: Array, phase: NDArray[np.intp], rows: Mask) -> tuple[NDArray[np.intp], Array]:
        """Return the pump of each reactor's next dose (1, 3 or 4), and the dose of a spare pump, mL, (N,) each.

        Args: elapsed: min since the schedule began. phase: step of the schedule. rows: reactors that may get a dose.
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
        """Subtract doses from the due volumes. Args: pump: number of each reactor's pump, (N,). ml: its dose, (N,)."""
        for k, spare in enumerate(PUMPS):
            self.owed_ml[:, k] -= np.where(pump == spare, ml, 0.0)
