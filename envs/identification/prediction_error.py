"""Growth rate mu and dilution constant tau by the prediction-error method, which is unbiased even under feedback.

A free run from one start treats every disturbance as sensor noise. Under feedback the pump responds to disturbances, so
pump rate and error are correlated, and least squares estimates mu and 1/tau too small. Here the model contains the
disturbances, and each reading is compared with its prediction from all earlier readings:

    ln y_i = b + mu t_i - k (C_i - q l_i) + s_i + sigma r_i v_i       k = 1/tau, c_i = u_i dt_i, C_i = sum_{j<i} c_j
    l_i = c_{i-1} + h l_{i-1}                                         late mixing: q of a dose is late, then q h, ...
    s_{i+1} = s_i + w_i dt_i + sigma d (c_i / c_rms) xi_i             random errors of the doses
    w_{i+1} = a w_i + sqrt(1 - a^2) sigma om eta_i,  a = exp(-dt/T)   fluctuations of growth
    v_{i+1} = phi v_i + sqrt(1 - phi^2) nu_i                          reading noise, correlated from row to row

with xi, eta, nu independent standard normal and r^2 = p + (1 - p)(x_mean/x)^2. For p = 1 the noise is proportional to
the OD, for p = 0 it is constant; x is a running median of the readings. A rate decided from reading i acts from row i
on. For given (p, d, om, T, phi, q, h) the fit is generalised least squares: one Kalman filter with shared gains runs
over the columns ln y, 1, t and -(C - q l). Its likelihood is the restricted one, with sigma, b, mu and k integrated out
(Harville 1974, Biometrika 61:383). All points of the noise model are filtered at once, and results are averaged over
them (`noise_model`). So there is no optimiser and no local minimum (docs/calibration.md, Method).
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from envs.identification.model import CONFIDENCE, Parameter
from envs.identification.noise_model import FULL, QUICK, NoiseModel, average, effective
from envs.identification.screening import FEWEST_READINGS, OD_FLOOR, Series, pumped_volume, running_median

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEVEL_ROWS = 5  # width of the running median of the OD level
COLUMNS = 4  # ln y, 1, t, -C
MU, K = 1, 2  # positions of mu and k among the three regressors
STRATA = 64  # strata of the Student t of each point

OUTLIER_SD = 4.5


@dataclass(frozen=True, eq=False)
class _Batch:
    """Input of the filter: M series, padded to n rows. Shape (M, n) unless given.

    reading: whether the row has a reading. dt: min to the next row, 0 in the padding. each: c. rms: c_rms, (M,).
    level: x / x_mean. columns: ln y, 1 and t, (M, n, 3). volume: C. scale: divisor of each regressor, (M, 3).
    span: min between first and last row, (M,). mean_od: mean of the running median, (M,).
    """

    reading: Mask
    dt: Array
    each: Array
    rms: Array
    level: Array
    columns: Array
    volume: Array
    scale: Array
    span: Array
    mean_od: Array

    @property
    def degrees(self) -> Array:
        """Degrees of freedom: number of readings minus number of regressors, shape (M,)."""
        regressors = 2 + (self.volume.max(axis=1) > 0.0)
        return np.asarray(np.maximum(self.reading.sum(axis=1) - regressors, 1), dtype=np.float64)


def enough(part: Series) -> bool:
    """Return whether a series has enough readings for an estimate."""
    return int((part.od > OD_FLOOR).sum()) >= FEWEST_READINGS


def _batch(parts: list[Series]) -> _Batch:
    for part in parts:
        if not enough(part):
            raise ValueError(f"rows {part.row[0]}-{part.row[-1]}: fewer than {FEWEST_READINGS} readings above zero")
    m, n = len(parts), max(len(part.od) for part in parts)
    reading = np.zeros((m, n), dtype=np.bool_)
    dt, each, volume, level = np.zeros((m, n)), np.zeros((m, n)), np.zeros((m, n)), np.ones((m, n))
    columns, span, mean_od = np.zeros((m, n, 3)), np.ones(m), np.ones(m)
    for i, part in enumerate(parts):
        rows = len(part.od)
        usable = part.od > OD_FLOOR
        reading[i, :rows] = usable
        dt[i, : rows - 1] = np.diff(part.time)
        volume[i, :rows] = pumped_volume(part.time, part.pump_rate)
        each[i, : rows - 1] = np.diff(volume[i, :rows])
        smooth = running_median(np.where(usable, part.od, np.nan), LEVEL_ROWS)
        smooth = np.where(np.isfinite(smooth), smooth, np.nanmean(smooth))
        mean_od[i] = max(float(np.mean(smooth)), OD_FLOOR)
        level[i, :rows] = np.maximum(smooth, OD_FLOOR) / mean_od[i]
        log_od = np.log(np.where(usable, part.od, 1.0))
        columns[i, :rows, 0] = np.where(usable, log_od - log_od[usable].mean(), 0.0)
        columns[i, :rows, 1] = 1.0
        span[i] = part.time[-1] - part.time[0]
        columns[i, :rows, 2] = (part.time - part.time[0]) / span[i]
    pumped = volume.max(axis=1)
    scale = np.stack([np.ones(m), span, np.where(pumped > 0.0, pumped, 1.0)], axis=1)
    rms = np.sqrt(np.sum(each**2, axis=1) / np.array([len(part.od) for part in parts]))
    return _Batch(reading, dt, each, np.where(rms > 0.0, rms, 1.0), level, columns, volume, scale, span, mean_od)


@dataclass(frozen=True, eq=False)
class _Step:
    """One row of the filter: gain before the transition (4, M, G), variance (M, G), innovation per column (4, M, G)."""

    gain: Array
    variance: Array
    innovation: Array


class _Filter:
    """Kalman filter of the state (s, w, v, S), with S' = S + w dt, for all columns with shared gains; sigma = 1.

    Args: batch: M series. cells: G points of the noise model for each, arrays of shape (M, G).
    After the iterator `rows` has ended, `covariance` and `state`, both (4, 4, M, G), are those after the last row.
    """

    def __init__(self, batch: _Batch, cells: NoiseModel) -> None:
        self.batch, self.cells = batch, cells
        self.shape = cells.p.shape
        self._both = np.zeros((4, 4 + COLUMNS, *self.shape))  # covariance, and minus the state
        self.covariance = self._both[:, :4]
        self.covariance[1, 1], self.covariance[2, 2] = cells.wander**2, 1.0
        self._level, self._alike = batch.level**-2.0, 1.0 - cells.p
        self._dose, self._each = (cells.dose / batch.rms[:, None]) ** 2, batch.each**2
        self._late, self._volume = cells.late / batch.scale[:, K, None], batch.volume / batch.scale[:, K, None]
        self._changed = np.any(np.diff(batch.dt, axis=1, prepend=np.nan) != 0.0, axis=0)  # also True in row 0
        self._kept, self._fresh = np.ones((4, 4 + COLUMNS, *self.shape)), np.zeros((2, *self.shape))

    @property
    def state(self) -> Array:
        """State of each column, shape (4, 4, M, G)."""
        return np.asarray(-self._both[:, 4:])

    def rows(self) -> Iterator[_Step]:
        """Yield gain, variance and innovation of every row; the innovation is 0 without a reading."""
        b, both, late = self.batch, self._both, np.zeros(self.shape)
        everyone = np.all(b.reading, axis=0)
        for i in range(b.dt.shape[1]):
            ratio = self.ratio(i)
            looks = both[0] + ratio * both[2]
            looks[4:7] += b.columns[:, i].T[:, :, None]
            looks[7] += self._late * late - self._volume[:, i, None]
            variance = np.maximum(looks[0] + ratio * looks[2], 1e-12)
            if not everyone[i]:
                seen = b.reading[:, i, None]
                looks, variance = looks * seen, np.where(seen, variance, 1.0)
            gain = looks[:4] / variance
            yield _Step(gain, variance, looks[4:])
            both -= gain[:, None] * looks
            self._move(i)
            late = b.each[:, i, None] + self.cells.mixing * late

    def ratio(self, i: int) -> Array:
        """Return r of row i, shape (M, G)."""
        return np.asarray(np.sqrt(self.cells.p + self._alike * self._level[:, i, None]))

    def decay(self, i: int) -> Array:
        """Return a of row i, shape (M, G)."""
        return np.asarray(np.exp(-self.batch.dt[:, i, None] / self.cells.memory))

    def _move(self, i: int) -> None:
        dt, covariance = self.batch.dt[:, i, None], self.covariance
        if self._changed[i]:
            self._meet(self.decay(i))
        self._both[::3] += dt * self._both[1]  # s and S gain w dt
        covariance[:, ::3] += (dt * covariance[:, 1])[:, None]
        self._both *= self._kept
        covariance[0, 0] += self._dose * self._each[:, i, None]
        covariance[1, 1] += self._fresh[0]
        covariance[2, 2] += self._fresh[1]

    def _meet(self, decay: Array) -> None:
        """Set the decay of w and v in a row, and the variances of their noise."""
        kept = np.stack([np.ones(self.shape), decay, self.cells.phi, np.ones(self.shape)])
        self._kept[:, :4] = kept[:, None] * kept
        self._kept[:, 4:] = kept[:, None]
        self._fresh = (1.0 - kept[1:3] ** 2) * np.stack([self.cells.wander**2, np.ones(self.shape)])


@dataclass(frozen=True, eq=False)
class _Solved:
    """Generalised least squares of M series at G points of the noise model. Shape (M, G) unless given.

    best: coefficients of the three regressors, (M, G, 3). spread: their covariance for sigma = 1, (M, G, 3, 3).
    rss: residual sum of squares. score: logarithm of the restricted likelihood, up to a constant. drift: S of each
    column after the last row, (M, G, 4). drift_variance: variance of S for sigma = 1. condition: of the scaled normal
    equations.
    """

    best: Array
    spread: Array
    rss: Array
    score: Array
    drift: Array
    drift_variance: Array
    condition: Array


def _solve(batch: _Batch, cells: NoiseModel) -> _Solved:
    run = _Filter(batch, cells)
    log_variance, products = np.zeros(run.shape), np.zeros((COLUMNS, COLUMNS, *run.shape))
    for step in run.rows():
        log_variance += np.log(step.variance)
        white = step.innovation / np.sqrt(step.variance)
        products += white[:, None] * white
    gram = np.moveaxis(products, (0, 1), (-2, -1))
    normal, target = gram[..., 1:, 1:], gram[..., 1:, 0]
    size = np.sqrt(np.einsum("...ii->...i", normal))
    absent = size == 0.0  # without pumping the coefficient of the pump is 0
    size = np.where(absent, 1.0, size)
    unit = normal / (size[..., :, None] * size[..., None, :]) + absent[..., None] * np.eye(3)
    values, vectors = np.linalg.eigh(unit)
    values = np.maximum(values, 1e-14)
    vectors = vectors / size[..., :, None]
    spread = (vectors / values[..., None, :]) @ vectors.swapaxes(-1, -2)
    best = (spread @ target[..., None])[..., 0]
    rss = np.maximum(gram[..., 0, 0] - np.sum(best * target, axis=-1), 1e-12)
    degrees = batch.degrees[:, None]
    determinant = np.log(values).sum(axis=-1) + 2.0 * np.log(size).sum(axis=-1)
    return _Solved(
        best=best,
        spread=spread,
        rss=rss,
        score=-0.5 * (log_variance + determinant + degrees * np.log(rss)),
        drift=np.moveaxis(run.state[3], 0, -1),
        drift_variance=np.maximum(run.covariance[3, 3], 0.0),
        condition=values[..., -1] / values[..., 0],
    )


@dataclass(frozen=True)
class Quality:
    """Quality of a fit. In a good fit the innovations have variance 1 and autocorrelation 0.

    variance, autocorrelation: of the innovations, in units of their predicted sd, at the mean noise model.
    late_share: fraction of a dose missing from the next reading. dose_spread: sd of a dose relative to its mean.
    growth_spread: sd of the hourly mean of the growth rate, relative to mu. noise: sd of a reading relative to the OD,
    at the mean OD. noise_floor, noise_relative: the sd of a reading is hypot(noise_floor, noise_relative * OD).
    noise_lag1: correlation of the noise from row to row. feedback: correlation of the innovations with the following
    change of the pump rate. answers: whether `feedback` exceeds chance, 2/sqrt(n). effective: effective number of
    points. hills: 95 % interval of 1/tau between points of the noise model, relative to that within a point.
    """

    variance: float
    autocorrelation: float
    late_share: Parameter
    dose_spread: Parameter
    growth_spread: Parameter
    noise: float
    noise_floor: float
    noise_relative: float
    noise_lag1: float
    feedback: float
    answers: bool
    effective: float
    hills: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimate of mu (mean over the rows) and tau of one series with 95 % intervals; tau is None if not identifiable.

    condition: condition number of the scaled normal equations. expected: OD predicted from earlier readings and the
    pump, nan without a reading, (n,). innovation: innovation of each reading in units of its predicted sd, (n,).
    """

    mu: Parameter
    tau: Parameter | None
    inverse_tau: Parameter
    condition: float
    expected: Array
    innovation: Array
    quality: Quality


def estimate(parts: list[Series], rounds: tuple[int, ...] = FULL, seed: int = 0) -> list[Estimate]:
    """Fit each of M series separately, in one pass; return an `Estimate` of each.

    Intervals are quantiles of the mixture of the points' Student t distributions. The reported mu is the mean growth
    rate over the rows, mu + S_end/L, with S the integral of w and L the duration of the rows. The rows identify this
    mean even if the growth rate fluctuates very slowly. Check an estimate with `verdict.check_estimate`.

    Args: parts: screened series; readings may be nan, times and pump rates of all rows are used. rounds: numbers of
      points of the noise model; QUICK for many short parts, where no single interval is decisive. seed: random seed.
    Raises: ValueError for a series with fewer than ten readings above zero.
    """
    batch = _batch(parts)
    cells, solved, weight, central = _averaged(batch, rounds, seed)
    plugged, steps = _solve(batch, central), list(_Filter(batch, central).rows())
    variances = np.stack([step.variance[:, 0] for step in steps])
    columns = np.stack([step.innovation[:, :, 0] for step in steps])
    sigma = np.sqrt(solved.rss / batch.degrees[:, None])
    k = solved.best[..., K] / batch.scale[:, None, K]
    k_sd = sigma * np.sqrt(np.maximum(solved.spread[..., K, K], 0.0)) / batch.scale[:, None, K]
    hours = cells.memory / 60.0
    hourly = np.sqrt(2.0 * hours * (1.0 + hours * np.expm1(-1.0 / hours)))  # sd of w's hourly mean over the sd of w
    growth, growth_sd = _mean_growth(batch, solved, sigma)
    found = []
    for m, part in enumerate(parts):
        rows, w = len(part.od), weight[m]
        inverse = _quantiles(k[m], k_sd[m], w, batch.degrees[m])
        mu = _quantiles(growth[m], growth_sd[m], w, batch.degrees[m])
        error = columns[:rows, 0, m] - columns[:rows, 1:, m] @ plugged.best[m, 0]
        own = float(np.sqrt(plugged.rss[m, 0] / batch.degrees[m]))
        seen = batch.reading[m, :rows]
        innovation = np.where(seen, error / (own * np.sqrt(variances[:rows, m])), np.nan)
        pumped = bool((part.pump_rate[:-1] > 0.0).any())
        diluted = np.maximum(np.abs(k[m]) * batch.rms[m], 1e-300)
        feedback = _feedback(part, innovation)
        z = innovation[seen] - innovation[seen].mean()
        spread = max(float(np.mean(z**2)), 1e-300)
        quality = Quality(
            variance=spread,
            autocorrelation=float(np.mean(z[1:] * z[:-1])) / spread,
            late_share=_weighted(cells.late[m], w),
            dose_spread=_weighted(cells.dose[m] * sigma[m] / diluted, w),
            growth_spread=_weighted(hourly[m] * cells.wander[m] * sigma[m] / max(abs(mu.value), 1e-300), w),
            noise=own,
            noise_floor=float(np.sqrt(w @ ((1.0 - cells.p[m]) * sigma[m] ** 2)) * batch.mean_od[m]),
            noise_relative=float(np.sqrt(w @ (cells.p[m] * sigma[m] ** 2))),
            noise_lag1=float(w @ cells.phi[m]),
            feedback=feedback,
            answers=abs(feedback) > 2.0 / float(np.sqrt(len(z))),
            effective=float(effective(w[None])[0]),
            hills=_weighted(k[m], w).half_width / max(1.96 * _weighted(k_sd[m], w).value, 1e-300),
        )
        tau = Parameter(1.0 / inverse.value, 1.0 / inverse.high, 1.0 / inverse.low) if inverse.low > 0.0 else None
        found.append(
            Estimate(
                mu=mu,
                tau=tau if pumped else None,
                inverse_tau=inverse,
                condition=float(solved.condition[m].min()),
                expected=np.exp(-error) * np.where(seen, part.od, np.nan),
                innovation=innovation,
                quality=quality,
            )
        )
    return found


def _averaged(batch: _Batch, rounds: tuple[int, ...], seed: int) -> tuple[NoiseModel, _Solved, Array, NoiseModel]:
    """Return the points of the noise model, their solutions and weights (M, G), and the mean point of each series."""
    solved: list[_Solved] = []

    def score(z: Array) -> Array:
        solved.append(_solve(batch, NoiseModel.at(z)))
        return solved[-1].score

    z, weight = average(score, len(batch.dt), rounds, seed)
    joined = [np.concatenate([getattr(s, f.name) for s in solved], axis=1) for f in fields(_Solved)]
    central = NoiseModel.at(np.sum(weight[..., None] * z, axis=1, keepdims=True))
    return NoiseModel.at(z), _Solved(*joined), weight, central


def _mean_growth(batch: _Batch, solved: _Solved, sigma: Array) -> tuple[Array, Array]:
    """Compute mu + S_end/L and its sd, (M, G); linear in the coefficients, because all columns share the gains."""
    span = batch.span[:, None]
    towards = -solved.drift[..., 1:] / span[..., None]
    towards[..., MU] += 1.0 / batch.scale[:, None, MU]
    value = np.sum(towards * solved.best, axis=-1) + solved.drift[..., 0] / span
    variance = np.einsum("mgi,mgij,mgj->mg", towards, solved.spread, towards) + solved.drift_variance / span**2
    return value, sigma * np.sqrt(np.maximum(variance, 0.0))


def _quantiles(centre: Array, sd: Array, weight: Array, degrees: float) -> Parameter:
    """Return median and central 95 % of a mixture of Student t distributions; each is replaced by STRATA quantiles."""
    from scipy.special import stdtrit

    places = stdtrit(degrees, (np.arange(STRATA) + 0.5) / STRATA)
    values = centre[:, None] + sd[:, None] * places
    return _weighted(values.ravel(), np.repeat(weight, STRATA))


def _weighted(values: Array, weight: Array) -> Parameter:
    """Return median and central 95 % of weighted values, shape (n,) each."""
    order = np.argsort(values)
    below = np.cumsum(weight[order])
    below = (below - 0.5 * weight[order]) / below[-1]
    found = np.interp([0.5, 0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], below, values[order])
    return Parameter(*(float(v) for v in found))


def _feedback(part: Series, innovation: Array) -> float:
    """Return the correlation of the innovations with the change of the pump rate after them; 0 if one is constant."""
    seen = np.isfinite(innovation)
    z = innovation[seen] - innovation[seen].mean()
    change = np.diff(part.pump_rate, prepend=part.pump_rate[0])[seen]
    moved = change - change.mean()
    both = float(np.sqrt(np.sum(moved**2) * np.sum(z**2)))
    return float(np.sum(moved * z)) / both if both > 0.0 else 0.0


def outliers(parts: list[Series], seed: int = 0) -> list[Mask]:
    """Find readings that the other readings contradict: deletion residual beyond 4.5 robust sd, largest of five rows.

    With e = ln y - X b and V its covariance, the deletion residual (V^-1 e)_i / sqrt((V^-1)_ii) is the difference of
    reading i from its prediction by all other readings, in sd. A disturbance smoother at the mean noise model gives
    both factors (de Jong 1989, Biometrika 76:82). There are up to three passes, because a large outlier hides a small
    one.

    Returns: for each series True at its outliers, shape (n,).
    """
    marked = [np.zeros(len(part.od), dtype=np.bool_) for part in parts]
    for _ in range(3):
        batch = _batch([part.rejecting(bad) for part, bad in zip(parts, marked, strict=True)])
        *_, cells = _averaged(batch, QUICK, seed)
        residual = _deletion_residuals(batch, cells, _solve(batch, cells).best[:, 0])
        fresh = [_peaks(residual[m, : len(part.od)]) for m, part in enumerate(parts)]
        if not any(f.any() for f in fresh):
            break
        marked = [bad | new for bad, new in zip(marked, fresh, strict=True)]
    return marked


def _deletion_residuals(batch: _Batch, cells: NoiseModel, best: Array) -> Array:
    """Return the deletion residuals (V^-1 e)_i / sqrt((V^-1)_ii) for sigma = 1, nan without a reading, (M, n)."""
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
    """Return T' r and T' N T of row i for r = pull, N = weight; T is the transition of `_Filter` after the row."""
    m = pull.shape[1]
    transition = np.zeros((4, 4, m))
    dt, decay = run.batch.dt[:, i], run.decay(i)[:, 0]
    transition[0, 0] = transition[3, 3] = 1.0
    transition[0, 1] = transition[3, 1] = dt
    transition[1, 1], transition[2, 2] = decay, run.cells.phi[:, 0]
    return np.einsum("jim,jm->im", transition, pull), np.einsum("kim,klm,ljm->ijm", transition, weight, transition)


def _peaks(residual: Array) -> Mask:
    """Find values beyond 4.5 robust sd that are the largest within two rows on each side, shape (n,)."""
    size = np.where(np.isfinite(residual), np.abs(residual), 0.0)
    known = size[np.isfinite(residual)]
    limit = OUTLIER_SD * 1.4826 * float(np.median(known)) if len(known) else np.inf
    # an outlier also raises the residuals of its two neighbours on each side
    around = np.lib.stride_tricks.sliding_window_view(np.pad(size, 2), 5).max(axis=1)
    return np.asarray((size > limit) & (size == around))
