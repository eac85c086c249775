"""Estimator and law in one, for tests of the loop: it reckons the share from the temperatures it is shown."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from envs.coculture.task import logit, share
from experiments.coculture.base import Array, Mask, ShareEstimate, Wanted
from tests.two_species import EQUAL_RATES_C, LAG_P_MIN, T_MAX, T_MIN, e_coli_rate, p_putida_rate


class Reckoning:
    """Exact on the nominal plant, whose rates it knows: x' = m_p - mu_e(T), with m_p behind mu_p(T) by an hour.

    It answers T = 33.2 - 20 (logit setpoint - x). Attributes: told_ml, all that it was told was dosed; looks, samples;
    half_width: of the band around the share that it claims.
    """

    remembers = ("x", "rate", "minute", "told_ml", "looks")

    def __init__(self, start: float = 0.5, half_width: float = 0.05) -> None:
        self.start, self.half_width = start, half_width

    def reset(self, n: int) -> None:
        self._x, self._rate = np.full(n, float(logit(self.start))), np.full(n, float(p_putida_rate(EQUAL_RATES_C)))
        self._minute, self.told_ml, self.looks = np.full(n, np.nan), np.zeros(n), np.zeros(n)

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        hours = np.where(rows & np.isfinite(self._minute), minute - self._minute, 0.0) / 60.0
        follow = -np.expm1(-60.0 * hours / LAG_P_MIN)
        self._rate = self._rate + np.where(rows, follow * (p_putida_rate(temperature) - self._rate), 0.0)
        self._x = self._x + np.where(rows, hours * (self._rate - e_coli_rate(temperature)), 0.0)
        self._minute = np.where(rows, minute, self._minute)
        self.looks = self.looks + rows

    def dosed(self, volume_ml: Array) -> None:
        self.told_ml = self.told_ml + volume_ml

    @property
    def begun(self) -> Mask:
        return np.isfinite(self._x)

    @property
    def known(self) -> Array:
        return np.where(np.isfinite(self._minute), self._minute, -np.inf)

    def retell(self, shown: Iterable[tuple[float, str, tuple[Any, ...]]]) -> None:
        """It forgets nothing."""

    def estimate(self) -> ShareEstimate:
        return ShareEstimate(
            self._x,
            np.zeros(self._x.size),
            np.full(self._x.size, EQUAL_RATES_C),
            self._rate,
            *np.zeros((3, self._x.size)),
        )

    def act(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        with np.errstate(invalid="ignore"):
            return np.clip(EQUAL_RATES_C - 20.0 * (logit(wanted.setpoint) - self._x), T_MIN, T_MAX)

    def explain(self) -> dict[str, Array]:
        r = share(self._x)
        band = {"ratio_low": r - self.half_width, "ratio_high": r + self.half_width}
        return {"ratio": r, **band, "bias_e": np.zeros(r.size), "bias_p": np.zeros(r.size)}
