"""Predictions by a pair (mu, tau) of readings outside its fit, about an hour ahead each."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from envs.identification.drift import cuts, pairs
from envs.identification.model import pmse, start_level, trajectory
from envs.identification.prediction_error import Estimate, enough
from envs.identification.screening import OD_FLOOR, Screened, Series, pumped_volume

__all__ = ["Ahead", "Validation", "attainable_pct", "validate"]

Array = NDArray[np.float64]

START_READINGS = 5  # readings that set the start of a prediction and are not scored


AHEAD_MIN = (30.0, 60.0)
SLOPE_MIN = 20.0


@dataclass(frozen=True)
class Ahead:
    """How far n readings of the second half lie from what was expected so many minutes before, rms in % of the OD.

    model_pct: by the pair of the first half and the pump. od_stays_pct: by the OD then. same_slope_pct: by the growth
    of ln OD over the 20 min before.
    """

    minutes: float
    model_pct: float
    od_stays_pct: float
    same_slope_pct: float
    n: int


@dataclass(frozen=True)
class Validation:
    """PMSE of predictions, each from a fresh start every horizon, %; None without such readings.

    holdout_pct: the pair of the window's first 70 % on its last 30 %. early_pct: the same pair on its own rows.
    outside_pct: the returned pair on the trustworthy rows outside the window. ahead: the first half of all trustworthy
    rows predicts the second, beside two guesses; empty where the first half tells no pair.
    """

    holdout_pct: float | None
    early_pct: float | None
    holdout_n: int
    outside_pct: float | None
    outside_n: int
    ahead: tuple["Ahead", ...] = ()


def validate(screened: Screened, window: tuple[int, int], pair: tuple[float, float], horizon_min: float) -> Validation:
    """Score a pair (mu in 1/min, tau), and the pair of the window's first part."""
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
    halves = tuple(_ahead(screened))
    return Validation(late.pmse_pct, early.pmse_pct, len(late.od), outside.pmse_pct, len(outside.od), halves)


def _ahead(screened: Screened) -> Iterator[Ahead]:
    """Predict the second half by the pair of the first; a start is the median of five readings on its course."""
    clean = screened.series
    half = float(0.5 * (clean.time[0] + clean.time[-1]))
    before = clean.part(0, int(np.searchsorted(clean.time, half)))
    mu, tau = pairs([before])[0] if enough(before) else (None, None)
    seen = np.flatnonzero(clean.od > OD_FLOOR)
    if mu is None or tau is None or len(seen) < 2 * START_READINGS:
        return
    expected = mu.value * clean.time - pumped_volume(clean.time, clean.pump_rate) / tau.value
    time, expected, od = clean.time[seen], expected[seen], clean.od[seen]
    own = np.median(sliding_window_view(np.log(od) - expected, START_READINGS), axis=1)
    level = np.append(np.full(START_READINGS - 1, np.nan), own)
    stretch = np.searchsorted([first for first, _ in screened.stretches], seen, side="right")
    apart, rows = float(np.median(np.diff(time))), np.arange(len(time))
    earlier = np.searchsorted(time, time - SLOPE_MIN)
    slope = (level + expected - (level + expected)[earlier]) / np.maximum(time - time[earlier], apart)
    for minutes in AHEAD_MIN:
        to = np.minimum(np.searchsorted(time, time + minutes), len(time) - 1)
        off = np.abs(time[to] - time - minutes) > apart
        i = rows[(time >= half) & ~off & (stretch == stretch[to]) & np.isfinite(slope)]
        if len(i):
            j, now = to[i], (level + expected)[i]
            logs = now + expected[j] - expected[i], now, now + slope[i] * minutes
            model, stays, same = (100.0 * float(np.sqrt(np.mean(np.expm1(one - np.log(od[j])) ** 2))) for one in logs)
            yield Ahead(minutes, model, stays, same, len(i))


def attainable_pct(found: Estimate, part: Series, horizon_min: float) -> float:
    """Return the PMSE over a horizon caused by the disturbances of an estimate, %.

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
    """Readings and their predictions, shape (n,)."""

    od: Array
    predicted: Array

    @property
    def pmse_pct(self) -> float | None:
        """PMSE in %; None without scored readings."""
        return pmse(self.od, self.predicted) if len(self.od) else None


def _predictions(clean: Series, places: list[tuple[int, int]], pair: tuple[float, float], horizon: float) -> _Scored:
    """Run the model freely over the places, each horizon from a start set by its first five readings."""
    od, predicted = [np.empty(0)], [np.empty(0)]
    for part in (clean.part(*cut) for place in places for cut in cuts(clean, *place, horizon)):
        used = np.flatnonzero(np.isfinite(part.od))[START_READINGS:]
        if len(used) >= 2 * START_READINGS:
            model = trajectory(part.time, part.pump_rate, *pair, start_level(part, *pair, START_READINGS))
            od.append(part.od[used])
            predicted.append(model[used])
    return _Scored(np.concatenate(od), np.concatenate(predicted))
