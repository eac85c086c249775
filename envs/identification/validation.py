"""How a pair (mu, tau) predicts readings that it was not fitted to, an hour or so ahead each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.drift import cuts, pairs
from envs.identification.model import pmse, start_level, trajectory
from envs.identification.prediction_error import Estimate, enough
from envs.identification.screening import Screened, Series

__all__ = ["Validation", "attainable_pct", "validate"]

Array = NDArray[np.float64]

START_READINGS = 5  # that set the start of a prediction and are not scored


@dataclass(frozen=True)
class Validation:
    """PMSE of predictions, each from a fresh start every horizon, %; None where there are no such readings.

    holdout_pct: the pair of the window's first 70 % on its last 30 %. early_pct: the same pair on its own rows.
    outside_pct: the returned pair on the trustworthy rows outside the window.
    """

    holdout_pct: float | None
    early_pct: float | None
    holdout_n: int
    outside_pct: float | None
    outside_n: int


def validate(screened: Screened, window: tuple[int, int], pair: tuple[float, float], horizon_min: float) -> Validation:
    """Score a pair (mu in 1/min, tau), and the one that the window's first part gives."""
    clean, (a, b) = screened.series, window
    cut = a + int(0.7 * (b - a))
    before = clean.part(a, cut)
    mu, tau = pairs([before])[0] if enough(before) else (None, None)
    late = early = _Scored(np.empty(0), np.empty(0))
    if mu is not None and tau is not None:
        late = _predictions(clean, [(cut, b)], (mu.value, tau.value), horizon_min)
        early = _predictions(clean, [(a, cut)], (mu.value, tau.value), horizon_min)
    sides = [(first, min(end, a)) for first, end in screened.stretches]
    sides += [(max(first, b), end) for first, end in screened.stretches]
    outside = _predictions(clean, sides, pair, horizon_min)
    return Validation(late.pmse_pct, early.pmse_pct, len(late.od), outside.pmse_pct, len(outside.od))


def attainable_pct(found: Estimate, part: Series, horizon_min: float) -> float:
    """PMSE over a horizon that the disturbances of an estimate make by themselves, %.

    Doses off by e_i leave the sum of k c_i e_i in ln x, growth off by w over the horizon H leaves w t:
    100 (half the variance of all doses in H + (mu w H)^2 / 3).
    """
    volume = part.pump_rate[:-1] * np.diff(part.time) * found.inverse_tau.value
    rows = horizon_min / float(np.median(np.diff(part.time)))
    doses = 0.5 * rows * float(np.mean(volume**2)) * found.quality.dose_spread.value**2
    growth = (found.mu.value * found.quality.growth_spread.value * horizon_min) ** 2 / 3.0
    return 100.0 * (doses + growth)


@dataclass(frozen=True, eq=False)
class _Scored:
    """Readings and what was predicted for them, shape (n,)."""

    od: Array
    predicted: Array

    @property
    def pmse_pct(self) -> float | None:
        """None where nothing was scored."""
        return pmse(self.od, self.predicted) if len(self.od) else None


def _predictions(clean: Series, places: list[tuple[int, int]], pair: tuple[float, float], horizon: float) -> _Scored:
    """Free runs over the places, each horizon from a start of its own that its first five readings set."""
    od, predicted = [np.empty(0)], [np.empty(0)]
    for part in (clean.part(*cut) for place in places for cut in cuts(clean, *place, horizon)):
        used = np.flatnonzero(np.isfinite(part.od))[START_READINGS:]
        if len(used) >= 2 * START_READINGS:
            model = trajectory(part.time, part.pump_rate, *pair, start_level(part, *pair, START_READINGS))
            od.append(part.od[used])
            predicted.append(model[used])
    return _Scored(np.concatenate(od), np.concatenate(predicted))
