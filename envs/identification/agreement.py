"""Comparison of a run with its model: growth rate, pump gain and predictions, and since when the model was wrong.

The model is the pair (mu, tau) with which a run was planned. Each segment of the run is compared with the model in
three ways: by the growth rate, by the pump gain (both estimated from this segment alone), and by the mean error of
predictions one row ahead,

    e_i = ln y_{i+1} - ln y_i - (mu - u_i/tau) dt_i.

This error shows a wrong mu - u/tau even if a regulated culture does not identify mu and tau separately. Its interval is
narrow, so one wrong segment is enough. Growth or gain needs two in a row, because one in twenty is wrong by chance.
"""

from dataclasses import dataclass
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from envs.identification.calibration import IdentifyConfig
from envs.identification.drift import NOTABLE_DRIFT_PCT, SHORTEST_WINDOW_MIN, Drift, Segment, cuts, drift, segments
from envs.identification.model import MIN_READINGS, Parameter
from envs.identification.screening import OD_FLOOR, Screened, Series, screen

Array = NDArray[np.float64]

LAGS = 10  # rows over which the errors e may be correlated; the noise of a reading enters two of them


@dataclass(frozen=True)
class Compared:
    """Estimates of one parameter in the segments of a run, and the model's value.

    first_min, end_min: start and end of each segment. found: its estimate, None if not identifiable. expected: the
    model's value. scale: value that counts as 100 %. segments: number of segments in a row that must contradict the
    model. line: straight line through the estimates, None if there are too few."""

    name: str
    first_min: tuple[float, ...]
    end_min: tuple[float, ...]
    found: tuple[Parameter | None, ...]
    expected: float
    scale: float
    segments: int = 2
    line: Drift | None = None

    @property
    def left_min(self) -> float | None:
        """Minute from which the model's value is wrong up to the end; None if for fewer than `segments` segments.

        The value is wrong in a segment if the interval excludes it and the estimate differs by 10 % or more.
        """
        known = [(t, p) for t, p in zip(self.first_min, self.found, strict=True) if p is not None]
        outside = list(takewhile(lambda tp: self._wrong(tp[1]), reversed(known)))
        return outside[-1][0] if len(outside) >= self.segments else None

    def _wrong(self, found: Parameter) -> bool:
        return not found.low <= self.expected <= found.high and abs(self.off_pct(found)) >= NOTABLE_DRIFT_PCT

    def off_pct(self, found: Parameter) -> float:
        """Return the estimate minus the model's value, in per cent of the scale."""
        return 100.0 * (found.value - self.expected) / self.scale

    @property
    def latest(self) -> Parameter | None:
        """Estimate of the last segment that has one."""
        return next((p for p in reversed(self.found) if p is not None), None)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Result of the comparison of a run with its model.

    growth: mu, 1/min. gain: pump flow relative to the model, tau_model/tau. net: mean of e per minute, 1/min.
    predicted: OD predicted from the row before, nan without prediction, (n,). rms: rms error of `predicted`, OD.
    attainable: rms error without each segment's mean error, OD. minutes: from first to last trustworthy reading.
    """

    series: Series
    growth: Compared
    gain: Compared
    net: Compared
    predicted: Array
    rms: float
    attainable: float
    minutes: float

    @property
    def left(self) -> list[Compared]:
        """Parameters that are wrong at the end of the run, sorted by the minute since which they are wrong."""
        found = [c for c in (self.growth, self.gain, self.net) if c.left_min is not None]
        return sorted(found, key=lambda c: c.left_min or 0.0)

    def verdict(self, planned: bool = True) -> str:
        """Return a sentence: whether to calibrate again, and why.

        Args: planned: whether the run used a calibrated model. Only then is a new calibration recommended.
        """
        if self.minutes < SHORTEST_WINDOW_MIN:
            return (
                f"Too short for a comparison: {self.minutes:.0f} min of trustworthy readings, at least "
                f"{SHORTEST_WINDOW_MIN:.0f} are needed."
            )
        if self.left:
            head = "Recalibrate: " if planned else f"{UNUSED}, but its culture differs from the model: "
            return f"{head}{'; '.join(_words(c) for c in self.left)}{self._which()}."
        unknown = " and ".join(c.name for c in (self.growth, self.gain) if c.latest is None)
        but = f"; these readings alone do not determine {unknown}" if unknown else ""
        head = "No need to recalibrate: " if planned else f"{UNUSED}: "
        return f"{head}the model was right to the end of the run{but}."

    def _which(self) -> str:
        """Return the two possible causes if only mu - u/tau is known to be wrong."""
        if self.left != [self.net] or self.net.latest is None:
            return ""
        faster, weaker = ("faster", "weaker") if self.net.latest.value > 0.0 else ("slower", "stronger")
        return f"; either the culture grows {faster} or the pump is {weaker}, and this run alone does not show which"


UNUSED = "This run needs no calibration"


def _words(c: Compared) -> str:
    assert c.left_min is not None
    assert c.latest is not None
    since = "throughout" if c.left_min <= c.first_min[0] else f"since hour {c.left_min / 60.0:.1f}"
    return f"{c.name} is off by 10 % or more {since}, by {c.off_pct(c.latest):+.0f} % at the end"


def agreement(raw: Series, mu: float, tau: float) -> Agreement:
    """Compare a run with the model (mu in 1/min, tau) with which it was planned.

    Raises: ValueError when no trustworthy readings are left.
    """
    screened, every = screen(raw), IdentifyConfig().segment_min
    clean = screened.series
    along = segments(screened, every)
    used = np.flatnonzero(np.isfinite(clean.od))
    log_change, error = _one_ahead(clean, screened, mu, tau)
    predicted = np.full(len(clean.od), np.nan)
    predicted[1:] = clean.od[:-1] * np.exp(log_change)
    pieces = [p for first, end in screened.stretches for p in cuts(clean, first, end, every)]
    means, left = [], np.full(len(error), np.nan)
    for a, b in pieces:
        means.append(_mean(error[a : b - 1], clean.time[a:b]))
        left[a : b - 1] = error[a : b - 1] - np.nanmean(error[a : b - 1]) if means[-1] else error[a : b - 1]
    times = (tuple(float(clean.time[a]) for a, _ in pieces), tuple(float(clean.time[b - 1]) for _, b in pieces))
    taus = [s.tau for s in along]
    gains = [None if t is None else Parameter(tau / t.value, tau / t.high, tau / t.low) for t in taus]
    return Agreement(
        series=clean,
        growth=_of_segments("growth", clean, along, [s.mu for s in along], mu),
        gain=_of_segments("the pump's gain", clean, along, gains, 1.0),
        net=Compared("the predicted net growth", *times, tuple(means), 0.0, mu, segments=1),
        predicted=predicted,
        rms=_rms(clean.od[1:] * -np.expm1(-error)),
        attainable=_rms(clean.od[1:] * -np.expm1(-left)),
        minutes=float(clean.time[used[-1]] - clean.time[used[0]]),
    )


def _one_ahead(clean: Series, screened: Screened, mu: float, tau: float) -> tuple[Array, Array]:
    """Return the predicted change of ln y from row to row, and e, which is nan unless one stretch has both readings."""
    step = np.diff(clean.time)
    predicted = (mu - clean.pump_rate[:-1] / tau) * step
    log_od = np.log(np.where(clean.od > OD_FLOOR, clean.od, np.nan))
    error = np.diff(log_od) - predicted
    for _, end in screened.stretches:
        if end - 1 < len(error):
            error[end - 1] = np.nan
    return predicted, error


def _mean(error: Array, time: Array) -> Parameter | None:
    """Return the mean of e per minute, with 95 % interval (Newey, West 1987, Econometrica 55:703); else None."""
    seen = np.isfinite(error)
    n = int(seen.sum())
    if n < MIN_READINGS:
        return None
    rate = float(np.mean(np.diff(time)))
    mean = float(error[seen].mean())
    centred = np.where(seen, error - mean, 0.0)
    moments = [float(centred[lag:] @ centred[: len(centred) - lag]) / n for lag in range(LAGS + 1)]
    variance = moments[0] + 2.0 * sum((1.0 - k / (LAGS + 1)) * m for k, m in enumerate(moments) if k > 0)
    half = 1.96 * float(np.sqrt(max(variance, 0.05 * moments[0]) / n))
    return Parameter(mean / rate, (mean - half) / rate, (mean + half) / rate)


def _of_segments(
    name: str, clean: Series, along: tuple[Segment, ...], found: list[Parameter | None], expected: float
) -> Compared:
    first = tuple(float(clean.time[s.first]) for s in along)
    end = tuple(float(clean.time[s.end - 1]) for s in along)
    return Compared(name, first, end, tuple(found), expected, expected, line=drift(along, found))


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
