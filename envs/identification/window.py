"""From a raw recording to one trustworthy pair (mu, tau): screening, window, fit, validation and drift.

A real culture changes over hours while the model's two numbers do not. So the fit is confined to the longest window
that one free-running trajectory describes, what lies outside it is used to test the pair, and short segments over the
whole recording show how the numbers wander.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.identification.fit import (
    Fit,
    NotIdentifiable,
    Parameter,
    check_excitation,
    fit,
    pmse,
    start_level,
    trajectory,
)
from envs.identification.screening import Screened, Series, noise_sd, screen

__all__ = ["Calibration", "Drift", "IdentifyConfig", "Segment", "Validation", "calibrate"]

Array = NDArray[np.float64]

FLOOR_FACTOR = 3.0  # a window may miss by three times what the sensor's noise alone does
WORST_FLOOR = 10.0  # %; a sensor noisier than that excuses nothing
NOTABLE_DRIFT_PCT = 10.0
SUSPICION = 0.65  # of a 95 % half width: the 80 % interval
MOST_EDGES = 60  # window borders are tried at this many places at most
PLAUSIBLE_MU = (0.001, 0.06)  # 1/min, doubling in 11 h to 12 min
PLAUSIBLE_TAU = (0.05, 2.0)


@dataclass(frozen=True)
class IdentifyConfig:
    """How the window is chosen and what is reported.

    "auto" takes the longest stretch whose free-running fit stays below the limit and whose segments do not drift;
    "all" takes all rows. The limit is raised to three times the PMSE of the sensor's noise where that is larger.
    """

    window: str = setting("auto", "rows to fit", choices=("auto", "all"))
    pmse_limit: float = setting(
        0.5, "of the window (the paper's model reached 6 %)", "%", above=0.0, at_most=100.0, note="default 0.5"
    )
    segment_min: float = setting(120.0, "length of the segments of the drift report", "min", within=(20, 1440))
    horizon_min: float = setting(
        60.0, "of the predictions outside the window, each from a fresh start", "min", within=(20, 1440)
    )

    def __post_init__(self) -> None:
        check(self, "identify")


@dataclass(frozen=True, eq=False)
class Segment:
    """A short fit of its own: positions [first, end), its middle in min, and what it gave; None = not identifiable."""

    first: int
    end: int
    middle_min: float
    mu: Parameter | None
    tau: Parameter | None
    pmse_pct: float


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


@dataclass(frozen=True)
class Validation:
    """PMSE of predictions on readings that the parameters were not fitted to, %; None where there are none.

    holdout_pct: parameters from the first 70 % of the window, free run over its last 30 %.
    outside_pct: the window's parameters on the trustworthy rows outside it, started afresh every horizon.
    """

    holdout_pct: float | None
    holdout_n: int
    outside_pct: float | None
    outside_n: int


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything `calibrate` found. Positions refer to `screened.series`; window is [first, end)."""

    screened: Screened
    window: tuple[int, int]
    window_reason: str
    fit: Fit
    validation: Validation
    segments: tuple[Segment, ...]
    drift_mu: Drift | None
    drift_tau: Drift | None
    warnings: tuple[str, ...]

    @property
    def tau(self) -> Parameter:
        """tau of the fit; a calibration always has one."""
        assert self.fit.tau is not None
        return self.fit.tau

    @property
    def window_rows(self) -> tuple[int, int]:
        """Row numbers [first, end) of the window."""
        row = self.screened.series.row
        return int(row[self.window[0]]), int(row[self.window[1] - 1]) + 1


def calibrate(series: Series, config: IdentifyConfig | None = None) -> Calibration:
    """Fit (mu, tau) to the best window of a recording and report how far that pair can be trusted.

    Args: series: raw recording. config: see `IdentifyConfig`; None is the default.
    Raises: NotIdentifiable when the trustworthy rows cannot give tau; ValueError when none are left.
    """
    config = IdentifyConfig() if config is None else config
    screened = screen(series)
    clean = screened.series
    window, reason, limit = _choose_window(screened, config)
    inside = clean.part(*window)
    check_excitation(inside)
    fitted = fit(inside)
    segments = _segments(screened, config.segment_min)
    drift_mu = _drift(segments, [s.mu for s in segments])
    drift_tau = _drift(segments, [s.tau for s in segments])
    result = Calibration(
        screened=screened,
        window=window,
        window_reason=reason,
        fit=fitted,
        validation=_validate(screened, window, fitted, config.horizon_min),
        segments=segments,
        drift_mu=drift_mu,
        drift_tau=drift_tau,
        warnings=(),
    )
    return replace(result, warnings=tuple(_warnings(result, limit)))


def _choose_window(screened: Screened, config: IdentifyConfig) -> tuple[tuple[int, int], str, float]:
    """Positions [first, end), the reason in words, and the PMSE limit in %."""
    clean = screened.series
    whole = max(screened.stretches, key=lambda s: np.isfinite(clean.od[s[0] : s[1]]).sum())
    floor = 100.0 * noise_sd(clean) ** 2 / float(np.nanmean(clean.od**2))
    limit = max(config.pmse_limit, min(FLOOR_FACTOR * floor, WORST_FLOOR))
    if config.window == "all":
        return whole, "all trustworthy rows, as asked (identify.window=all)", limit
    found = _longest_window(screened, limit, config.segment_min)
    if found is None:
        check_excitation(clean.part(*whole))  # the likeliest reasons first, each in its own words
        error_pct = fit(clean.part(*whole), robust=False).pmse_pct
        raise NotIdentifiable(
            f"no window is described by one pair (mu, tau) within a PMSE of {limit:.2g} % (all rows: "
            f"{error_pct:.2g} %); the recording drifts or is too noisy; raise identify.pmse_limit, or choose a window "
            "by rows=FIRST:END identify.window=all"
        )
    covers = "all trustworthy rows" if found == whole else "the longest stretch without drift"
    n = int(np.isfinite(clean.od[found[0] : found[1]]).sum())
    return found, f"{covers}: one free-running trajectory describes its {n} readings within {limit:.2g} %", limit


def _longest_window(screened: Screened, limit: float, segment_min: float) -> tuple[int, int] | None:
    """The window with most readings whose free-running fit stays below the limit and which does not drift inside."""
    clean = screened.series
    count = np.concatenate([[0], np.cumsum(np.isfinite(clean.od))])
    best: tuple[int, int] | None = None
    most = 0
    for first, end in screened.stretches:
        step = max(20, -(-(end - first) // MOST_EDGES))
        edges = [*range(first, end - step // 2, step), end]
        for i, a in enumerate(edges[:-1]):
            for b in reversed(edges[i + 1 :]):
                if count[b] - count[a] <= most:
                    break
                part = clean.part(a, b)
                try:
                    check_excitation(part)
                    good = fit(part, robust=False).pmse_pct <= limit
                except NotIdentifiable:
                    continue
                if good and not _drifts(part, segment_min):
                    best, most = (a, b), int(count[b] - count[a])
                    break
    return best


def _drifts(part: Series, segment_min: float) -> bool:
    """True when mu or tau of the segments within `part` move by 10 % or more, beyond their 80 % interval.

    Less certainty than for a warning: a window that may drift is not to be trusted.
    """
    segments = _segments(Screened(part, ((0, len(part.od)),), ()), segment_min)
    lines = (_drift(segments, [s.mu for s in segments]), _drift(segments, [s.tau for s in segments]))
    return any(
        d is not None
        and abs(d.change_pct) >= NOTABLE_DRIFT_PCT
        and abs(d.slope_per_h.value) > SUSPICION * d.slope_per_h.half_width
        for d in lines
    )


def _validate(screened: Screened, window: tuple[int, int], fitted: Fit, horizon: float) -> Validation:
    clean = screened.series
    a, b = window
    cut = a + int(0.7 * (b - a))
    holdout, holdout_n = None, 0
    try:
        check_excitation(clean.part(a, cut))
        early = fit(clean.part(a, cut))
        if early.tau is not None:
            part = clean.part(a, b)
            model = trajectory(part.time, part.pump_rate, early.mu.value, early.tau.value, float(early.start_od[0]))
            late = clean.od[cut:b]
            holdout_n = int((late > 0.0).sum())
            holdout = pmse(late, model[cut - a :]) if holdout_n else None
    except NotIdentifiable:
        pass  # the early part alone says too little; the report then has no such number
    od, model = _predictions_outside(screened, window, fitted, horizon)
    return Validation(holdout, holdout_n, pmse(od, model) if len(od) else None, len(od))


def _predictions_outside(
    screened: Screened, window: tuple[int, int], fitted: Fit, horizon: float
) -> tuple[Array, Array]:
    """Readings outside the window and their predictions; the first five of each horizon only set its start."""
    clean = screened.series
    assert fitted.tau is not None
    measured: list[Array] = []
    predicted: list[Array] = []
    for first, end in screened.stretches:
        for a, b in ((first, min(end, window[0])), (max(first, window[1]), end)):
            for part in (clean.part(*cut) for cut in _cuts(clean, a, b, horizon)):
                used = np.flatnonzero(np.isfinite(part.od))[5:]
                if len(used) < 10:
                    continue
                start = start_level(part, fitted.mu.value, fitted.tau.value)
                model = trajectory(part.time, part.pump_rate, fitted.mu.value, fitted.tau.value, start)
                measured.append(part.od[used])
                predicted.append(model[used])
    if not measured:
        return np.empty(0), np.empty(0)
    return np.concatenate(measured), np.concatenate(predicted)


def _cuts(clean: Series, a: int, b: int, length: float) -> list[tuple[int, int]]:
    """[a, b) cut into equal pieces of about `length` min."""
    if b - a < 2:
        return []
    span = clean.time[b - 1] - clean.time[a]
    n = max(1, round(float(span) / length))
    inner = np.searchsorted(clean.time[a:b], clean.time[a] + span * np.arange(1, n) / n) + a
    edges = [a, *(int(i) for i in inner), b]
    return list(pairwise(edges))


def _segments(screened: Screened, length: float) -> tuple[Segment, ...]:
    """Independent fits along the recording; a segment whose pump never ran gives mu alone."""
    clean = screened.series
    segments = []
    for first, end in screened.stretches:
        for a, b in _cuts(clean, first, end, length):
            part = clean.part(a, b)
            mu = tau = None
            error = np.nan
            try:
                if (part.pump_rate[:-1] > 0.0).any():
                    check_excitation(part)
                found = fit(part)
                mu, tau, error = found.mu, found.tau, found.pmse_pct
            except NotIdentifiable:
                pass  # shown as a segment without an estimate
            segments.append(Segment(a, b, float(0.5 * (part.time[0] + part.time[-1])), mu, tau, float(error)))
    return tuple(segments)


def _drift(segments: tuple[Segment, ...], values: list[Parameter | None]) -> Drift | None:
    """Line through at least four estimates, weighted by their intervals; scatter beyond them widens the slope's."""
    known = [(s.middle_min, v) for s, v in zip(segments, values, strict=True) if v is not None]
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


def _warnings(result: Calibration, limit: float) -> list[str]:
    found = []
    fitted, v = result.fit, result.validation
    for name, drift in (("mu", result.drift_mu), ("tau", result.drift_tau)):
        if drift is not None and drift.significant and abs(drift.change_pct) >= NOTABLE_DRIFT_PCT:
            found.append(
                f"{name} drifts along the recording: {drift.first:.3g} to {drift.last:.3g} "
                f"({drift.change_pct:+.0f} % over {drift.segments} segments); the returned value belongs to the window"
            )
    if fitted.pmse_pct > limit:
        found.append(
            f"PMSE {fitted.pmse_pct:.2g} % exceeds {limit:.2g} %: one pair (mu, tau) does not describe these rows"
        )
    if fitted.autocorrelation > 0.5:
        found.append(
            f"residuals are correlated from row to row ({fitted.autocorrelation:.2f}): the model misses some of the "
            "culture's behaviour; the intervals allow for it"
        )
    for name, value, (low, high) in (("mu", fitted.mu.value, PLAUSIBLE_MU), ("tau", result.tau.value, PLAUSIBLE_TAU)):
        if not low <= value <= high:
            found.append(
                f"{name} = {value:.3g} lies outside the usual {low:g} to {high:g}: check the units of time and pump"
            )
    if v.outside_pct is not None and v.outside_pct > max(2.0 * fitted.pmse_pct, limit):
        found.append(
            f"outside its window the pair predicts worse: PMSE {v.outside_pct:.2g} % against {fitted.pmse_pct:.2g} %"
        )
    return found
