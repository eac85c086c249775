"""Result of a calibration: the pair, further findings and the verdict; refusal; estimates for rows without tau."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.drift import SHORTEST_WINDOW_MIN, Drift, Segment, longest
from envs.identification.free_run import Fit
from envs.identification.model import MIN_READINGS, REMEDY, WORST_CONDITION, NotIdentifiable, Parameter
from envs.identification.prediction_error import Estimate, Quality, enough, estimate
from envs.identification.screening import OD_FLOOR, Screened, Series, noise_sd, runs, screen
from envs.identification.validation import START_READINGS, Validation

Array = NDArray[np.float64]

PLAUSIBLE_MU = (0.001, 0.06)  # 1/min, doubling in 11 h to 12 min
FASTEST_MU = 0.1  # 1/min; no bacterium doubles in less than 7 min
POSSIBLE_TAU = (0.01, 10.0)  # a pump of 1 mL/s with 0.6 to 600 mL
WIDEST_TAU = 0.3  # largest half width of 1/tau over its value for a returned pair
STEEPEST_HILLS = 3.0  # largest spread of 1/tau between points of the noise model over that within a point
NARROW = 0.1  # half width of an interval over its value; in narrower intervals this spread does not matter
SETTLED_ROWS = 2  # rows after a dose that are skipped, because readings may show the dose late
PLAUSIBLE_TAU = (0.05, 2.0)
UNEVEN = 0.25  # warning: sd of a dose over its size
SLOW_ROWS_MIN = 2.0  # warning: min between rows; a pump rate that changes between rows biases the estimate
UNSTEADY = 0.15  # warning: sd of the hourly mean of the growth rate over mu
UNSEEN = 0.5  # warning: fraction of a dose missing from the next reading
CORRELATED = 0.2  # warning: correlation of the innovations from row to row
AGAIN = (
    "calibrate again shortly before the run, leave out the rows where the culture changes (rows=FIRST:END, "
    "figures/drift.png), or use policy=shipped, which needs no calibration"
)


@dataclass(frozen=True)
class Verdict:
    """Verdict. word: use, use with care, record again or read again. why: the reason. then: the next step, or ""."""

    word: str
    why: str
    then: str

    def line(self) -> str:
        """Return the verdict as one line for the screen."""
        return f"{self.word}: {self.why}" + (f"; {self.then}" if self.then else "")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`. Positions are those in `screened.series`; window is [first, end).

    mu, tau: the returned pair, by `method`. estimate, free_run: fits of the window by both methods; free_run is None if
    it failed. sound: whether `estimate` identifies tau. model: free run of the returned pair over the window with the
    best-fitting start, OD, (n,). pair_pmse_pct: PMSE of `model`. pmse_pct: PMSE of the free-run fit, as in the paper,
    or of `model` without such a fit. warnings: reasons against the pair, the most serious first.
    """

    screened: Screened
    window: tuple[int, int]
    window_reason: str
    method: str
    mu: Parameter
    tau: Parameter
    estimate: Estimate
    sound: bool
    free_run: Fit | None
    model: Array
    pair_pmse_pct: float
    pmse_pct: float
    validation: Validation
    segments: tuple[Segment, ...]
    drift_mu: Drift | None
    drift_tau: Drift | None
    verdict: Verdict
    warnings: tuple[str, ...]

    @property
    def inside(self) -> Series:
        """Rows of the window."""
        return self.screened.series.part(*self.window)

    @property
    def window_rows(self) -> tuple[int, int]:
        """Row numbers [first, end) of the window."""
        row = self.screened.series.row
        return int(row[self.window[0]]), int(row[self.window[1] - 1]) + 1

    @property
    def n_used(self) -> int:
        """Number of readings in the window."""
        return int(np.isfinite(self.inside.od).sum())


def judged(
    result: Calibration, limit: float, doubts: tuple[tuple[str, str], ...] = ()
) -> tuple[Verdict, tuple[str, ...]]:
    """Judge a fit: return the verdict, and all reasons against the fit, the most serious first.

    Args: limit: largest acceptable PMSE of predictions, %. doubts: problems of the recording, each with its remedy.
    """
    against = [*doubts, *_against(result, limit)]
    mu, tau = (100.0 * p.half_width / p.value for p in (result.mu, result.tau))
    known = f"mu is known within +-{mu:.2g} % and tau within +-{tau:.2g} %"
    if not against:
        return Verdict("use", f"{known}; all checks passed", ""), ()
    what, then = against[0]
    more = f" ({len(against) - 1} more below)" if len(against) > 1 else ""
    told = (what if k and then == against[k - 1][1] else f"{what}; {then}" for k, (what, then) in enumerate(against))
    return Verdict("use with care", f"{known}; {what}{more}", then), tuple(told)


def _against(result: Calibration, limit: float) -> Iterator[tuple[str, str]]:
    """Yield pairs (problem, remedy)."""
    mu, tau = result.mu, result.tau
    for name, value, (low, high) in (("mu", mu.value, PLAUSIBLE_MU), ("tau", tau.value, PLAUSIBLE_TAU)):
        if not low <= value <= high:
            said = f"{name} = {value:.3g} is outside the usual range {low:g} to {high:g}"
            yield said, "check the units of time and pump rate"
    found = result.estimate
    if result.method == "free_run":
        if not result.sound or found.quality.answers:
            yield (
                "the pump responds to the readings, so a free run estimates mu and 1/tau too small, without a warning",
                "use identify.method=prediction_error",
            )
        if result.pmse_pct > limit:
            yield (
                f"PMSE {result.pmse_pct:.2g} % exceeds {limit:.2g} %: one pair does not describe these rows",
                "choose a shorter window with rows=FIRST:END",
            )
    inside = result.inside.time
    apart = float(np.median(np.diff(inside)))
    if apart > SLOW_ROWS_MIN:
        yield f"rows are {apart:.3g} min apart", "record a row every minute, or at every change of the pump rate"
    if inside[-1] - inside[0] < SHORTEST_WINDOW_MIN:
        said = f"the window lasts {inside[-1] - inside[0]:.0f} min"
        yield said, f"record for at least {SHORTEST_WINDOW_MIN:.0f} min"
    for name, line in (("mu", result.drift_mu), ("tau", result.drift_tau)):
        if line is not None and line.notable:
            yield (
                f"{name} drifts from {line.first:.3g} to {line.last:.3g} ({line.change_pct:+.0f} %) in the recording",
                AGAIN,
            )
    v = result.validation
    worst = max(2.0 * (v.early_pct or 0.0), limit)
    for where, missed in (("the window's last 30 %", v.holdout_pct), ("the rows outside the window", v.outside_pct)):
        if missed is not None and missed > worst:
            yield f"{where} are predicted with a PMSE of {missed:.2g} %, allowed {worst:.2g} %", AGAIN
    if any(p.half_width > NARROW * p.value for p in (mu, tau)):
        yield f"an interval of mu or tau is wider than +-{100.0 * NARROW:.0f} %", REMEDY
    if result.sound:
        yield from _about_bench_and_culture(found.quality)
        if abs(found.quality.autocorrelation) > CORRELATED:
            yield (
                f"successive innovations are correlated ({found.quality.autocorrelation:.2f}), so the intervals may be "
                "too narrow",
                "check figures/fit.png for changes that the model does not contain",
            )


def _about_bench_and_culture(q: Quality) -> Iterator[tuple[str, str]]:
    """Yield (problem, remedy) of bench and culture, judged by the lower end of each interval."""
    if q.growth_spread.low > UNSTEADY:
        yield f"the growth rate fluctuates by at least {100.0 * q.growth_spread.low:.0f} % from hour to hour", AGAIN
    if q.dose_spread.low > UNEVEN:
        said = f"the doses vary by at least {100.0 * q.dose_spread.low:.0f} %"
        yield said, "check the feed's tube and needle, and measure the pump (python -m experiments.calibrate_pump)"
    if q.late_share.low > UNSEEN:
        said = f"at least {100.0 * q.late_share.low:.0f} % of a dose is missing from the next reading"
        yield said, "stir faster, or leave more time between a dose and the next reading"


def check_estimate(found: Estimate, series: Series) -> None:
    """Refuse an unreliable estimate.

    With a proportional controller (u = u0 + c (x - r)) the correlation of readings hides the effect of the doses: the
    estimate of mu is many times too high, with a narrow interval. Signs of such an estimate are a wide interval of tau,
    an interval of 1/tau with zero, an impossible mu, or a 1/tau that differs between likely noise models.

    Raises: NotIdentifiable.
    """
    rows = f"rows {series.row[0]}-{series.row[-1]}"
    k, mu = found.inverse_tau, found.mu
    if mu.low > FASTEST_MU and not found.quality.answers:  # else feedback may raise mu
        raise NotIdentifiable(
            f"{rows}: mu = {mu.value:.3g} 1/min, a doubling in {np.log(2.0) / mu.value:.2g} min: impossible growth",
            "check the unit of time (time_unit=)",
        )
    if k.low > 0.0 and not POSSIBLE_TAU[0] <= 1.0 / k.value <= POSSIBLE_TAU[1]:
        raise NotIdentifiable(
            f"{rows}: tau = {1.0 / k.value:.3g}: allowed {POSSIBLE_TAU[0]:g} to {POSSIBLE_TAU[1]:g}",
            "check the unit of the doses or of the pump's rate (pump_ml_s=)",
        )
    if found.condition > WORST_CONDITION:
        raise NotIdentifiable(f"{rows}: the pump rate hardly changes, so growth and dilution cannot be distinguished")
    if k.half_width > 10.0 * abs(k.value):
        raise NotIdentifiable(f"{rows}: they contain too little dilution to distinguish it from growth")
    if k.low <= 0.0 or k.half_width > WIDEST_TAU * k.value:
        raise NotIdentifiable(
            f"{rows}: 1/tau = {k.value:.3g} with the 95 % interval {k.low:.3g} to {k.high:.3g}; allowed "
            f"+-{100 * WIDEST_TAU:.0f} %, so these rows do not determine tau: too little dilution independent of the "
            "readings, too much noise, or a drifting culture"
        )
    if found.quality.hills > STEEPEST_HILLS and k.half_width > NARROW * k.value:
        raise NotIdentifiable(
            f"{rows}: 1/tau = {k.value:.3g} (95 % {k.low:.3g} to {k.high:.3g}) depends on the noise model: it varies "
            f"{found.quality.hills:.1f} times as much between noise models as within one, allowed "
            f"{STEEPEST_HILLS:g} times, because the pump only responds to the readings"
        )
    if found.quality.answers and not PLAUSIBLE_MU[0] <= mu.value <= PLAUSIBLE_MU[1]:
        raise NotIdentifiable(
            f"{rows}: mu = {mu.value:.3g} 1/min, allowed {PLAUSIBLE_MU[0]:g} to {PLAUSIBLE_MU[1]:g} if the pump "
            "responds to the readings: growth and dilution cannot be distinguished"
        )


@dataclass(frozen=True)
class GrowthAlone:
    """Estimates for rows that do not identify tau, 1/min.

    net: increase of ln x per minute over the longest trustworthy stretch, rows `net_rows`. mu: growth rate over the
    longest stretch without pumping, rows `mu_rows`; None if it is too short. Rows are [first, end)."""

    net: Parameter
    net_rows: tuple[int, int]
    mu: Parameter | None
    mu_rows: tuple[int, int] | None

    def words(self) -> str:
        """Return the estimates as a sentence."""
        net = f"the culture's net growth is {_value(self.net)} 1/min over rows {_rows(self.net_rows)}"
        if self.mu is None or self.mu_rows is None:
            return net
        if self.mu_rows == self.net_rows:
            return f"mu is {_value(self.mu)} 1/min over rows {_rows(self.mu_rows)}"
        return f"mu is {_value(self.mu)} 1/min over rows {_rows(self.mu_rows)}, where the pump was off; {net}"


def _value(p: Parameter) -> str:
    return f"{p.value:.5f} (95 % {p.low:.5f} to {p.high:.5f})"


def _rows(rows: tuple[int, int]) -> str:
    return f"{rows[0]}-{rows[1] - 1}"


def growth_alone(raw: Series) -> GrowthAlone | None:
    """Estimate mu and net growth of a recording that does not identify tau; None without enough readings.

    Raises: ValueError if no trustworthy readings are left.
    """
    screened = screen(raw)
    whole = screened.series.part(*longest(screened))
    if not enough(whole):
        return None
    rests = [(a if a == 0 else a + SETTLED_ROWS, b) for a, b in runs(whole.pump_rate == 0.0)]
    parts = [whole.part(a, b) for a, b in rests if int((whole.od[a:b] > 0.0).sum()) >= MIN_READINGS]
    parts = [max(parts, key=lambda part: len(part.od))] if parts else []
    mu = [e.mu for e in estimate(parts)] if parts else []
    return GrowthAlone(
        net=_mean_slope(whole),
        net_rows=_span(whole),
        mu=mu[0] if mu else None,
        mu_rows=_span(parts[0]) if parts else None,
    )


def _mean_slope(series: Series) -> Parameter:
    """Return (ln y_end - ln y_start) per minute, from medians of five readings at each end."""
    seen = np.flatnonzero(series.od > OD_FLOOR)
    ends = seen[:START_READINGS], seen[-START_READINGS:]
    (first, last), (began, ended) = (
        [float(f(values[end])) for end in ends]
        for f, values in ((np.median, np.log(np.maximum(series.od, OD_FLOOR))), (np.mean, series.time))
    )
    noise = noise_sd(series) / float(np.nanmean(series.od))
    half = 1.96 * noise * float(np.sqrt(np.pi / START_READINGS)) / (ended - began)  # sd of a median: sqrt(pi/2n)
    slope = (last - first) / (ended - began)
    return Parameter(slope, slope - half, slope + half)


def _span(series: Series) -> tuple[int, int]:
    return int(series.row[0]), int(series.row[-1]) + 1
