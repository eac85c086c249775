"""Calibration of a raw recording, which gives one pair (mu, tau): screening, window, fit, validation and drift.

A real culture changes over hours, but mu and tau of the model are constant. So the fit uses the longest window without
drift. The rows outside the window test the pair, and separate fits of short segments show the drift. There are two
methods: `prediction_error` is valid for every pump control; `free_run` is that of the paper.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.identification.drift import NOTABLE_DRIFT_PCT, choose_window, drift, longest, pieces, segments
from envs.identification.free_run import Fit, fit
from envs.identification.model import NotIdentifiable, Parameter, check_excitation, pmse, trajectory
from envs.identification.prediction_error import enough, estimate, outliers
from envs.identification.screening import Rejection, Screened, Series, noise_sd, screen
from envs.identification.validation import attainable_pct, validate
from envs.identification.verdict import Calibration, Verdict, check_estimate, judged

Array = NDArray[np.float64]

FLOOR_FACTOR = 3.0  # acceptable PMSE of a prediction over that of noise and disturbances


@dataclass(frozen=True)
class IdentifyConfig:
    """Settings of estimation, window and drift report."""

    method: str = setting(
        "prediction_error",
        "prediction_error: for every recording; free_run: the paper's least squares, only for open loop",
        choices=("prediction_error", "free_run"),
    )
    window: str = setting("auto", "auto: the longest part without drift; all: all rows", choices=("auto", "all"))
    pmse_limit: float = setting(
        0.5,
        "PMSE of predictions above which to warn (the paper's model: 6 %); at least 3 times that of noise",
        "%",
        above=0.0,
        at_most=100.0,
        note="default 0.5",
    )
    segment_min: float = setting(120.0, "length of the segments of the drift report", "min", within=(20, 1440))
    horizon_min: float = setting(
        60.0, "prediction horizon in the validation on unseen readings", "min", within=(20, 1440)
    )
    seed: int = setting(0, "random seed of the noise models over which the estimate is averaged", at_least=0)

    def __post_init__(self) -> None:
        check(self, "identify")


def calibrate(
    series: Series, config: IdentifyConfig = IdentifyConfig(), doubts: tuple[tuple[str, str], ...] = ()
) -> Calibration:
    """Fit (mu, tau) to the best window of a recording and judge the reliability of this pair.

    Args: series: raw recording; apply `merged` if it has more rows than a week has minutes. doubts: problems of the
    recording, each with its remedy, for the verdict.
    Raises: NotIdentifiable if the trustworthy rows do not identify tau; ValueError without trustworthy rows.
    """
    screened = _without_outliers(screen(series), config)
    along = segments(screened, config.segment_min)
    window, reason = longest(screened), "all trustworthy rows, as set by identify.window=all"
    if config.window == "auto":
        window, reason = choose_window(screened, along, config.segment_min)
    inside = screened.series.part(*window)
    check_excitation(inside)
    if not enough(inside):
        raise NotIdentifiable(
            f"rows {inside.row[0]}-{inside.row[-1]}: too few readings above zero for a fit", "check the blank"
        )
    free_run = _free_run(inside, config.method)
    whole = estimate([inside], seed=config.seed)[0]
    try:
        check_estimate(whole, inside)
        fitted = [s for s in along if window[0] <= s.first and s.end <= window[1]]
        _check_between("mu", whole.mu, [s.mu for s in fitted])
        _check_between("tau", whole.tau, [s.tau for s in fitted])
        sound = True
    except NotIdentifiable:
        sound = False
        if config.method == "prediction_error":
            raise
    returned = whole if free_run is None or config.method == "prediction_error" else free_run
    assert returned.tau is not None
    mu, tau = returned.mu, returned.tau
    shape, seen = trajectory(inside.time, inside.pump_rate, mu.value, tau.value, 1.0), np.isfinite(inside.od)
    model = shape * (inside.od[seen] @ shape[seen]) / (shape[seen] @ shape[seen])  # with the best-fitting start x_0
    result = Calibration(
        screened=screened,
        window=window,
        window_reason=reason,
        method=config.method,
        mu=mu,
        tau=tau,
        estimate=whole,
        sound=sound,
        free_run=free_run,
        model=model,
        pair_pmse_pct=pmse(inside.od, model),
        pmse_pct=pmse(inside.od, model) if free_run is None else free_run.pmse_pct,
        validation=validate(screened, window, (mu.value, tau.value), config.horizon_min),
        segments=along,
        drift_mu=drift(along, [s.mu for s in along]),
        drift_tau=drift(along, [s.tau for s in along]),
        verdict=Verdict("", "", ""),
        warnings=(),
    )
    verdict, warnings = judged(result, _limit(result, config), doubts)
    return replace(result, verdict=verdict, warnings=warnings)


def _check_between(name: str, whole: Parameter | None, alone: list[Parameter | None]) -> None:
    """Refuse an estimate that lies 10 % or more outside the intervals of all segments. Raises: NotIdentifiable."""
    known = [p for p in alone if p is not None]
    if whole is None or not known:
        return
    low, high, margin = min(p.low for p in known), max(p.high for p in known), NOTABLE_DRIFT_PCT / 100 * whole.value
    if not low - margin <= whole.value <= high + margin:
        raise NotIdentifiable(
            f"{name} is {whole.value:.4g} for the whole window, but {low:.4g} to {high:.4g} for its {len(known)} "
            "segments, so the culture or the pump changed within the window",
            "calibrate with the rows before the change",
        )


def _without_outliers(screened: Screened, config: IdentifyConfig) -> Screened:
    """Remove the readings that contradict the model of their segment."""
    clean, places = screened.series, pieces(screened, config.segment_min)
    bad = np.zeros(len(clean.od), dtype=np.bool_)
    found = outliers([clean.part(a, b) for a, b in places], config.seed) if places else []
    for (a, b), marked in zip(places, found, strict=True):
        bad[a:b] = marked
    if not bad.any():
        return screened
    rejection = Rejection("outlier: contradicts the other readings of its segment", clean.row[bad])
    return replace(screened, series=clean.rejecting(bad), rejections=(*screened.rejections, rejection))


def _limit(result: Calibration, config: IdentifyConfig) -> float:
    """Return the largest acceptable PMSE, %: 3 times that of noise and disturbances, at least `pmse_limit`."""
    clean = result.screened.series
    noise = 100.0 * noise_sd(clean) ** 2 / float(np.nanmean(clean.od**2))
    if config.method == "prediction_error":
        noise += attainable_pct(result.estimate, result.inside, config.horizon_min)
    return max(config.pmse_limit, FLOOR_FACTOR * noise)


def _free_run(inside: Series, method: str) -> Fit | None:
    """Run the paper's fit. On failure raise NotIdentifiable if `method` is "free_run", else return None."""
    try:
        return fit(inside)
    except NotIdentifiable:
        if method == "free_run":
            raise
        return None
