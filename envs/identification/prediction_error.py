"""Growth rate mu and dilution constant tau by the prediction-error method: unbiased also when the pump answers the OD.

A free run from one start takes every disturbance for noise of the sensor. Under feedback the pump answers to those
disturbances, pump and error are correlated, and least squares shrinks mu and 1/tau. Here the model has the disturbances
in it, and each reading is compared with what all readings before it say about it:

    ln y_i = b + mu t_i - k C_i + g c_{i-1} + s_i + sigma r_i v_i     k = 1/tau, c_i = u_i dt_i, C_i = sum_{j<i} c_j
    s_{i+1} = s_i + w_i dt_i + sigma d (c_i / c_rms) xi_i             doses that spread
    w_{i+1} = a w_i + sqrt(1 - a^2) sigma om eta_i,  a = exp(-dt/T)   growth that wanders
    v_{i+1} = phi v_i + sqrt(1 - phi^2) nu_i                          reading noise, correlated from row to row

with xi, eta, nu independent standard normal, r = (x/x_mean)^(p-1) (p = 1: noise in proportion to the OD, p = 0: the
same at every OD; x is a running median, never the reading itself), and g/k in [0, 1] the share of a dose that is seen
one row late. A rate chosen from reading i acts from row i on. For given (p, d, om, T, phi, g/k) this is generalised
least squares: one Kalman filter over the columns ln y, 1, t, -C, c_{i-1} with shared gains. All points of a grid are
filtered at once and averaged by their restricted likelihood and a prior flat in tau: neither optimiser nor local
minimum (docs/calibration.md, Method).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from envs.identification.model import Parameter
from envs.identification.screening import OD_FLOOR, Series, pumped_volume, running_median

__all__ = ["QUICK", "WORST_CONDITION", "Estimate", "Quality", "enough", "estimate", "outliers"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

P = (0.0, 1.0)
DOSE = (0.0, 0.15, 0.4, 1.0, 2.5, 6.0)
WANDER = (
    0.0,
    0.03,
    0.08,
    0.2,
    0.5,
)  # 0 must be there: without it a quiet recording under feedback is biased by 4 to 9 %
CORRELATION_MIN = (10.0, 40.0, 160.0)
PHI = (0.0, 0.15, 0.4, 0.75)
LATE_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of a dose, seen one row late
LEVEL_ROWS = 5  # of the running median that stands for the OD level
COLUMNS = 5  # ln y, 1, t, -C, c_{i-1}
MU, K, LATE = 1, 2, 3  # positions among the four regressors
KEPT_CELLS = 64  # of the average; the others weigh nothing
TINY = 1e-300
FEWEST_READINGS = 10

OUTLIER_SD = 4.5
OUTLIER_PASSES = 3
OUTLIER_NEIGHBOURS = 2  # on each side: an outlier makes its neighbours look wrong as well


@dataclass(frozen=True, eq=False)
class _Cells:
    """Points (p, d, om, T, phi) of the grid, each of shape (G,)."""

    p: Array
    dose: Array
    wander: Array
    correlation: Array
    phi: Array

    def chosen(self, which: NDArray[np.int64]) -> "_Cells":
        """One cell for each of M series, `which` of shape (M,): arrays of shape (M, 1)."""
        return _Cells(*(a[which][:, None] for a in (self.p, self.dose, self.wander, self.correlation, self.phi)))


def _grid(*axes: tuple[float, ...]) -> _Cells:
    """All combinations of the axes' values."""
    return _Cells(*np.array(list(product(*axes))).T)


GRID = _grid(P, DOSE, WANDER, CORRELATION_MIN, PHI)  # T means nothing at om = 0: these cells count three times
QUICK = _grid(P, (0.0, 0.3, 1.0, 3.0), (0.0, 0.05, 0.15, 0.5), (40.0,), (0.0, 0.15, 0.4))  # for segments and outliers
CONFIDENCE = 0.95
WORST_CONDITION = 1e8  # of the scaled normal equations


@dataclass(frozen=True, eq=False)
class _Batch:
    """M series padded to n rows: what the filter walks over. Shapes (M, n), columns (M, n, 5).

    reading: True where there is one. dt: min to the next row, 0 in the padding. dose: c / c_rms. level: x / x_mean.
    scale: (M, 4), by which each regressor was divided. span: min between first and last row, (M,).
    """

    reading: Mask
    dt: Array
    dose: Array
    level: Array
    columns: Array
    scale: Array
    span: Array

    @property
    def n_readings(self) -> Array:
        """Readings of each series, shape (M,)."""
        return np.asarray(self.reading.sum(axis=1), dtype=np.float64)


def enough(part: Series) -> bool:
    """Whether a series has the readings that an estimate needs."""
    return int((part.od > OD_FLOOR).sum()) >= FEWEST_READINGS


def _batch(parts: list[Series]) -> _Batch:
    for part in parts:
        if not enough(part):
            raise ValueError(f"rows {part.row[0]}-{part.row[-1]}: fewer than {FEWEST_READINGS} readings above zero")
    n = max(len(part.od) for part in parts)
    m = len(parts)
    reading = np.zeros((m, n), dtype=np.bool_)
    dt, dose, level = np.zeros((m, n)), np.zeros((m, n)), np.ones((m, n))
    columns, scale, span = np.zeros((m, n, COLUMNS)), np.ones((m, COLUMNS - 1)), np.ones(m)
    for i, part in enumerate(parts):
        rows = len(part.od)
        usable = part.od > OD_FLOOR
        reading[i, :rows] = usable
        step = np.diff(part.time)
        dt[i, : rows - 1] = step
        volume = pumped_volume(part.time, part.pump_rate)
        each = np.diff(volume, append=volume[-1])
        dose[i, :rows] = each / max(float(np.sqrt(np.mean(each**2))), TINY)
        smooth = running_median(np.where(usable, part.od, np.nan), LEVEL_ROWS)
        smooth = np.where(np.isfinite(smooth), smooth, np.nanmean(smooth))
        level[i, :rows] = np.maximum(smooth, OD_FLOOR) / max(float(np.mean(smooth)), OD_FLOOR)
        log_od = np.log(np.where(usable, part.od, 1.0))
        columns[i, :rows, 0] = np.where(usable, log_od - log_od[usable].mean(), 0.0)
        columns[i, :rows, 1] = 1.0
        columns[i, :rows, 1 + MU] = part.time - part.time[0]
        columns[i, :rows, 1 + K] = -volume
        columns[i, 1:rows, 1 + LATE] = each[: rows - 1]
        span[i] = part.time[-1] - part.time[0]
        largest = np.abs(columns[i, :, 1:]).max(axis=0)
        scale[i] = np.where(largest > 0.0, largest, 1.0)
        columns[i, :, 1:] /= scale[i]
    return _Batch(reading, dt, dose, level, columns, scale, span)


@dataclass(frozen=True, eq=False)
class _Step:
    """One row of the filter: gain (4, M, G) before the row's own motion, variance (M, G), innovation (5, M, G)."""

    gain: Array
    variance: Array
    innovation: Array


class _Filter:
    """Kalman filter of (s, w, v, S), S' = S + w dt, over all columns with shared gains; sigma = 1.

    Args: batch: M series. cells: G points, arrays of shape (G,), or (M, 1) for a point of its own for each series.
    After `rows` has ended, `covariance` (4, 4, M, G) and `state` (4, 5, M, G) are those after the last row.
    """

    def __init__(self, batch: _Batch, cells: _Cells) -> None:
        self.batch, self.cells = batch, cells
        self.shape = np.broadcast_shapes((len(batch.dt), 1), cells.p.shape)
        self.stationary = np.broadcast_to(cells.wander**2, self.shape)
        self.covariance = np.zeros((4, 4, *self.shape))
        self.covariance[1, 1], self.covariance[2, 2] = self.stationary, 1.0
        self.state = np.zeros((4, COLUMNS, *self.shape))

    def rows(self) -> Iterator[_Step]:
        """The innovations of every row, 0 where there is no reading."""
        for i in range(self.batch.dt.shape[1]):
            seen, ratio = self.batch.reading[:, i, None], self.ratio(i)
            towards = self.covariance[:, 0] + ratio * self.covariance[:, 2]
            variance = np.where(seen, np.maximum(towards[0] + ratio * towards[2], 1e-12), 1.0)
            gain = np.where(seen, towards / variance, 0.0)
            expected = self.state[0] + ratio * self.state[2]
            innovation = np.where(seen, self.batch.columns[:, i].T[:, :, None] - expected, 0.0)
            yield _Step(gain, variance, innovation)
            self.covariance -= gain[:, None] * towards
            self.state += gain[:, None] * innovation
            self._move(i)

    def ratio(self, i: int) -> Array:
        """r of row i, shape (M, G)."""
        return np.where(self.cells.p == 1.0, 1.0, 1.0 / self.batch.level[:, i, None])

    def decay(self, i: int) -> Array:
        """a of row i, shape (M, G)."""
        return np.exp(-self.batch.dt[:, i, None] / self.cells.correlation)

    def _move(self, i: int) -> None:
        dt, decay = self.batch.dt[:, i, None], self.decay(i)
        for rows in (self.covariance, self.covariance.swapaxes(0, 1), self.state):
            gained = dt * rows[1]
            rows[0] += gained
            rows[3] += gained
            rows[1] *= decay
            rows[2] *= self.cells.phi
        self.covariance[0, 0] += (self.cells.dose * self.batch.dose[:, i, None]) ** 2
        self.covariance[1, 1] += (1.0 - decay**2) * self.stationary
        self.covariance[2, 2] += 1.0 - self.cells.phi**2


@dataclass(frozen=True, eq=False)
class _Solved:
    """Generalised least squares of every cell with every late share, together L = shares * G cells, shares outermost.

    best: coefficients of the four regressors (M, L, 4). spread: their covariance for sigma = 1 (M, L, 4, 4).
    rss: (M, L). score: logarithm of a cell's weight, up to a constant (M, L). drift: S after the last row of each
    column (M, L, 5), and its variance for sigma = 1 (M, L). degrees: n - q (M,). condition: of the normal equations,
    scaled, smallest of the cells (M,).
    """

    best: Array
    spread: Array
    rss: Array
    score: Array
    drift: Array
    drift_variance: Array
    degrees: Array
    condition: Array

    @cached_property
    def weight(self) -> Array:
        """Of each cell, shape (M, L), sums to 1."""
        weight = np.exp(self.score - self.score.max(axis=1, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _solve(batch: _Batch, cells: _Cells) -> _Solved:
    run = _Filter(batch, cells)
    log_variance = np.zeros(run.shape)
    products = np.zeros((COLUMNS, COLUMNS, *run.shape))
    for step in run.rows():
        log_variance += np.log(step.variance)
        white = step.innovation / np.sqrt(step.variance)
        products += white[:, None] * white
    gram = np.moveaxis(products, (0, 1), (-2, -1))
    merged = _with_late_shares(batch)
    back = merged.swapaxes(-1, -2)
    normal = back @ gram[:, None, :, 1:, 1:] @ merged
    target = (back @ gram[:, None, :, 1:, :1])[..., 0]
    size = np.sqrt(np.einsum("...ii->...i", normal))
    absent = size == 0.0  # no pump, no columns of a pump: their coefficients are 0
    size = np.where(absent, 1.0, size)
    unit = normal / (size[..., :, None] * size[..., None, :]) + absent[..., None] * np.eye(3)
    values, vectors = np.linalg.eigh(unit)
    values = np.maximum(values, 1e-14)
    vectors = vectors / size[..., :, None]
    spread = (vectors / values[..., None, :]) @ vectors.swapaxes(-1, -2)
    best = (spread @ target[..., None])[..., 0]
    rss = np.maximum(gram[:, None, :, 0, 0] - np.sum(best * target, axis=-1), 1e-12)
    degrees = np.maximum(batch.n_readings - (~absent).sum(axis=-1).max(axis=(1, 2)), 1.0)
    determinant = np.log(values).sum(axis=-1) + 2.0 * np.log(size).sum(axis=-1)
    score = -0.5 * (log_variance[:, None] + determinant + degrees[:, None, None] * np.log(rss))

    def flat(a: Array) -> Array:
        return a.reshape(len(a), -1, *a.shape[3:])

    return _Solved(
        best=flat((merged @ best[..., None])[..., 0]),
        spread=flat(merged @ spread @ back),
        rss=flat(rss),
        score=flat(score),
        drift=np.tile(np.moveaxis(run.state[3], 0, -1), (1, len(LATE_SHARES), 1)),
        drift_variance=np.tile(np.maximum(run.covariance[3, 3], 0.0), (1, len(LATE_SHARES))),
        degrees=degrees,
        condition=(values[..., -1] / values[..., 0]).min(axis=(1, 2)),
    )


@dataclass(frozen=True)
class Quality:
    """How well the model with disturbances describes its rows; a good fit has variance 1 and correlation 0.

    variance, autocorrelation, kurtosis: of the one-step innovations in units of their own predicted sd, at the
    likeliest cell. late_share: of a dose, seen one row late (g/k). dose_spread: sd of a dose over its mean size.
    growth_spread: sd of the wandering growth over mu. noise: sd of a reading relative to its OD at the mean OD.
    feedback: correlation of an innovation with the change of the pump rate made on it; answers: it is beyond chance,
    2/sqrt(n).
    """

    variance: float
    autocorrelation: float
    kurtosis: float
    late_share: float
    dose_spread: float
    growth_spread: float
    noise: float
    feedback: float
    answers: bool


@dataclass(frozen=True, eq=False)
class Estimate:
    """mu (mean over the rows) and tau of one series, None where the rows do not show it; both with 95 % intervals.

    condition: of the normal equations, scaled. expected: OD that the readings before each row and the pump predict, nan
    without a reading (n,). innovation: of each reading in units of its predicted sd, (n,).
    """

    mu: Parameter
    tau: Parameter | None
    inverse_tau: Parameter
    condition: float
    expected: Array
    innovation: Array
    quality: Quality


def _with_late_shares(batch: _Batch) -> Array:
    """Matrices (M, shares, 1, 4, 3) that turn coefficients of 1, t, and a dose's whole effect into the regressors'."""
    merged = np.zeros((len(batch.dt), len(LATE_SHARES), 1, 4, 3))
    merged[..., range(3), range(3)] = 1.0
    ratio = batch.scale[:, LATE] / batch.scale[:, K]
    merged[..., 0, LATE, K] = ratio[:, None] * np.array(LATE_SHARES)
    return merged


def estimate(parts: list[Series], cells: _Cells = GRID) -> list[Estimate]:
    """Fit each of M series alone; all of them in one pass.

    Intervals are quantiles of the mixture of the cells' Student t distributions. mu is the mean of the growth rate over
    the rows, mu + S_end/L with S the integral of w and L the rows' duration: that is what the rows can tell when growth
    wanders as slowly as the recording is long.

    Args: parts: screened series; readings may be nan, time and pump count throughout. cells: the grid; QUICK where
      many short parts are estimated and an interval decides nothing alone.
    Returns: one `Estimate` each, which need not be worth anything: see `calibration.refusal`.
    Raises: ValueError for a series with fewer than ten readings above zero.
    """
    batch = _batch(parts)
    solved = _flat_in_tau(_solve(batch, cells))
    likeliest = np.argmax(solved.weight, axis=1)
    traces = _traces(batch, cells.chosen(likeliest % len(cells.p)))
    found = []
    for m, part in enumerate(parts):
        cell, rows = likeliest[m], len(part.od)
        mu, inverse = _mean_growth(batch, solved, m), _mixture(batch, solved, m, K)
        error = traces.innovation[:rows, 0, m] - traces.innovation[:rows, 1:, m] @ solved.best[m, cell]
        sigma = float(np.sqrt(solved.rss[m, cell] / solved.degrees[m]))
        seen = batch.reading[m, :rows]
        innovation = np.where(seen, error / (sigma * np.sqrt(traces.variance[:rows, m])), np.nan)
        level = np.exp(-error) * np.where(seen, part.od, np.nan)
        pumped = bool((part.pump_rate[:-1] > 0.0).any())
        found.append(
            Estimate(
                mu=mu,
                tau=Parameter(1.0 / inverse.value, 1.0 / inverse.high, 1.0 / inverse.low)
                if pumped and inverse.low > 0.0
                else None,
                inverse_tau=inverse,
                condition=float(solved.condition[m]),
                expected=level,
                innovation=innovation,
                quality=_quality(batch, solved, cells, m, part, innovation, sigma, mu.value),
            )
        )
    return found


def _flat_in_tau(solved: _Solved) -> _Solved:
    """The same under a prior that is flat in tau = 1/k, that is k^-2; `_solve` is flat in k.

    Flat in k, 1/tau comes out 2 to 4 % too high where its interval is wide (docs/calibration.md). To second order in
    the relative variance the prior moves the coefficients by -2 cov(., k)/k and multiplies a cell's weight by
    k^-2 (1 + 3 var k/k^2). A relative variance counts up to 10 %; what is wider is refused.
    """
    covariance = solved.spread * (solved.rss / solved.degrees[:, None])[..., None, None]
    k, variance = solved.best[..., K], covariance[..., K, K]
    known = (k > 0.0) & (variance > 0.0)
    k = np.where(known, k, 1.0)
    counted = np.where(known, np.minimum(1.0, 0.1 * k**2 / np.maximum(variance, TINY)), 0.0)
    best = solved.best - (2.0 * counted / k)[..., None] * covariance[..., K]
    score = solved.score - np.where(known, 2.0 * np.log(k) - np.log1p(3.0 * counted * variance / k**2), 0.0)
    return replace(solved, best=best, score=score)


def _mixture(batch: _Batch, solved: _Solved, m: int, column: int) -> Parameter:
    """A regressor's coefficient of series m in its own unit, with the quantiles of the mixture over the cells."""
    scale = batch.scale[m, column]
    sd = np.sqrt(solved.rss[m] / solved.degrees[m] * np.maximum(solved.spread[m, :, column, column], 0.0))
    return _quantiles(solved.best[m, :, column] / scale, sd / scale, solved.weight[m], solved.degrees[m])


def _mean_growth(batch: _Batch, solved: _Solved, m: int) -> Parameter:
    """mu + S_end/L: linear in the coefficients, since S is filtered for each column with the same gains."""
    towards = -solved.drift[m, :, 1:] / batch.span[m]
    towards[:, MU] += 1.0 / batch.scale[m, MU]
    value = np.sum(towards * solved.best[m], axis=1) + solved.drift[m, :, 0] / batch.span[m]
    variance = np.einsum("gi,gij,gj->g", towards, solved.spread[m], towards)
    variance = variance + solved.drift_variance[m] / batch.span[m] ** 2
    sd = np.sqrt(solved.rss[m] / solved.degrees[m] * np.maximum(variance, 0.0))
    return _quantiles(value, sd, solved.weight[m], solved.degrees[m])


def _quantiles(centre: Array, sd: Array, weight: Array, degrees: float) -> Parameter:
    """Median and central 95 % of a mixture of Student t distributions, by bisection on its distribution function."""
    from scipy.special import stdtr, stdtrit

    kept = np.argsort(weight)[-KEPT_CELLS:]
    centre, sd, weight = centre[kept], np.maximum(sd[kept], TINY), weight[kept] / weight[kept].sum()
    wanted = np.array([0.5, 0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])[:, None]
    each = centre + sd * stdtrit(degrees, wanted)
    low, high = each.min(axis=1), each.max(axis=1)
    for _ in range(40):
        middle = 0.5 * (low + high)
        below = stdtr(degrees, (middle[:, None] - centre) / sd) @ weight < wanted[:, 0]
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return Parameter(*(float(v) for v in 0.5 * (low + high)))


@dataclass(frozen=True, eq=False)
class _Traces:
    """The filter at one cell for each series. innovation: (n, 5, M). variance: (n, M). gain: (n, 4, M)."""

    innovation: Array
    variance: Array
    gain: Array


def _traces(batch: _Batch, cells: _Cells) -> _Traces:
    steps = list(_Filter(batch, cells).rows())
    return _Traces(
        innovation=np.stack([s.innovation[:, :, 0] for s in steps]),
        variance=np.stack([s.variance[:, 0] for s in steps]),
        gain=np.stack([s.gain[:, :, 0] for s in steps]),
    )


def _quality(
    batch: _Batch, solved: _Solved, cells: _Cells, m: int, part: Series, innovation: Array, sigma: float, mu: float
) -> Quality:
    cell = int(np.argmax(solved.weight[m]))
    z = innovation[np.isfinite(innovation)]
    z = z - z.mean()
    spread = max(float(np.mean(z**2)), TINY)
    inverse_tau = float(solved.best[m, cell, K] / batch.scale[m, K])
    late = float(solved.weight[m] @ np.repeat(LATE_SHARES, len(cells.p)))
    each = part.pump_rate[:-1] * np.diff(part.time)
    size = float(np.sqrt(np.mean(each**2)))
    change = np.diff(part.pump_rate, prepend=part.pump_rate[0])
    seen = np.isfinite(innovation)
    moved = change[seen] - change[seen].mean()
    both = float(np.sqrt(np.sum(moved**2) * np.sum(z**2)))
    feedback = float(np.sum(moved * z)) / both if both > 0.0 else 0.0
    diluted = abs(inverse_tau) * size
    return Quality(
        variance=spread,
        autocorrelation=float(np.mean(z[1:] * z[:-1])) / spread,
        kurtosis=float(np.mean(z**4)) / spread**2,
        late_share=late,
        dose_spread=float(cells.dose[cell % len(cells.p)]) * sigma / diluted if diluted > 0.0 else 0.0,
        growth_spread=float(cells.wander[cell % len(cells.p)]) * sigma / abs(mu),
        noise=sigma,
        feedback=feedback,
        answers=bool(abs(feedback) > 2.0 / np.sqrt(len(z))),
    )


def outliers(parts: list[Series]) -> list[Mask]:
    """Readings that all others contradict: deletion residual beyond 4.5 robust sd, the largest of five neighbours.

    With e = ln y - X b and V its covariance, reading i differs from what all others say about it by (V^-1 e)_i sd's,
    divided by the root of (V^-1)_ii; a disturbance smoother at the likeliest cell gives both (de Jong 1989, Biometrika
    76:82). Three passes, since a large one hides a small one.

    Returns: for each series True at its outliers, shape (n,).
    """
    marked = [np.zeros(len(part.od), dtype=np.bool_) for part in parts]
    for _ in range(OUTLIER_PASSES):
        batch = _batch([part.rejecting(bad) for part, bad in zip(parts, marked, strict=True)])
        solved = _solve(batch, QUICK)
        cells = QUICK.chosen(np.argmax(solved.weight, axis=1) % len(QUICK.p))
        best = solved.best[np.arange(len(parts)), np.argmax(solved.weight, axis=1)]
        residual = _deletion_residuals(batch, cells, best)
        fresh = [_peaks(residual[m, : len(part.od)]) for m, part in enumerate(parts)]
        if not any(f.any() for f in fresh):
            break
        marked = [bad | new for bad, new in zip(marked, fresh, strict=True)]
    return marked


def _deletion_residuals(batch: _Batch, cells: _Cells, best: Array) -> Array:
    """(V^-1 e)_i / sqrt((V^-1)_ii) for sigma = 1, nan without a reading, shape (M, n)."""
    run = _Filter(batch, cells)
    steps = list(run.rows())
    m, n = batch.dt.shape
    pull, weight = np.zeros((4, m)), np.zeros((4, 4, m))  # r and N of the smoother, for the state after each row
    residual = np.full((m, n), np.nan)
    for i in range(n - 1, -1, -1):
        step, seen = steps[i], batch.reading[:, i]
        moved_pull, moved_weight = _back(run, i, pull, weight)
        gain, variance, ratio = step.gain[:, :, 0], step.variance[:, 0], run.ratio(i)[:, 0]
        error = step.innovation[0, :, 0] - np.einsum("cm,mc->m", step.innovation[1:, :, 0], best)
        smoothed = error / variance - np.sum(gain * moved_pull, axis=0)
        precision = 1.0 / variance + np.einsum("im,ijm,jm->m", gain, moved_weight, gain)
        residual[seen, i] = (smoothed / np.sqrt(precision))[seen]
        looks = np.zeros((4, m))
        looks[0], looks[2] = 1.0, ratio
        looks = looks * seen
        keep = np.eye(4)[:, :, None] - gain[:, None] * looks[None]
        pull = looks * error / variance + np.einsum("jim,jm->im", keep, moved_pull)
        weight = looks[:, None] * looks / variance + np.einsum("kim,klm,ljm->ijm", keep, moved_weight, keep)
    return residual


def _back(run: _Filter, i: int, pull: Array, weight: Array) -> tuple[Array, Array]:
    """T' r and T' N T of row i, T the transition that `_Filter` makes after the row."""
    m = pull.shape[1]
    transition = np.zeros((4, 4, m))
    dt, decay = run.batch.dt[:, i], run.decay(i)[:, 0]
    transition[0, 0] = transition[3, 3] = 1.0
    transition[0, 1] = transition[3, 1] = dt
    transition[1, 1], transition[2, 2] = decay, np.broadcast_to(run.cells.phi, (m, 1))[:, 0]
    return np.einsum("jim,jm->im", transition, pull), np.einsum("kim,klm,ljm->ijm", transition, weight, transition)


def _peaks(residual: Array) -> Mask:
    """Beyond 4.5 robust sd and the largest within two rows on each side, shape (n,)."""
    size = np.where(np.isfinite(residual), np.abs(residual), 0.0)
    known = size[np.isfinite(residual)]
    limit = OUTLIER_SD * 1.4826 * float(np.median(known)) if len(known) else np.inf
    padded = np.pad(size, OUTLIER_NEIGHBOURS)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * OUTLIER_NEIGHBOURS + 1).max(axis=1)
    return np.asarray((size > limit) & (size == around))
