"""Growth and pigment of one strain as functions of temperature, from recordings at constant temperatures."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.model import Parameter
from envs.identification.screening import Series, screen

Array = NDArray[np.float64]

HELD_C = 0.5  # degC; a temperature within this of its mean so far counts as constant
WIDEST, LEAST_WIDTH = 0.2, 0.03  # largest half width of a growth rate: relative, or in 1/h if that is larger
WORTH_A_WORD_MIN = 30.0  # ignored stretches of this length or more are reported
SATURATED = 65535.0  # counts
LIGHT_MIN = 60.0  # min at the end of a plateau over which light is averaged
BLOCKS = 4  # blocks of a plateau; their scatter gives the interval of the mean
EDGE_ROWS = 5  # rows whose median is the OD at the edge of a block


@dataclass(frozen=True)
class Plateau:
    """Stretch of a recording at one temperature.

    temperature: degC. growth: 1/h. light: counts per OD, None without light readings. first, end: rows [first, end).
    """

    temperature: float
    growth: Parameter
    light: Parameter | None
    first: int
    end: int


@dataclass(frozen=True)
class Polynomial:
    """Fitted polynomial in T - centre.

    coefficients: highest power first. off: value minus polynomial for each fitted point, in standard deviations.
    """

    coefficients: tuple[float, ...]
    off: Array


def plateaus(
    series: Series,
    temperature: Array,
    light: Array,
    tau: float,
    settle_min: float,
    least_min: float,
    offset: float = 0.0,
) -> tuple[list[Plateau], list[str]]:
    """Return the plateaus of a recording, stretches of constant temperature, and the reasons for ignored ones.

    The first `settle_min` of each stretch are skipped, because growth still settles. Growth is the increase of ln OD
    plus dilution, mu = (ln y_end - ln y_start + sum u dt / tau) / minutes; its interval comes from the scatter of four
    blocks. So the growth curves depend on the pump's flow, but their crossing does not. Light per OD is the mean over
    the last hour minus `offset`. A stretch is ignored if less than `least_min` remain or if its growth rate is
    uncertain by more than 20 % and 0.03 1/h. The second list has the reasons, for stretches of half an hour or more.
    Args: temperature: degC; light: counts; both (n,), nan without reading. tau: V/60 of the calibrated flow.
    """
    found: list[Plateau] = []
    left: list[str] = []
    for first, end in _held(series.time, temperature):
        start = int(np.searchsorted(series.time, series.time[first] + settle_min))
        held = series.time[end - 1] - series.time[first] + np.median(np.diff(series.time))
        here = f"{np.nanmean(temperature[first:end]):.1f} degC from minute {series.time[first]:.0f} on"
        if held < settle_min + least_min:
            if held >= WORTH_A_WORD_MIN:
                left.append(f"{here}: constant for {held:.0f} min, at least {settle_min + least_min:.0f} are needed")
            continue
        growth = _growth(screen(series.part(start, end)).series, tau)
        if growth is None or growth.half_width > max(WIDEST * growth.value, LEAST_WIDTH):
            why = "no growth" if growth is None else f"growth {growth.value:.3f} +- {growth.half_width:.3f} 1/h"
            left.append(f"{here}: {why}, too uncertain for a curve")
            continue
        late = slice(max(int(np.searchsorted(series.time, series.time[end - 1] - LIGHT_MIN)), start), end)
        seen = np.where(light[late] < SATURATED, light[late], np.nan)
        per_od = (seen - offset) / np.where(series.od[late] > 0.0, series.od[late], np.nan)
        per_od = per_od[np.isfinite(per_od)]
        glow = None
        if per_od.size > 2:
            mean, half = float(per_od.mean()), 1.96 * float(per_od.std(ddof=1)) / per_od.size**0.5
            glow = Parameter(mean, mean - half, mean + half)
        found.append(Plateau(float(np.nanmean(temperature[start:end])), growth, glow, start, end))
    return found, left


def _growth(part: Series, tau: float) -> Parameter | None:
    """Return the growth rate of a stretch, 1/h, or None with too few readings or without growth."""
    seen = np.flatnonzero(part.od > 0.0)
    if seen.size < BLOCKS * 2 * EDGE_ROWS:
        return None
    removed = np.concatenate([[0.0], np.cumsum(part.pump_rate[:-1] * np.diff(part.time))]) / tau
    gained = np.log(part.od[seen]) + removed[seen]
    edges = np.linspace(0, seen.size - EDGE_ROWS, BLOCKS + 1).astype(int)
    at = [slice(k, k + EDGE_ROWS) for k in edges]
    level = np.array([np.median(gained[k]) for k in at])
    when = np.array([np.mean(part.time[seen[k]]) for k in at])
    each = 60.0 * np.diff(level) / np.diff(when)
    mean = 60.0 * float((level[-1] - level[0]) / (when[-1] - when[0]))
    from scipy.special import stdtrit

    half = float(stdtrit(BLOCKS - 1, 0.975) * each.std(ddof=1)) / BLOCKS**0.5
    return Parameter(mean, mean - half, mean + half) if mean > 0.0 else None


def _held(time: Array, temperature: Array) -> list[tuple[int, int]]:
    """Return [first, end) of each stretch in which the temperature stays within `HELD_C` of its mean so far."""
    found, first, total, count = [], 0, 0.0, 0
    for k, t in enumerate(temperature):
        if np.isnan(t):
            continue
        if count and abs(t - total / count) > HELD_C:
            found.append((first, k))
            first, total, count = k, 0.0, 0
        total, count = total + t, count + 1
    return [(a, b) for a, b in [*found, (first, len(time))] if b - a > 1]


def fit(temperature: Array, value: Array, sd: Array, degree: int, centre: float = 0.0) -> Polynomial:
    """Fit a polynomial of `degree` < K to K points by weighted least squares; sd: of each value. Arrays (K,)."""
    powers = np.vander(temperature - centre, degree + 1)
    weighted = powers / sd[:, None]
    coefficients, *_ = np.linalg.lstsq(weighted, value / sd, rcond=None)
    return Polynomial(tuple(map(float, coefficients)), (value - powers @ coefficients) / sd)
