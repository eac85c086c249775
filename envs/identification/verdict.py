"""Result of a calibration: the pair with its intervals, all other findings, and the verdict.

Without a pair: `refusal`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.drift import SHORTEST_WINDOW_MIN, Drift, Segment
from envs.identification.free_run import Fit
from envs.identification.model import REMEDY, Parameter
from envs.identification.prediction_error import Estimate, Quality
from envs.identification.refusal import NARROW, PLAUSIBLE_MU
from envs.identification.screening import Screened, Series
from envs.identification.validation import Validation

__all__ = ["Calibration", "Verdict", "judged"]

Array = NDArray[np.float64]

PLAUSIBLE_TAU = (0.05, 2.0)
UNEVEN = 0.25  # sd of a dose over its size
SLOW_ROWS_MIN = 2.0  # a pump rate that changes between rows biases the estimate
UNSTEADY = 0.15  # sd of the mean growth over an hour, over mu
UNSEEN = 0.5  # fraction of a dose missing from the next reading
CORRELATED = 0.2  # of innovations from row to row
AGAIN = "calibrate again shortly before the run, or fly the policy that ships (policy=shipped), which needs no pair"


@dataclass(frozen=True)
class Verdict:
    """word: use, use with care, record again or read again. why: one clause. then: what to do next, "" for training."""

    word: str
    why: str
    then: str

    def line(self) -> str:
        """Line on the screen."""
        return f"{self.word}: {self.why}" + (f"; {self.then}" if self.then else "")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`. Positions refer to `screened.series`; window is [first, end).

    mu, tau: the returned pair, by `method`. estimate, free_run: of the window by either method, None without such a
    fit; sound: whether the estimate identifies tau. model: free run of the returned pair over the window from the start
    that fits best, OD, shape (n,). pair_pmse_pct: its PMSE. pmse_pct: of the free-run fit, the paper's figure; of the
    pair where there is no such fit.
    warnings: reasons against the pair, the most serious first.
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
        """Readings in the window."""
        return int(np.isfinite(self.inside.od).sum())


def judged(
    result: Calibration, limit: float, doubts: tuple[tuple[str, str], ...] = ()
) -> tuple[Verdict, tuple[str, ...]]:
    """Judge a fit: the verdict, and all reasons against the fit, the most serious first.

    Args: limit: of predictions, PMSE in %. doubts: about the recording, each with a remedy.
    """
    against = [*doubts, *_against(result, limit)]
    mu, tau = (100.0 * p.half_width / p.value for p in (result.mu, result.tau))
    known = f"mu is known within +-{mu:.2g} % and tau within +-{tau:.2g} %"
    if not against:
        return Verdict("use", f"{known}; no check objects", ""), ()
    what, then = against[0]
    more = f" ({len(against) - 1} more below)" if len(against) > 1 else ""
    return Verdict("use with care", f"{known}; {what}{more}", then), tuple("; ".join(a) for a in against)


def _against(result: Calibration, limit: float) -> Iterator[tuple[str, str]]:
    """Yield pairs (problem, remedy)."""
    mu, tau = result.mu, result.tau
    for name, value, (low, high) in (("mu", mu.value, PLAUSIBLE_MU), ("tau", tau.value, PLAUSIBLE_TAU)):
        if not low <= value <= high:
            said = f"{name} = {value:.3g} lies outside the usual {low:g} to {high:g}"
            yield said, "check the units of time and pump rate"
    found = result.estimate
    if result.method == "free_run":
        if not result.sound or found.quality.answers:
            yield (
                "the pump answers the readings, and a free run then shrinks mu and 1/tau without a sign",
                "use identify.method=prediction_error",
            )
        if result.pmse_pct > limit:
            yield (
                f"PMSE {result.pmse_pct:.2g} % exceeds {limit:.2g} %: one pair does not describe these rows",
                "choose a shorter window by rows=FIRST:END",
            )
    inside = result.inside.time
    apart = float(np.median(np.diff(inside)))
    if apart > SLOW_ROWS_MIN:
        yield f"rows are {apart:.3g} min apart", "record every minute, or every change of the pump's rate"
    if inside[-1] - inside[0] < SHORTEST_WINDOW_MIN:
        said = f"the window lasts {inside[-1] - inside[0]:.0f} min"
        yield said, f"record for {SHORTEST_WINDOW_MIN:.0f} min at least"
    for name, line in (("mu", result.drift_mu), ("tau", result.drift_tau)):
        if line is not None and line.notable:
            yield (
                f"{name} drifts from {line.first:.3g} to {line.last:.3g} ({line.change_pct:+.0f} %) on the way",
                AGAIN,
            )
    v = result.validation
    worst = max(2.0 * (v.early_pct or 0.0), limit)
    for where, missed in (("the window's last 30 %", v.holdout_pct), ("the rows outside the window", v.outside_pct)):
        if missed is not None and missed > worst:
            yield f"{where} are predicted with a PMSE of {missed:.2g} %, allowed {worst:.2g} %", AGAIN
    if any(p.half_width > NARROW * p.value for p in (mu, tau)):
        yield f"an interval wider than +-{100.0 * NARROW:.0f} % decides little", REMEDY
    if result.sound:
        yield from _about_bench_and_culture(found.quality)
        if abs(found.quality.autocorrelation) > CORRELATED:
            yield (
                f"what each reading adds correlates with the one before ({found.quality.autocorrelation:.2f}), so that "
                "the intervals may be too narrow",
                "look at figures/fit.png for what the culture does there",
            )


def _about_bench_and_culture(q: Quality) -> Iterator[tuple[str, str]]:
    """Yield problems of bench and culture, by the lower end of each interval."""
    if q.growth_spread.low > UNSTEADY:
        yield f"growth rate fluctuates by {100.0 * q.growth_spread.low:.0f} % at least from hour to hour", AGAIN
    if q.dose_spread.low > UNEVEN:
        said = f"doses spread by {100.0 * q.dose_spread.low:.0f} % at least"
        yield said, "look at the feed's tube and needle, and measure the pump (python -m experiments.calibrate_pump)"
    if q.late_share.low > UNSEEN:
        said = f"the next reading does not see {100.0 * q.late_share.low:.0f} % of a dose at least"
        yield said, "stir faster, or feed earlier before a reading"
