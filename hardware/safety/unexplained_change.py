"""Changes of the OD that growth, doses and noise do not explain: single steps, and drifts by cumulated sums."""

import math

import numpy as np

from hardware.reactor import Array, Mask
from hardware.safety import messages
from hardware.safety.config import SafetyConfig
from hardware.safety.readings import Finding

GAIN_MIN, GAIN_MAX = 0.5, 1.6  # smallest and largest volume delivered, over that of the calibration
ACCEPT_UP, ACCEPT_DOWN = 6, 3  # consistent readings after which a step is accepted; bubbles last up to five
PERSISTENCE = 3  # samples in a row


class UnexplainedChange:
    """The newest accepted reading of N reactors, the doses since, and the changes that they do not explain.

    A culture makes no step. A step is accepted only if enough later readings agree with it: a bubble disappears, a
    moved vial stays. A change small enough to be growth or dilution goes into three one-sided cumulated sums (CUSUM):
    `excess` (ln OD rises more than the doses allow), `deficit` (ln OD falls more than the doses explain) and `futile`
    (ln OD does not fall at full feed). An alarm of `futile` lasts until the feed is no longer full, the setpoint is
    reached, or OD falls.
    """

    remembers = (
        "_od", "_at", "_since_ml", "_since_low_ml", "_suspect", "_suspect_at", "_suspects", "_mu",
        "_excess", "_deficit", "_futile", "_over", "_helpless_od", "_eased", "_doubt_ml",
    )  # fmt: skip

    def __init__(self, config: SafetyConfig, max_rate: float, tube_ml: Array) -> None:
        self._config, self._max_rate, self._tube_ml, n = config, max_rate, tube_ml, len(tube_ml)
        self._od, self._at = np.full(n, math.nan), np.full(n, math.nan)  # newest accepted reading and its minute
        self._since_ml, self._since_low_ml = np.zeros(n), np.zeros(n)  # dosed since then, at most and at least
        self._suspect, self._suspect_at = np.full(n, math.nan), np.full(n, math.nan)  # newest reading after a step
        self._suspects = np.zeros(n)  # readings in a row that agree with one another, not with `_od`
        self._mu = np.full(n, config.mu_max)  # slow estimate of the growth rate
        self._excess, self._deficit, self._futile = np.zeros(n), np.zeros(n), np.zeros(n)
        self._over = np.zeros((n, 3))  # samples in a row for which each of the three was over its limit
        self._helpless_od = np.full(n, math.nan)  # highest OD since full feed was found insufficient; else nan
        self._doubt_ml = np.zeros(n)  # dosed since the excess was 0
        self._eased = np.zeros(n)  # samples in a row that show full feed to be sufficient

    def check(self, reading: Array, time_s: Array, believed: Mask, setpoint: Array) -> list[Finding]:
        """Judge the readings of the `believed` rows: OD, the times they were taken, s, and setpoint, each (N,)."""
        od, t, before = np.where(believed, reading, math.nan), time_s / 60.0, self._od
        step, down, suspects, settled = self._steps(od, t)
        self._suspect, self._suspect_at = np.where(step, od, self._suspect), np.where(step, t, self._suspect_at)
        first = believed & np.isnan(before)
        usual = believed & ~step & ~first
        seen = {"before": before, "od": od}
        findings = [
            Finding(messages.JumpFault, step & ~down, seen),
            Finding(messages.FallsFault, step & down, seen, cool=settled & down),
            *self._accumulate(od, t, usual, setpoint),
        ]
        taken = first | usual | settled
        self._excess, self._deficit = (np.where(settled, 0.0, s) for s in (self._excess, self._deficit))
        self._suspects = np.where(settled, 0, suspects)
        self._od, self._at = np.where(taken, od, before), np.where(taken, t, self._at)
        self._since_ml, self._since_low_ml = (np.where(taken, 0.0, ml) for ml in (self._since_ml, self._since_low_ml))
        return findings

    def takes(self, reading: Array, time_s: Array, believed: Mask) -> Mask:
        """Return the `believed` rows whose reading `check` would accept; arguments as there, changes nothing."""
        step, _, _, settled = self._steps(np.where(believed, reading, math.nan), time_s / 60.0)
        return np.asarray(believed & (~step | settled))

    def _steps(self, od: Array, t: Array) -> tuple[Mask, Mask, Array, Mask]:
        """Return rows with a step, rows below the band, agreeing steps in a row, and rows where these suffice.

        Args: od: valid readings, else nan, shape (N,). t: times at which they were taken, min, shape (N,).
        """
        known = np.isfinite(od)
        with np.errstate(invalid="ignore"):
            low, high = self._band(self._od, t - self._at)
            step = known & ~np.isnan(self._od) & ~((od >= low) & (od <= high))
            near_low, near_high = self._band(self._suspect, t - self._suspect_at)
            consistent = (od >= near_low) & (od <= near_high)
            down = od < low
        suspects = np.where(step, np.where(consistent, self._suspects + 1, 1), np.where(known, 0, self._suspects))
        return step, down, suspects, step & (suspects >= np.where(down, ACCEPT_DOWN, ACCEPT_UP))

    def _band(self, od: Array, minutes: Array) -> tuple[Array, Array]:
        """Return the lowest and highest reading that growth, doses since then, and noise can make of `od`."""
        c = self._config
        tolerance = np.maximum(c.jump, c.jump_fraction * np.abs(od))
        base = np.maximum(od, 0.0)
        low = base * np.exp(-GAIN_MAX * self._since_ml / self._tube_ml - c.death * minutes) - tolerance
        high = base * np.exp(np.minimum(c.mu_max * minutes, 5.0)) + tolerance
        return low, high

    def _accumulate(self, od: Array, t: Array, usual: Mask, setpoint: Array) -> list[Finding]:
        """Update the cumulated sums of changes of ln OD that neither growth nor doses explain.

        x is the change of ln OD in dt minutes, d = dosed / volume. A working pump gives x <= mu dt - gain_min d with
        the smallest possible d. No culture gives x < -gain_max d - death dt with the largest possible d. mu is a slow
        estimate (60 min) plus 0.01 1/min. At full feed (0.8 of the largest rate and more) x must be below -0.004 dt,
        or the culture outgrows the pump.
        """
        c = self._config
        with np.errstate(invalid="ignore", divide="ignore"):
            usual = usual & (od > 0.05) & (self._od > 0.05)
            dt = np.where(usual, np.maximum(t - self._at, 1e-3), 1.0)
            x = np.where(usual, np.log(np.where(usual, od / self._od, 1.0)), 0.0)
        d, least = self._since_ml / self._tube_ml, self._since_low_ml / self._tube_ml
        cap = np.minimum(c.mu_max, self._mu + 0.01)
        rise = np.where(least > 0.0, x - cap * dt + GAIN_MIN * least, np.minimum(x - c.mu_max * dt, 0.0))
        fall = -x - GAIN_MAX * d - c.death * dt
        full = least / dt >= 0.8 * self._max_rate * 60.0 / self._tube_ml
        excess = np.where(usual, np.maximum(self._excess + rise, 0.0), self._excess)
        deficit = np.where(usual, np.maximum(self._deficit + fall, 0.0), self._deficit)
        futile = np.where(full, np.maximum(self._futile + x + 0.004 * dt, 0.0), 0.0)
        futile = np.where(usual, futile, self._futile)
        weight = np.where(usual, 1.0 - np.exp(-dt / 60.0), 0.0)
        self._mu = self._mu + weight * (np.clip((x + d) / dt, 0.0, c.mu_max) - self._mu)
        level = np.where(usual, od, 1.0)
        limit = c.drift + 6.0 * np.hypot(c.noise_od, c.noise_fraction * level) / level
        sums = np.stack([excess, deficit, futile], axis=1)
        over = np.where(sums > limit[:, None], self._over + 1, 0)  # a single outlier exceeds it only once
        self._over = np.where(usual[:, None], over, self._over)
        rising, falling, futile_now = (self._over >= PERSISTENCE).T & usual
        short = full & (od > setpoint * (1.0 + c.drift))
        helpless = self._lasting(futile_now & ~rising & short, od, usual, short, limit)
        began = usual & (self._excess <= 0.0)
        doubt_ml = self._doubt_ml = np.where(began, 0.0, self._doubt_ml) + np.where(usual, self._since_ml, 0.0)
        self._excess, self._deficit = np.where(rising, 0.0, excess), np.where(falling, 0.0, deficit)
        self._futile = np.where((futile_now & short) | rising, 0.0, futile)
        return [
            Finding(messages.NoDilutionFault, rising, {"above": excess, "doubt_ml": doubt_ml}, rising),
            Finding(messages.SlowFallFault, falling, {"below": deficit}, falling),
            Finding(messages.CannotHoldFault, helpless & np.isfinite(od), {"setpoint": setpoint}),
        ]

    def _lasting(self, begins: Mask, od: Array, usual: Mask, short: Mask, limit: Array) -> Mask:
        """Return reactors whose full feed does not reach the setpoint, from an alarm of the sum until it has eased."""
        highest = np.fmax(self._helpless_od, np.where(usual, od, -math.inf))
        lasts = np.isfinite(self._helpless_od)
        with np.errstate(invalid="ignore", divide="ignore"):
            falls = lasts & (np.log(od / highest) < -limit)
        self._eased = np.where(usual, np.where(lasts & (~short | falls), self._eased + 1, 0), self._eased)
        ends = lasts & (self._eased >= PERSISTENCE)
        self._helpless_od = np.where(ends, math.nan, np.where(lasts & usual, highest, self._helpless_od))
        self._helpless_od = np.where(begins & ~lasts, od, self._helpless_od)
        return np.asarray(np.isfinite(self._helpless_od))

    def refilled(self, row: int) -> None:
        """Forget the evidence for an empty bottle."""
        self._excess[row] = self._over[row, 0] = self._since_low_ml[row] = 0.0

    def dosed(self, feed_ml: Array, low_ml: Array) -> None:
        self._since_ml, self._since_low_ml = self._since_ml + feed_ml, self._since_low_ml + low_ml
