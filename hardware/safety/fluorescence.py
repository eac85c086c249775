"""Validity of single fluorescence readings: whether a working sensor can give them."""

import math

import numpy as np

from hardware.reactor import Array, Mask, Measurement
from hardware.safety import messages
from hardware.safety.config import RAW_MAX, SafetyConfig
from hardware.safety.readings import Finding


class Light:
    """Plausibility of the newest fluorescence of N reactors, if it is measured; no dose depends on it."""

    remembers = ("_light", "_light_repeats", "_light_s")

    def __init__(self, n: int, config: SafetyConfig) -> None:
        self._config = config
        self._light = np.full(n, math.nan)  # the newest reading, valid or not
        self._light_repeats = np.zeros(n)  # samples in a row that were equal to the one before
        self._light_s = np.full(n, math.nan)  # time of the last valid reading, or of the first check

    def check(self, m: Measurement, now: float) -> list[Finding]:
        """Find what is wrong with the fresh readings of `m`; `now`: run time, s."""
        if m.fluorescence is None:
            return []
        counts, fresh = m.fluorescence, np.asarray(m.fresh, dtype=np.bool_)
        believed, repeats = self._judge(counts, fresh)
        self._light, self._light_repeats = np.where(fresh, counts, self._light), repeats
        self._light_s = np.where(believed | (fresh & np.isnan(self._light_s)), now, self._light_s)
        minutes = (now - self._light_s) / 60.0
        lost = fresh & (minutes > self._config.light_lost)
        return [
            Finding(
                messages.FluorescenceFault, fresh & ~believed & ~lost, {"counts": counts, "samples": repeats + 1.0}
            ),
            Finding(messages.FluorescenceLostFault, lost, {"minutes": minutes, "counts": counts}),
        ]

    def believed(self, m: Measurement) -> Array | None:
        """Return valid fresh counts, nan for all others, shape (N,); None if none are measured."""
        if m.fluorescence is None:
            return None
        believed, _ = self._judge(m.fluorescence, np.asarray(m.fresh, dtype=np.bool_))
        return np.where(believed, m.fluorescence, np.nan)

    def _judge(self, counts: Array, fresh: Mask) -> tuple[Mask, Array]:
        """Return the valid fresh rows, and the number of equal samples in a row of all rows."""
        c = self._config
        repeats = np.where(fresh, np.where(counts == self._light, self._light_repeats + 1, 0), self._light_repeats)
        inside = (counts >= c.light_min) & (counts <= RAW_MAX)  # not nan
        return np.asarray(fresh & inside & (repeats < c.frozen_light - 1), dtype=np.bool_), repeats
