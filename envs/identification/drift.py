"""Drift of mu and tau along a recording: separate fits of short segments, a line through their estimates, the window.

The window is the part of a recording to which one pair (mu, tau) is fitted.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from envs.identification.model import WIDEST, WORST_CONDITION, NotIdentifiable, Parameter
from envs.identification.noise_model import QUICK
from envs.identification.prediction_error import enough, estimate
from envs.identification.screening import FEWEST_READINGS, WEEK_MIN, Screened, Series

Array = NDArray[np.float64]
Pair = tuple[Parameter | None, Parameter | None]
Window = tuple[int, int]

NOTABLE_DRIFT_PCT = 10.0
WANDERING_PCT = 33.0
SHORTEST_WINDOW_MIN = 60.0
SUSPICION = 0.65  # fraction of a 95 % half width that gives the 80 % interval


@dataclass(frozen=True, eq=False)
class Segment:
    """Short part of a recording, rows [first, end), with its middle, min, and its estimates; None: not identifiable."""

    first: int
    end: int
    middle_min: float
    mu: Parameter | None
    tau: Parameter | None


@dataclass(frozen=True)
class Drift:
    """Weighted straight line through the segments' estimates of one parameter.

    first, last: value of the line at the first and last segment. change_pct: change from first to last.
    slope_per_h: slope with its 95 % interval. segments: number of estimates.
    """

    first: float
    last: float
    change_pct: float
    slope_per_h: Parameter
    segments: int

    @property
    def significant(self) -> bool:
        """Whether the interval of the slope excludes zero."""
        return self.slope_per_h.low > 0.0 or self.slope_per_h.high < 0.0

    @property
    def notable(self) -> bool:
        """Whether the drift is significant and changes the parameter by 10 % or more."""
        return self.significant and abs(self.change_pct) >= NOTABLE_DRIFT_PCT


def pairs(parts: list[Series]) -> list[Pair]:
    """Estimate (mu, tau) of each series; None if not identifiable. Without dilution tau is None."""
    found: list[Pair] = []
    for e in estimate(parts, QUICK) if parts else []:
        known = e.condition < WORST_CONDITION and _narrow(e.mu)
        found.append((e.mu, e.tau if e.tau is not None and _narrow(e.inverse_tau) else None) if known else (None, None))
    return found


def _narrow(p: Parameter) -> bool:
    return p.half_width <= WIDEST * abs(p.value)


def cuts(clean: Series, a: int, b: int, length: float) -> list[tuple[int, int]]:
    """Cut [a, b) into equal pieces of about `length` min."""
    if b - a < 2:
        return []
    span = clean.time[b - 1] - clean.time[a]
    n = max(1, round(float(span) / length))
    inner = np.searchsorted(clean.time[a:b], clean.time[a] + span * np.arange(1, n) / n) + a
    edges = [a, *(int(i) for i in inner), b]
    return list(pairwise(edges))


def pieces(screened: Screened, length: float) -> list[tuple[int, int]]:
    """Cut the stretches into pieces of about `length` min; drop those with too few readings for an estimate."""
    places = (place for stretch in screened.stretches for place in cuts(screened.series, *stretch, length))
    return [place for place in places if enough(screened.series.part(*place))]


def segments(screened: Screened, length: float) -> tuple[Segment, ...]:
    """Fit segments of about `length` min separately; if its pump never ran, a segment has an estimate of mu only."""
    places = pieces(screened, length)
    parts = [screened.series.part(*place) for place in places]
    return tuple(
        Segment(a, b, float(0.5 * (part.time[0] + part.time[-1])), mu, tau)
        for (a, b), part, (mu, tau) in zip(places, parts, pairs(parts), strict=True)
    )


def drifts(along: tuple[Segment, ...]) -> bool:
    """Return whether segments drift beyond chance: tau by 10 %, mu by a third, or mu by a third in one step.

    mu may change more because growth fluctuates in the model, and mu is its mean. The rule is stricter than that of a
    warning, because a window must not drift.
    """
    mu, tau = drift(along, [s.mu for s in along]), drift(along, [s.tau for s in along])
    return _steps([s.mu for s in along if s.mu is not None]) or any(
        line is not None
        and abs(line.change_pct) >= most
        and abs(line.slope_per_h.value) > SUSPICION * line.slope_per_h.half_width
        for line, most in ((mu, WANDERING_PCT), (tau, NOTABLE_DRIFT_PCT))
    )


def _steps(found: list[Parameter]) -> bool:
    """Return whether, at any segment, the means before and after it differ by a third and by more than chance.

    Estimates that are uncertain by more than a third are ignored, because at constant OD all such estimates are biased
    to the same side.
    """
    found = [p for p in found if p.half_width < WANDERING_PCT / 100.0 * p.value]
    value = np.array([p.value for p in found])
    weight = np.array([max(p.half_width / 1.96, 1e-3 * abs(p.value)) for p in found]) ** -2.0
    for j in range(1, len(found)):
        parts = slice(0, j), slice(j, None)
        before, after = (float(np.average(value[p], weights=weight[p])) for p in parts)
        misfit = sum(float(weight[p] @ (value[p] - m) ** 2) for p, m in zip(parts, (before, after), strict=True))
        spread = max(misfit / max(len(found) - 2, 1), 1.0) * sum(1.0 / float(weight[p].sum()) for p in parts)
        notable = WANDERING_PCT / 100.0 * 0.5 * abs(before + after)
        if abs(after - before) > max(notable, 1.96 * np.sqrt(spread)):
            return True
    return False


def drift(along: tuple[Segment, ...], values: list[Parameter | None]) -> Drift | None:
    """Fit a line to four or more estimates (else None), weighted by their intervals; scatter widens the interval."""
    from scipy.special import stdtrit

    known = [(s.middle_min, v) for s, v in zip(along, values, strict=True) if v is not None]
    if len(known) < 4:
        return None
    t = np.array([m for m, _ in known]) / 60.0
    y = np.array([v.value for _, v in known])
    sd = np.maximum(np.array([v.half_width for _, v in known]) / 1.96, 1e-3 * np.abs(y))
    weight = sd**-2.0
    middle, level = np.average(t, weights=weight), np.average(y, weights=weight)
    leverage = float(weight @ (t - middle) ** 2)
    steep = float(weight @ ((t - middle) * y)) / leverage
    misfit = float(weight @ (y - level - steep * (t - middle)) ** 2) / (len(t) - 2)
    half = float(stdtrit(len(t) - 2, 0.975) * np.sqrt(max(misfit, 1.0) / leverage))
    first, last = (float(level + steep * (end - middle)) for end in (t[0], t[-1]))
    slope = Parameter(steep, steep - half, steep + half)
    return Drift(first, last, 100.0 * (last / first - 1.0), slope, len(t))


def choose_window(screened: Screened, along: tuple[Segment, ...], segment_min: float) -> tuple[Window, str]:
    """Return positions [first, end) of the window with most readings, and the reason as text.

    A window consists of consecutive segments of one stretch, without drift, for at most a week. Windows are preferred
    if a segment identifies tau and dilution had an effect in every segment (`_failed`).
    Raises: NotIdentifiable without a window of at least an hour.
    """
    clean = screened.series
    failed = _failed(clean, along)
    apart = float(np.median(np.diff(clean.time)))
    if segment_min < FEWEST_READINGS * apart:
        raise NotIdentifiable(
            f"rows are {apart:.3g} min apart, so a segment of {segment_min:g} min has {segment_min / apart:.0f} rows; "
            f"allowed at least {FEWEST_READINGS}",
            f"check the unit of time, or set identify.segment_min={2 * FEWEST_READINGS * apart:.0f}",
        )
    count = np.concatenate([[0], np.cumsum(np.isfinite(clean.od))])
    best: Window | None = None
    most = (False, 0)
    for first, end in screened.stretches:
        inside = tuple(s for s in along if first <= s.first and s.end <= end)
        for i in range(len(inside)):
            for j in range(len(inside), i, -1):
                part, a, b = inside[i:j], inside[i].first, inside[j - 1].end
                lasts = SHORTEST_WINDOW_MIN <= _minutes(clean, a, b) <= WEEK_MIN
                tells = any(s.tau is not None for s in part) and not any(s in failed for s in part)
                size = tells, int(count[b] - count[a])
                if lasts and size > most and not drifts(part):
                    best, most = (a, b), size
    if best is None:
        a, b = longest(screened)
        raise NotIdentifiable(
            f"the longest trustworthy stretch, rows {clean.row[a]}-{clean.row[b - 1]}, lasts "
            f"{_minutes(clean, a, b):.0f} min; allowed at least {SHORTEST_WINDOW_MIN:.0f} min",
            "record for longer",
        )
    if best in screened.stretches:
        return best, "all trustworthy rows" if len(screened.stretches) == 1 else "the longest part without a pause"
    follows = [s for s in along if s.first == best[1]]
    capped = any(_minutes(clean, best[0], s.end) > WEEK_MIN for s in follows)
    return best, "the longest part without drift" + (", limited to a week" if capped else "")


def _failed(clean: Series, along: tuple[Segment, ...]) -> list[Segment]:
    """Find segments without an estimate of tau among those with at least the median pump rate, if most have one.

    In these segments the recorded pumping did not dilute: the feed failed or the culture collapsed.
    """
    pumped = [float(clean.pump_rate[s.first : s.end].mean()) for s in along]
    busy = [s for s, rate in zip(along, pumped, strict=True) if rate >= np.median(pumped) and rate > 0.0]
    silent = [s for s in busy if s.tau is None]
    return silent if 2 * len(silent) < len(busy) else []


def longest(screened: Screened) -> Window:
    """Return the stretch with the most readings."""
    return max(screened.stretches, key=lambda s: np.isfinite(screened.series.od[s[0] : s[1]]).sum())


def _minutes(clean: Series, a: int, b: int) -> float:
    return float(clean.time[b - 1] - clean.time[a])
