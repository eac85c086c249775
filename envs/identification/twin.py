"""Twin of a recorded culture, a plant fitted to it: mu(t), tau(t), sensor noise, random errors of doses, outliers.

k(t) = 1/tau(t) is a smooth curve through the estimates of the segments, which are valid for every pump control. With
the doses corrected by k(t), the remaining change of the readings is growth,

    g_i = ln y_i + sum over j < i of k(t_j) c_j = b + integral of mu + s_i + v_i,     c_j = u_j dt_j

s is a random walk by the random errors of the doses, v the noise of the readings; the sizes of both come from the
estimate of the window. mu(t) is a smooth curve like k(t): a line plus a random walk, whose size is estimated.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.model import Parameter
from envs.identification.screening import OD_FLOOR, WEEK_MIN, Series
from envs.identification.validation import START_READINGS
from envs.identification.verdict import Calibration

Array = NDArray[np.float64]

FEWEST_SEGMENTS = 4  # segments with an estimate of tau; with fewer, tau is constant
WANDER = np.concatenate([[0.0], np.geomspace(0.005, 0.3, 12)])  # sizes of the random walk: sd after 1 h over the mean
FLAT = 25.0  # prior variance of levels, and of both coefficients of a line relative to the mean: very wide
BLOCKS = 400  # largest number of blocks of rows; their means are compared with mu(t)
EXACT = 1e-8  # smallest variance of ln y of a reading: 0.01 % of the OD
OUTLIER_OD = 0.04  # smallest deviation of an outlier (docs/biology.md, Sensor)


@dataclass(frozen=True, eq=False)
class Course:
    """Values of a parameter at the J knots with the 95 % band low to high; linear between the knots."""

    value: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Noise:
    """Noise of the readings and the doses.

    floor, relative: the sd of a reading is hypot(floor, relative * OD). lag1: correlation of the noise from row to row.
    dose_cv: sd of a dose relative to its mean. outlier_rate: fraction of readings that are off by 0.04 OD or more.
    """

    floor: float
    relative: float
    lag1: float
    dose_cv: float
    outlier_rate: float


@dataclass(frozen=True, eq=False)
class Twin:
    """Plant fitted to a recording.

    knot_min: min from the first trustworthy row to each knot, (J,). start_od: OD at the first row. rows: row numbers
    [first, end). row_min: median time between rows, min. drifts: whether tau(t) may vary."""

    knot_min: Array
    mu: Course
    tau: Course
    noise: Noise
    start_od: float
    rows: tuple[int, int]
    row_min: float
    drifts: bool


def twin(raw: Series, result: Calibration, knot_every_min: float) -> Twin:
    """Fit a plant to all trustworthy rows of a calibrated recording, with a knot about every `knot_every_min` min.

    For a recording of more than a week, fit only the rows of the window.

    Args: raw: the recording before screening, with the same rows as in `result`.
    """
    edges = result.screened.stretches
    first, end = edges[0][0], edges[-1][1]
    if np.ptp(result.screened.series.time[[first, end - 1]]) > WEEK_MIN:
        first, end = result.window
        edges = tuple((max(a, first), min(b, end)) for a, b in edges if a < end and b > first)
    part = result.screened.series.part(first, end)
    minutes = float(part.time[-1] - part.time[0])
    knots = np.linspace(0.0, minutes, max(2, round(minutes / knot_every_min) + 1))
    k, k_cov, drifts = _inverse_tau(result, knots + part.time[0])
    rows = _Rows(part, [a - first for a, _ in edges], knots)
    q = result.estimate.quality
    outliers = _outliers(rows, k, raw.part(first, end))
    noise = Noise(q.noise_floor, q.noise_relative, q.noise_lag1, q.dose_spread.value, outliers)
    mu, mu_cov = _growth(rows, k, k_cov, noise, result.mu.value)
    mu_sd, k_sd = (1.96 * np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (mu_cov, k_cov))
    started = (rows.grown(k) - rows.elapsed @ mu)[rows.seen][:START_READINGS]
    return Twin(
        knot_min=knots,
        mu=Course(mu, mu - mu_sd, mu + mu_sd),
        tau=Course(1.0 / k, 1.0 / (k + k_sd), 1.0 / np.maximum(k - k_sd, 0.2 * k)),
        noise=noise,
        start_od=float(np.exp(np.median(started))),
        rows=(int(part.row[0]), int(part.row[-1]) + 1),
        row_min=float(np.median(np.diff(part.time))),
        drifts=drifts,
    )


class _Rows:
    """The n screened rows and, up to each row, integrals of the J hat functions of the knots, shape (n, J).

    elapsed: integral of the hat, min. pumped: of pump rate times hat, mL/s min. stretch: stretch index of each row.

    Args: part: the rows. starts: positions at which a stretch begins. knots: min after the first row, (J,).
    """

    def __init__(self, part: Series, starts: list[int], knots: Array) -> None:
        self.part = part
        time = part.time - part.time[0]
        self.step = np.diff(time, append=time[-1])
        self.hats = np.stack([np.interp(time + 0.5 * self.step, knots, h) for h in np.eye(len(knots))], axis=1)
        self.knot_h = knots / 60.0
        self.elapsed = _summed(self.step[:, None] * self.hats)
        self.pumped = _summed((part.pump_rate * self.step)[:, None] * self.hats)
        self.stretch = np.searchsorted(starts, np.arange(len(time)), side="right") - 1
        self.seen = part.od > OD_FLOOR
        self.log_od = np.log(np.where(self.seen, part.od, 1.0))
        size = -(-len(time) // BLOCKS)
        self.blocks = np.unique(np.concatenate([starts, np.arange(0, len(time), size)]))
        count = np.add.reduceat(self.seen, self.blocks, dtype=np.float64)
        self.full, self.count = count > 0.0, count[count > 0.0]

    def means(self, values: Array) -> Array:
        """Return the means of values (n, C) over the readings of each block, (blocks, C), without empty blocks."""
        sums = np.add.reduceat(np.where(self.seen[:, None], values, 0.0), self.blocks, axis=0)
        return np.asarray(sums[self.full] / self.count[:, None])

    def grown(self, k: Array) -> Array:
        """Compute g of the module's docstring, shape (n,); linear between readings."""
        at = np.flatnonzero(self.seen)
        return np.asarray(np.interp(np.arange(len(self.seen)), at, (self.log_od + self.pumped @ k)[at]))

    def doses(self, k: Array) -> Array:
        """Return the decrease of ln y by each row's dose, shape (n,)."""
        return np.asarray(self.part.pump_rate * self.step * (self.hats @ k))


def _summed(steps: Array) -> Array:
    """Return the sum of the steps of all earlier rows, shape (n, J)."""
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps[:-1], axis=0)])


def _curve(at_h: Array, mean: float, seen: Array, towards: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Fit a line plus a random walk at P points to n linear observations, averaged over the size of the walk.

    Args: at_h: the points, hours, (P,). mean: scale of the curve. seen: observations, (n,). towards: weights of the
      points in each observation, (n, P). noise: covariance of the observations' errors, (n, n).
    Returns: the curve (P,), its covariance (P, P), and its derivative by `seen`, (P, n).
    """
    since = at_h - at_h.min()
    scores, gains, left = [], [], []
    for wander in WANDER:
        prior = mean**2 * (FLAT * (1.0 + np.outer(since, since)) + wander**2 * np.minimum.outer(since, since))
        own = towards @ prior @ towards.T + noise
        gain = np.linalg.solve(own, towards @ prior).T
        surprise = seen - mean * towards.sum(axis=1)
        scores.append(-0.5 * (np.linalg.slogdet(own)[1] + surprise @ np.linalg.solve(own, surprise)))
        gains.append(gain)
        left.append(prior - gain @ towards @ prior)
    share = np.exp(np.array(scores) - max(scores))
    share /= share.sum()
    curves = [mean + gain @ surprise for gain in gains]
    gain = np.tensordot(share, gains, 1)
    curve = share @ np.array(curves)
    spread = [c + np.outer(each - curve, each - curve) for c, each in zip(left, curves, strict=True)]
    return curve, np.tensordot(share, spread, 1), gain


def _inverse_tau(result: Calibration, at: Array) -> tuple[Array, Array, bool]:
    """Estimate k at times `at`, min, (J,), its covariance (J, J), and whether its drift is identifiable.

    Before the first and after the last segment with an estimate of tau, k is constant.
    """
    known = [(s.middle_min, s.tau) for s in result.segments if s.tau is not None]
    if len(known) < FEWEST_SEGMENTS:
        constant, sd = _inverse(result.tau)
        return np.full(len(at), constant), np.full((len(at), len(at)), sd**2), False
    middle = np.array([m for m, _ in known])
    value, deviation = np.array([_inverse(p) for _, p in known]).T
    points = np.concatenate([middle, np.clip(at, middle[0], middle[-1])]) / 60.0
    towards = np.eye(len(middle), len(points))
    mean = float(np.average(value, weights=deviation**-2.0))
    k, spread, _ = _curve(points, mean, value, towards, np.diag(deviation**2))
    return k[len(middle) :], spread[len(middle) :, len(middle) :], True


def _inverse(tau: Parameter) -> tuple[float, float]:
    """Return 1/tau and its sd."""
    return 1.0 / tau.value, (1.0 / tau.low - 1.0 / tau.high) / 3.92


def _growth(rows: _Rows, k: Array, k_cov: Array, noise: Noise, mean: float) -> tuple[Array, Array]:
    """Estimate mu at the knots, (J,), from means of blocks, and its covariance, which includes that of k."""
    walked = rows.means(_summed(((noise.dose_cv * rows.doses(k)) ** 2)[:, None]))[:, 0]
    reading = np.hypot(noise.floor / np.where(rows.seen, rows.part.od, 1.0), noise.relative)
    longer = (1.0 + noise.lag1) / (1.0 - noise.lag1)
    level = rows.means((rows.stretch[:, None] == np.arange(rows.stretch.max() + 1)).astype(np.float64))
    error = FLAT * level @ level.T + np.minimum.outer(walked, walked)
    error += np.diag(longer * rows.means(reading[:, None] ** 2)[:, 0] / rows.count + EXACT)
    grown = rows.grown(k)
    mu, spread, gain = _curve(
        rows.knot_h, mean, rows.means((grown - grown.mean())[:, None])[:, 0], rows.means(rows.elapsed), error
    )
    by_k = gain @ rows.means(rows.pumped)
    return mu, spread + by_k @ k_cov @ by_k.T


def _outliers(rows: _Rows, k: Array, raw: Series) -> float:
    """Return the fraction of all readings that were rejected and are far from the fitted curve."""
    rejected = np.isfinite(raw.od) & ~np.isfinite(rows.part.od)
    far = np.abs(raw.od - np.exp(rows.grown(k) - rows.pumped @ k)) >= OUTLIER_OD
    return float((rejected & far).sum() / np.isfinite(raw.od).sum())
