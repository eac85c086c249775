"""How mu and tau wander along a recording: short segments fitted alone, and a line through their estimates."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from envs.identification.free_run import fit
from envs.identification.model import NotIdentifiable, Parameter, check_excitation
from envs.identification.prediction_error import QUICK, WORST_CONDITION, enough, estimate
from envs.identification.screening import Screened, Series

__all__ = ["Drift", "Segment", "cuts", "drift", "drifts", "pairs", "segments"]

Array = NDArray[np.float64]
Pair = tuple[Parameter | None, Parameter | None]

NOTABLE_DRIFT_PCT = 10.0
WANDERING_PCT = 33.0
SUSPICION = 0.65  # of a 95 % half width: the 80 % interval
WIDEST = 1.0  # half width of an estimate over its value; what is wider tells nothing of a drift


@dataclass(frozen=True, eq=False)
class Segment:
    """A short fit of its own: positions [first, end), its middle in min, and what it gave; None = not identifiable."""

    first: int
    end: int
    middle_min: float
    mu: Parameter | None
    tau: Parameter | None


@dataclass(frozen=True)
class Drift:
    """Weighted straight line through the segments' estimates of one parameter.

    first, last: the line at the first and the last segment. change_pct: between them.
    slope_per_h with its 95 % interval; significant when that excludes zero.
    """

    first: float
    last: float
    change_pct: float
    slope_per_h: Parameter
    segments: int

    @property
    def significant(self) -> bool:
        """True when the slope's interval excludes zero."""
        return self.slope_per_h.low > 0.0 or self.slope_per_h.high < 0.0


def pairs(parts: list[Series], method: str) -> list[Pair]:
    """(mu, tau) of each series by `method`, None for what it does not show; a series without dilution gives mu only."""
    if method == "free_run":
        return [_free_run(part) for part in parts]
    found: list[Pair] = []
    for e in estimate(parts, QUICK):
        known = e.condition < WORST_CONDITION and _narrow(e.mu)
        found.append((e.mu, e.tau if e.tau is not None and _narrow(e.inverse_tau) else None) if known else (None, None))
    return found


def _narrow(p: Parameter) -> bool:
    return p.half_width <= WIDEST * abs(p.value)


def _free_run(part: Series) -> Pair:
    try:
        if (part.pump_rate[:-1] > 0.0).any():
            check_excitation(part)
        found = fit(part)
    except NotIdentifiable:
        return None, None
    return found.mu, found.tau


def cuts(clean: Series, a: int, b: int, length: float) -> list[tuple[int, int]]:
    """[a, b) cut into equal pieces of about `length` min."""
    if b - a < 2:
        return []
    span = clean.time[b - 1] - clean.time[a]
    n = max(1, round(float(span) / length))
    inner = np.searchsorted(clean.time[a:b], clean.time[a] + span * np.arange(1, n) / n) + a
    edges = [a, *(int(i) for i in inner), b]
    return list(pairwise(edges))


def segments(screened: Screened, length: float, method: str) -> tuple[Segment, ...]:
    """Independent fits along the recording, of about `length` min; a segment whose pump never ran gives mu alone."""
    clean = screened.series
    places = [place for first, end in screened.stretches for place in cuts(clean, first, end, length)]
    places = [(a, b) for a, b in places if enough(clean.part(a, b))]
    parts = [clean.part(a, b) for a, b in places]
    found = pairs(parts, method) if parts else []
    return tuple(
        Segment(a, b, float(0.5 * (part.time[0] + part.time[-1])), mu, tau)
        for (a, b), part, (mu, tau) in zip(places, parts, found, strict=True)
    )


def drifts(along: tuple[Segment, ...], method: str) -> bool:
    """True when mu or tau of the segments move notably, beyond their 80 % interval.

    Notable is 10 %; for mu by prediction_error a third, since there growth that wanders is part of the model and mu its
    mean over the rows. Less certainty than for a warning: a window that may drift is not to be trusted.
    """
    mu_pct = NOTABLE_DRIFT_PCT if method == "free_run" else WANDERING_PCT
    lines = ((drift(along, [s.mu for s in along]), mu_pct), (drift(along, [s.tau for s in along]), NOTABLE_DRIFT_PCT))
    return any(
        d is not None
        and abs(d.change_pct) >= notable
        and abs(d.slope_per_h.value) > SUSPICION * d.slope_per_h.half_width
        for d, notable in lines
    )


def drift(along: tuple[Segment, ...], values: list[Parameter | None]) -> Drift | None:
    """Line through at least four estimates, weighted by their intervals; scatter beyond them widens the slope's."""
    known = [(s.middle_min, v) for s, v in zip(along, values, strict=True) if v is not None]
    if len(known) < 4:
        return None
    t = np.array([m for m, _ in known]) / 60.0
    y = np.array([v.value for _, v in known])
    sd = np.maximum(np.array([v.half_width for _, v in known]) / 2.0, 1e-3 * np.abs(y))
    columns = np.stack([np.ones_like(t), t], axis=1) / sd[:, None]
    normal = columns.T @ columns
    line = np.linalg.solve(normal, columns.T @ (y / sd))
    misfit = float(np.sum((y / sd - columns @ line) ** 2)) / (len(t) - 2)
    half = 2.0 * float(np.sqrt(np.linalg.inv(normal)[1, 1] * max(misfit, 1.0)))
    first, last = float(line[0] + line[1] * t[0]), float(line[0] + line[1] * t[-1])
    slope = Parameter(float(line[1]), float(line[1]) - half, float(line[1]) + half)
    return Drift(first, last, 100.0 * (last / first - 1.0), slope, len(t))
