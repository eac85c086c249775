"""A program of shares over time: steps, or a sine, and what of it is announced."""

from collections.abc import Sequence

import numpy as np

from experiments.composition.base import Array, Wanted

__all__ = ["Program"]


class Program:
    """Setpoints of the share, min since the program began.

    Args: ratios: one per phase, None or nan where none is asked for. minutes: length of each phase. sine: mean,
      amplitude, period in min, in place of the ratios: mean + amplitude sin(2 pi t / period).
    """

    def __init__(self, ratios: Sequence[float | None], minutes: Sequence[float], sine: Sequence[float] = ()) -> None:
        self._sine = tuple(sine)
        given = list(ratios) or [np.nan] * len(minutes)
        self._ratios = np.array([np.nan if r is None else r for r in given], dtype=np.float64)
        self._edges = np.cumsum(np.asarray(minutes, dtype=np.float64))

    def at(self, minute: Array) -> Array:
        """Setpoint in force, nan where none is."""
        if self._sine:
            mean, amplitude, period = self._sine
            return np.asarray(mean + amplitude * np.sin(2.0 * np.pi * minute / period))
        return np.asarray(self._ratios[self._phase(minute)])

    def _phase(self, minute: Array) -> np.ndarray:
        phase = np.searchsorted(self._edges, np.nan_to_num(minute) + 1e-9, side="right")
        return np.asarray(np.minimum(phase, self._ratios.size - 1))

    def wanted(self, minute: Array, preview_min: float) -> Wanted:
        """What is asked for at each minute, and the change that is announced so far ahead, (N,)."""
        now = self.at(minute)
        if self._sine:
            return Wanted(now, self.at(minute + preview_min), np.full(now.shape, preview_min))
        phase = self._phase(minute)
        after = np.minimum(phase + 1, self._ratios.size - 1)
        left = self._edges[phase] - np.nan_to_num(minute)
        told = (after > phase) & (left <= preview_min) & np.isfinite(self._ratios[after])
        return Wanted(now, np.where(told, self._ratios[after], now), np.where(told, left, 0.0))
