"""Checks of an estimate of tau, and estimates without tau."""

from dataclasses import dataclass

import numpy as np

from envs.identification.drift import longest
from envs.identification.model import MIN_READINGS, WORST_CONDITION, NotIdentifiable, Parameter
from envs.identification.prediction_error import Estimate, enough, estimate
from envs.identification.screening import OD_FLOOR, Series, noise_sd, runs, screen
from envs.identification.validation import START_READINGS

__all__ = ["GrowthAlone", "check_estimate", "growth_alone"]

PLAUSIBLE_MU = (0.001, 0.06)  # 1/min, doubling in 11 h to 12 min
FASTEST_MU = 0.1  # 1/min; no bacterium doubles in less than 7 min
POSSIBLE_TAU = (0.01, 10.0)  # a pump of 1 mL/s at 0.6 to 600 mL
WIDEST_TAU = 0.3  # half width of 1/tau over its value, of a pair that is returned
STEEPEST_HILLS = 3.0  # spread of 1/tau between points of the noise model over that within one
NARROW = 0.1  # half width of an interval over its value, below which hills do not matter
SETTLED_ROWS = 2  # after a dose, which the readings may show with a delay


def check_estimate(found: Estimate, series: Series) -> None:
    """Refuse an unreliable estimate.

    With a proportional controller (u = u0 + c (x - r)) the correlation of readings hides the dose's effect: mu is many
    times too high, with a narrow interval. Signs are a wide tau, a 1/tau that may be zero, an impossible mu, or a 1/tau
    that differs between likely noise models.

    Raises: NotIdentifiable.
    """
    rows = f"rows {series.row[0]}-{series.row[-1]}"
    k, mu = found.inverse_tau, found.mu
    if mu.low > FASTEST_MU and not found.quality.answers:  # else the pump's answers may make mu look so large
        raise NotIdentifiable(
            f"{rows}: mu = {mu.value:.3g} 1/min, a doubling in {np.log(2.0) / mu.value:.2g} min: no culture grows so",
            "check the unit of time (time_unit=)",
        )
    if k.low > 0.0 and not POSSIBLE_TAU[0] <= 1.0 / k.value <= POSSIBLE_TAU[1]:
        raise NotIdentifiable(
            f"{rows}: tau = {1.0 / k.value:.3g}: allowed {POSSIBLE_TAU[0]:g} to {POSSIBLE_TAU[1]:g}",
            "check the unit of the doses or of the pump's rate (pump_ml_s=)",
        )
    if found.condition > WORST_CONDITION:
        raise NotIdentifiable(f"{rows}: the pump's rate hardly changes, so growth and dilution cannot be told apart")
    if k.half_width > 10.0 * abs(k.value):
        raise NotIdentifiable(f"{rows}: 1/tau may be anything: they hold too little dilution to tell it from growth")
    if k.low <= 0.0 or k.half_width > WIDEST_TAU * k.value:
        raise NotIdentifiable(
            f"{rows}: 1/tau = {k.value:.3g} with the 95 % interval {k.low:.3g} to {k.high:.3g}; allowed within "
            f"+-{100 * WIDEST_TAU:.0f} %: they do not determine tau: too little dilution that is not an answer to the "
            "readings, too much noise, or a culture that drifts"
        )
    if found.quality.hills > STEEPEST_HILLS and k.half_width > NARROW * k.value:
        raise NotIdentifiable(
            f"{rows}: 1/tau = {k.value:.3g} (95 % {k.low:.3g} to {k.high:.3g}) hangs on what is taken for noise: it "
            f"spreads {found.quality.hills:.1f} times as far between noise models as within one; allowed "
            f"{STEEPEST_HILLS:g} times: the pump only answers the readings"
        )
    if found.quality.answers and not PLAUSIBLE_MU[0] <= mu.value <= PLAUSIBLE_MU[1]:
        raise NotIdentifiable(
            f"{rows}: mu = {mu.value:.3g} 1/min, allowed {PLAUSIBLE_MU[0]:g} to {PLAUSIBLE_MU[1]:g} where the pump "
            "answers the readings: growth and dilution cannot be told apart"
        )


@dataclass(frozen=True)
class GrowthAlone:
    """Estimates of rows that do not identify tau, 1/min; rows are [first, end).

    net: increase of ln x over the longest trustworthy stretch. mu: of the longest stretch without pumping, None if that
    is too short.
    """

    net: Parameter
    net_rows: tuple[int, int]
    mu: Parameter | None
    mu_rows: tuple[int, int] | None

    def words(self) -> str:
        """One sentence."""
        net = f"the culture's net growth is {_value(self.net)} 1/min over rows {_rows(self.net_rows)}"
        if self.mu is None or self.mu_rows is None:
            return net
        if self.mu_rows == self.net_rows:
            return f"mu alone is {_value(self.mu)} 1/min over rows {_rows(self.mu_rows)}"
        return f"mu alone is {_value(self.mu)} 1/min over rows {_rows(self.mu_rows)}, where the pump rested; {net}"


def _value(p: Parameter) -> str:
    return f"{p.value:.5f} (95 % {p.low:.5f} to {p.high:.5f})"


def _rows(rows: tuple[int, int]) -> str:
    return f"{rows[0]}-{rows[1] - 1}"


def growth_alone(raw: Series) -> GrowthAlone | None:
    """Fit mu and the net growth of a recording that does not identify tau; None without enough readings.

    Raises: ValueError when no trustworthy readings are left.
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
