"""From a raw recording to one trustworthy pair (mu, tau): screening, window, fit, validation and drift.

A real culture changes over hours while the model's two numbers do not. So the fit is confined to the longest window
that does not drift, what lies outside it is used to test the pair, and short segments over the whole recording show how
the numbers wander. Two methods: `prediction_error` holds whatever moves the pump; `free_run` is the paper's.
"""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.identification.drift import NOTABLE_DRIFT_PCT, Drift, Segment, cuts, drift, pairs, segments
from envs.identification.free_run import Fit, fit
from envs.identification.model import NotIdentifiable, Parameter, check_excitation, pmse, start_level, trajectory
from envs.identification.prediction_error import WORST_CONDITION, Estimate, enough, estimate, outliers
from envs.identification.screening import Rejection, Screened, Series, noise_sd, screen
from envs.identification.window import SHORTEST_WINDOW_MIN, choose_window

__all__ = ["Calibration", "IdentifyConfig", "Validation", "calibrate", "refusal"]

Array = NDArray[np.float64]

FLOOR_FACTOR = 3.0  # a prediction may miss by three times what the sensor's noise alone does
WORST_FLOOR = 10.0  # %; a sensor noisier than that excuses nothing
START_READINGS = 5  # that set the start of a prediction and are not scored
PLAUSIBLE_MU = (0.001, 0.06)  # 1/min, doubling in 11 h to 12 min
PLAUSIBLE_TAU = (0.05, 2.0)
WIDEST_TAU = 0.3  # half width of 1/tau over its value
EARLY_MIN = 1440.0  # the held-out check fits at most so much before what it predicts
REMEDY = (
    "record with the pump stopped for 10 min every hour (which tells both within about 5 %), or in open loop as "
    "generate=true does"
)


@dataclass(frozen=True)
class IdentifyConfig:
    """How mu and tau are estimated, how the window is chosen and what is reported."""

    method: str = setting(
        "prediction_error",
        "prediction_error holds also where the pump answers the OD; free_run: the paper's least squares, for open loop",
        choices=("prediction_error", "free_run"),
    )
    window: str = setting("auto", "the longest stretch without drift, or all rows", choices=("auto", "all"))
    pmse_limit: float = setting(
        0.5,
        "of predictions, and of the window of free_run (the paper's model reached 6 %); three times the PMSE of the "
        "sensor's noise where that is larger",
        "%",
        above=0.0,
        at_most=100.0,
        note="default 0.5",
    )
    segment_min: float = setting(120.0, "length of the segments of the drift report", "min", within=(20, 1440))
    horizon_min: float = setting(
        60.0, "of the predictions of unseen readings, each from a fresh start", "min", within=(20, 1440)
    )

    def __post_init__(self) -> None:
        check(self, "identify")


@dataclass(frozen=True)
class Validation:
    """PMSE of predictions, each from a fresh start every horizon, %; None where there are no such readings.

    holdout_pct: the pair of the window's first 70 % (of these the last 24 h) on the window's last 30 %.
    early_pct: the same pair on its own rows. outside_pct: the returned pair on the trustworthy rows outside the window.
    """

    holdout_pct: float | None
    early_pct: float | None
    holdout_n: int
    outside_pct: float | None
    outside_n: int


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything `calibrate` found. Positions refer to `screened.series`; window is [first, end).

    mu, tau: the returned pair, by `method`. estimate, free_run: of the window by either method, None where that one
    refuses. model: free run of the returned pair over the window from the start that fits best, OD, shape (n,).
    pair_pmse_pct: its PMSE. pmse_pct: of the free-run fit, the paper's figure; of the pair where there is no such fit.
    """

    screened: Screened
    window: tuple[int, int]
    window_reason: str
    method: str
    mu: Parameter
    tau: Parameter
    estimate: Estimate | None
    free_run: Fit | None
    model: Array
    pair_pmse_pct: float
    pmse_pct: float
    validation: Validation
    segments: tuple[Segment, ...]
    drift_mu: Drift | None
    drift_tau: Drift | None
    warnings: tuple[str, ...]

    @property
    def inside(self) -> Series:
        """The window's rows."""
        return self.screened.series.part(*self.window)

    @property
    def window_rows(self) -> tuple[int, int]:
        """Row numbers [first, end) of the window."""
        row = self.screened.series.row
        return int(row[self.window[0]]), int(row[self.window[1] - 1]) + 1

    @property
    def n_used(self) -> int:
        """Readings in the window."""
        return int(np.isfinite(self.inside.od).sum())


def calibrate(series: Series, config: IdentifyConfig = IdentifyConfig()) -> Calibration:
    """Fit (mu, tau) to the best window of a recording and report how far that pair can be trusted.

    Args: series: raw recording.
    Raises: NotIdentifiable when the trustworthy rows cannot give tau; ValueError when none are left.
    """
    screened = screen(series)
    if config.method == "prediction_error":
        screened = _without_outliers(screened, config.segment_min)
    limit = _limit(screened.series, config.pmse_limit)
    along = segments(screened, config.segment_min, config.method)
    window, reason = _window(screened, along, config, limit)
    inside = screened.series.part(*window)
    check_excitation(inside)
    if not enough(inside):
        raise NotIdentifiable(f"rows {inside.row[0]}-{inside.row[-1]}: too few readings above zero for a fit")
    free_run, why_not = _free_run(inside)
    whole = estimate([inside])[0]
    refused = refusal(whole, inside)
    if config.method == "prediction_error":
        why_not, mu, tau = refused or "", whole.mu, whole.tau
    elif free_run is not None:
        mu, tau = free_run.mu, free_run.tau
    if why_not:
        raise NotIdentifiable(why_not)
    assert tau is not None
    model = _from_best_start(inside, mu.value, tau.value)
    result = Calibration(
        screened=screened,
        window=window,
        window_reason=reason,
        method=config.method,
        mu=mu,
        tau=tau,
        estimate=None if refused else whole,
        free_run=free_run,
        model=model,
        pair_pmse_pct=pmse(inside.od, model),
        pmse_pct=pmse(inside.od, model) if free_run is None else free_run.pmse_pct,
        validation=_validate(screened, window, (mu.value, tau.value), config),
        segments=along,
        drift_mu=drift(along, [s.mu for s in along]),
        drift_tau=drift(along, [s.tau for s in along]),
        warnings=(),
    )
    warnings = _drift_warnings(result), _fit_warnings(result, limit), _prediction_warnings(result.validation, limit)
    return replace(result, warnings=tuple(chain.from_iterable(warnings)))


def refusal(found: Estimate, series: Series) -> str | None:
    """Why an estimate is not to be believed, with the remedy; None when it is.

    A law that answers each reading in proportion (u = u0 + c (x - r)) hides the dose's effect behind the correlation of
    readings: mu comes out many times too high, with an interval that looks fine. What tells it is a wide tau, an
    impossible mu or a 1/tau that may be zero.
    """
    rows = f"rows {series.row[0]}-{series.row[-1]}"
    k, mu = found.inverse_tau, found.mu
    if found.condition > WORST_CONDITION:
        return (
            f"{rows}: the pump's rate hardly changes, so growth and dilution cannot be told apart; mu - u/tau is "
            f"{mu.value - k.value * float(np.mean(series.pump_rate)):.3g} 1/min; {REMEDY}"
        )
    if k.low <= 0.0 or k.half_width > WIDEST_TAU * k.value:
        return (
            f"{rows}: 1/tau = {k.value:.3g} with the 95 % interval {k.low:.3g} to {k.high:.3g}; allowed within "
            f"+-{100 * WIDEST_TAU:.0f} %: they do not determine tau: too little dilution that is not an answer to the "
            f"readings, too much noise, or a culture that drifts; {REMEDY}"
        )
    if found.quality.answers and not PLAUSIBLE_MU[0] <= mu.value <= PLAUSIBLE_MU[1]:
        return (
            f"{rows}: mu = {mu.value:.3g} 1/min, allowed {PLAUSIBLE_MU[0]:g} to {PLAUSIBLE_MU[1]:g} where the pump "
            f"answers the readings: growth and dilution cannot be told apart; {REMEDY}"
        )
    return None


def _without_outliers(screened: Screened, segment_min: float) -> Screened:
    """Without the readings that their segment's model contradicts."""
    clean = screened.series
    places = [place for first, end in screened.stretches for place in cuts(clean, first, end, segment_min)]
    places = [(a, b) for a, b in places if enough(clean.part(a, b))]
    bad = np.zeros(len(clean.od), dtype=np.bool_)
    for (a, b), found in zip(places, outliers([clean.part(a, b) for a, b in places]) if places else [], strict=True):
        bad[a:b] = found
    if not bad.any():
        return screened
    rejection = Rejection("outlier: contradicts all other readings of its segment", clean.row[bad])
    return replace(screened, series=clean.rejecting(bad), rejections=(*screened.rejections, rejection))


def _limit(clean: Series, pmse_limit: float) -> float:
    """PMSE that a prediction may have, %: a sensor's own noise excuses up to three times what it makes."""
    floor = 100.0 * noise_sd(clean) ** 2 / float(np.nanmean(clean.od**2))
    return max(pmse_limit, min(FLOOR_FACTOR * floor, WORST_FLOOR))


def _window(
    screened: Screened, along: tuple[Segment, ...], config: IdentifyConfig, limit: float
) -> tuple[tuple[int, int], str]:
    if config.window == "auto":
        return choose_window(screened, along, config.method, limit, config.segment_min)
    clean = screened.series
    whole = max(screened.stretches, key=lambda s: np.isfinite(clean.od[s[0] : s[1]]).sum())
    return whole, "all trustworthy rows, as asked (identify.window=all)"


def _free_run(inside: Series) -> tuple[Fit | None, str]:
    """The paper's fit, or why there is none."""
    try:
        found = fit(inside)
    except NotIdentifiable as error:
        return None, str(error)
    return found, ""


def _from_best_start(part: Series, mu: float, tau: float) -> Array:
    """Free run of (mu, tau) from the start x_0 that minimises sum (x - y)^2, shape (n,)."""
    shape = trajectory(part.time, part.pump_rate, mu, tau, 1.0)
    seen = np.isfinite(part.od)
    return np.asarray(shape * (part.od[seen] @ shape[seen]) / (shape[seen] @ shape[seen]))


def _validate(
    screened: Screened, window: tuple[int, int], pair: tuple[float, float], config: IdentifyConfig
) -> Validation:
    clean, (a, b) = screened.series, window
    cut = a + int(0.7 * (b - a))
    start = max(a, int(np.searchsorted(clean.time, clean.time[cut] - EARLY_MIN)))
    before = clean.part(start, cut)
    mu, tau = pairs([before], config.method)[0] if enough(before) else (None, None)
    late = early = _Scored(np.empty(0), np.empty(0))
    if mu is not None and tau is not None:
        late = _predictions(clean, [(cut, b)], (mu.value, tau.value), config.horizon_min)
        early = _predictions(clean, [(start, cut)], (mu.value, tau.value), config.horizon_min)
    sides = [(first, min(end, a)) for first, end in screened.stretches]
    sides += [(max(first, b), end) for first, end in screened.stretches]
    outside = _predictions(clean, sides, pair, config.horizon_min)
    return Validation(late.pmse_pct, early.pmse_pct, len(late.od), outside.pmse_pct, len(outside.od))


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


def _drift_warnings(result: Calibration) -> list[str]:
    return [
        f"{name} drifts along the recording: {d.first:.3g} to {d.last:.3g} ({d.change_pct:+.0f} % over {d.segments} "
        "segments); the returned value belongs to the window"
        for name, d in (("mu", result.drift_mu), ("tau", result.drift_tau))
        if d is not None and d.significant and abs(d.change_pct) >= NOTABLE_DRIFT_PCT
    ]


def _fit_warnings(result: Calibration, limit: float) -> list[str]:
    found = []
    clean = result.inside
    minutes = float(clean.time[-1] - clean.time[0])
    if minutes < SHORTEST_WINDOW_MIN:
        found.append(f"the window lasts {minutes:.0f} min only; at least {SHORTEST_WINDOW_MIN:.0f} are wanted")
    for name, value, (low, high) in (
        ("mu", result.mu.value, PLAUSIBLE_MU),
        ("tau", result.tau.value, PLAUSIBLE_TAU),
    ):
        if not low <= value <= high:
            found.append(
                f"{name} = {value:.3g} lies outside the usual {low:g} to {high:g}: check the units of time and pump"
            )
    answers = result.estimate is None or result.estimate.quality.answers
    if result.method == "free_run" and answers:
        found.append(
            "the pump answers the readings (feedback), or may do: free-run least squares then shrinks mu and 1/tau, "
            "and neither its interval nor PMSE shows it; use identify.method=prediction_error"
        )
    if result.method == "prediction_error":
        found += _beside(result)
    elif result.pmse_pct > limit:
        found.append(
            f"PMSE {result.pmse_pct:.2g} % exceeds {limit:.2g} %: one pair (mu, tau) does not describe these rows"
        )
    if result.method == "free_run" and result.free_run is not None and result.free_run.autocorrelation > 0.5:
        found.append(
            f"residuals are correlated from row to row ({result.free_run.autocorrelation:.2f}): the model misses some "
            "of the culture's behaviour; the intervals allow for it"
        )
    return found


def _beside(result: Calibration) -> list[str]:
    """What the other method says, and whether its figures can be believed here."""
    found = []
    assert result.estimate is not None
    quality = result.estimate.quality
    if quality.answers:
        found.append(
            f"the pump answers the readings (feedback: correlation {quality.feedback:.2f}): the free-run fit and PMSE "
            "cannot judge these rows; the returned pair allows for it"
        )
    free = result.free_run
    if free is not None and free.tau is not None:
        for name, mine, other in (("mu", result.mu, free.mu.value), ("tau", result.tau, free.tau.value)):
            if not mine.low <= other <= mine.high:
                found.append(
                    f"free-run least squares gives {name} = {other:.3g}, outside the interval {mine.low:.3g} to "
                    f"{mine.high:.3g}: it takes disturbances for noise of the sensor"
                )
    if abs(quality.autocorrelation) > 0.2:
        found.append(
            f"one-step innovations are correlated ({quality.autocorrelation:.2f}): the culture does something that "
            "neither wandering growth nor uneven doses explain; the intervals may be too narrow"
        )
    return found


def _prediction_warnings(v: Validation, limit: float) -> list[str]:
    found = []
    if v.holdout_pct is not None and v.holdout_pct > max(2.0 * (v.early_pct or 0.0), limit):
        found.append(
            f"held-out check failed: the pair of the window's first 70 % predicts its last 30 % with a PMSE of "
            f"{v.holdout_pct:.2g} %, its own rows with {v.early_pct or 0.0:.2g} %: culture or pump have changed"
        )
    if v.outside_pct is not None and v.outside_pct > max(2.0 * (v.early_pct or 0.0), limit):
        found.append(f"outside its window the pair predicts with a PMSE of {v.outside_pct:.2g} % (limit {limit:.2g} %)")
    return found
