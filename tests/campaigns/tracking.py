"""The true OD of cultures against what is asked of them: how far it strays, how long, how soon it is back.

Nobody can ask more than growth and pump allow, so the reference moves towards the setpoint x* at most as fast as a
culture grows undiluted and as full dilution thins it: x_ref' in [mu - D_max, mu] x_ref.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BAND_OD", "DILUTION", "FIRST_DOSE_MIN", "GROWTH", "OVERGROWN", "STEP_OD", "TOP_OD", "Tracking", "outage",
    "reachable", "undosed",
]  # fmt: skip

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GROWTH, DILUTION = 0.025, 0.06  # 1/min: the emulator's healthy culture, and the largest feed rate over volume
BAND_OD = 0.06
"""A healthy closed loop holds its culture so close: sensor noise, dose spread and a minute between doses."""
FIRST_DOSE_MIN = 4.0
"""From the end of a fault to the first dose: an old cycle ends (65 s), the first of a restarted experiment brings its
sample (75 s), a dose and its effect follow within a minute."""
OVERGROWN = 4.0  # OD; the plant would grow on, a real culture and its sensor do not
TOP_OD = 0.8  # the densest setpoint that is rehearsed by default
STEP_OD = 0.15  # and how far it falls at once


def undosed(minutes: float, od: float = TOP_OD) -> float:
    """Largest error, OD, of a culture held at `od` that gets no dose for so long: x* (e^(mu t) - 1), and the band."""
    return od * math.expm1(GROWTH * minutes) + BAND_OD


def outage(minutes: float) -> float:
    """`undosed` for a fault that lasts so long, and until the first dose after it."""
    return undosed(minutes + FIRST_DOSE_MIN)


def reachable(reference: Array, asked: Array, minutes: float) -> Array:
    """Where a culture can be after `minutes` that stood at `reference` and is asked to be at `asked`; OD, (N,)."""
    low, high = math.exp((GROWTH - DILUTION) * minutes), math.exp(GROWTH * minutes)
    return np.clip(asked, reference * low, reference * high)


@dataclass(eq=False)
class Tracking:
    """N cultures watched from the first look on.

    Args: band: largest error, OD, of a culture that is held, (N,); of one denser than `TOP_OD`, in proportion.
    Attributes: counting, whether errors count for `peak`. Each (N,): peak, largest error; out_min, time of the last
      look outside the band, min after `restart`, 0 if there was none; outside, whether the last look was; watched_min,
      time of the last look; away_min, for how long the error has been outside the band, measured against what the
      schedule asks.
    """

    band: Array

    def __post_init__(self) -> None:
        n = self.band.size
        self._at = math.nan
        self._asked_for = np.full(n, math.nan)  # from where the schedule found the culture
        self._left_at = np.full(n, math.nan)  # from where a fault left it
        self._since = math.inf
        self.counting = False
        self.peak, self.out_min, self.watched_min, self.away_min = (np.zeros(n) for _ in range(4))
        self.outside = np.zeros(n, dtype=np.bool_)

    def restart(self, minute: float) -> None:
        """A fault is over: what matters is what can be reached from where the culture is `FIRST_DOSE_MIN` later."""
        self._since, self._left_at = minute, np.full(self.band.size, math.nan)
        self.out_min, self.watched_min = np.zeros(self.band.size), np.zeros(self.band.size)
        self.outside = np.zeros(self.band.size, dtype=np.bool_)

    def look(self, minute: float, asked: Array, od: Array, rows: Mask) -> None:
        """Args: minute: now. asked: setpoints, od: true ODs, OD, (N,). rows: cultures that are to be held, (N,)."""
        passed, self._at = minute - self._at, minute
        if math.isnan(passed):
            self._asked_for = od.copy()
            passed = 0.0
        self._asked_for = reachable(self._asked_for, asked, passed)
        self._left_at = reachable(self._left_at, asked, passed)
        error = np.minimum(np.abs(od - self._asked_for), OVERGROWN)
        self.away_min = np.where(rows & (error > self.band), self.away_min + passed, 0.0)
        if self.counting:
            self.peak = np.where(rows, np.maximum(self.peak, error), self.peak)
        if minute >= self._since + FIRST_DOSE_MIN:
            self._left_at = np.where(np.isnan(self._left_at), od, self._left_at)
            band = self.band * np.maximum(self._left_at / TOP_OD, 1.0)  # a minute's dose is a fraction of the OD
            self.outside = np.where(rows, np.abs(od - self._left_at) > band, self.outside)
            self.watched_min = np.where(rows, minute - self._since, self.watched_min)
            self.out_min = np.where(rows & self.outside, minute - self._since, self.out_min)

    @property
    def recovery_min(self) -> Array:
        """Minutes after `restart` from which on the error stayed inside the band; inf if it never did, (N,)."""
        return np.where(self.outside, math.inf, self.out_min)
