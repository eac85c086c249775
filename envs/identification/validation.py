"""Validation: predictions with a pair (mu, tau) of readings that were not fitted, about an hour ahead."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from envs.identification.drift import cuts, pairs
from envs.identification.model import pmse, trajectory
from envs.identification.prediction_error import Estimate, enough
from envs.identification.screening import OD_FLOOR, Screened, Series, pumped_volume

Array = NDArray[np.float64]

START_READINGS = 5  # readings that determine the start of a prediction; they are not scored
AHEAD_MIN = (30.0, 60.0)
SLOPE_MIN = 20.0


@dataclass(frozen=True)
class Ahead:
    """RMS errors, % of OD, of predictions made `minutes` before each of n readings in the second half.

    model_pct: predicted by the model fitted to the first half. od_stays_pct: by a constant OD. same_slope_pct: by a
    constant slope of ln OD, that of the 20 min before."""

    minutes: float
    model_pct: float
    od_stays_pct: float
    same_slope_pct: float
    n: int


@dataclass(frozen=True)
class Validation:
    """PMSE of predictions, which start anew after each horizon, %; None without readings to predict.

    holdout_pct: the pair of the window's first 70 % predicts its last 30 %. early_pct: the same pair predicts the 70 %.
    outside_pct: the returned pair predicts the trustworthy rows outside the window. holdout_n, outside_n: number of
    predicted readings. ahead: the first half predicts the second; empty if the first half does not identify a pair.
    """

    holdout_pct: float | None
    early_pct: float | None
    holdout_n: int
    outside_pct: float | None
    outside_n: int
    ahead: tuple["Ahead", ...] = ()


def validate(screened: Screened, window: tuple[int, int], pair: tuple[float, float], horizon_min: float) -> Validation:
    """Score the predictions of a pair (mu in 1/min, tau), and of the pair fitted to the window's first 70 %."""
    clean, (a, b) = screened.series, window
    cut = a + int(0.7 * (b - a))
    first = _pair(clean.part(a, cut))
    (late, n), (early, _) = (
        (None, 0) if first is None else _scored(clean, [place], first, horizon_min) for place in ((cut, b), (a, cut))
    )
    sides = [(low, min(high, a)) for low, high in screened.stretches]
    sides += [(max(low, b), high) for low, high in screened.stretches]
    return Validation(late, early, n, *_scored(clean, sides, pair, horizon_min), tuple(_ahead(screened)))


def _ahead(screened: Screened) -> Iterator[Ahead]:
    """Predict the second half with the pair of the first half; a prediction starts at the median of five readings."""
    clean = screened.series
    half = float(0.5 * (clean.time[0] + clean.time[-1]))
    pair = _pair(clean.part(0, int(np.searchsorted(clean.time, half))))
    seen = np.flatnonzero(clean.od > OD_FLOOR)
    if pair is None or len(seen) < 2 * START_READINGS:
        return
    expected = pair[0] * clean.time - pumped_volume(clean.time, clean.pump_rate) / pair[1]
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
    """Return the PMSE over a horizon that the disturbances of an estimate cause, %.

    Relative errors e_i of the doses add sum k c_i e_i to ln x; an error w of growth over the horizon H adds mu w t. The
    PMSE is 100 (half the variance by all doses in H + (mu w H)^2 / 3).
    """
    volume = part.pump_rate[:-1] * np.diff(part.time) * found.inverse_tau.value
    rows = horizon_min / float(np.median(np.diff(part.time)))
    doses = 0.5 * rows * float(np.mean(volume**2)) * found.quality.dose_spread.value**2
    growth = (found.mu.value * found.quality.growth_spread.value * horizon_min) ** 2 / 3.0
    return 100.0 * (doses + growth)


def _scored(
    clean: Series, places: list[tuple[int, int]], pair: tuple[float, float], horizon: float
) -> tuple[float | None, int]:
    """Return PMSE, %, and number of readings of free runs; each starts from the first five readings of a horizon."""
    od, predicted = [np.empty(0)], [np.empty(0)]
    for part in (clean.part(*cut) for place in places for cut in cuts(clean, *place, horizon)):
        seen = np.flatnonzero(np.isfinite(part.od))
        if len(seen) >= 3 * START_READINGS:
            model = trajectory(part.time, part.pump_rate, *pair, 1.0)[seen]
            readings = part.od[seen]
            model *= np.median((readings / model)[:START_READINGS])
            od.append(readings[START_READINGS:])
            predicted.append(model[START_READINGS:])
    scored = np.concatenate(od)
    return (pmse(scored, np.concatenate(predicted)) if len(scored) else None), len(scored)


def _pair(part: Series) -> tuple[float, float] | None:
    """Estimate the pair (mu, tau) of a series; None if it is not identifiable."""
    mu, tau = pairs([part])[0] if enough(part) else (None, None)
    return None if mu is None or tau is None else (mu.value, tau.value)
