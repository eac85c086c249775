"""Estimator of two species in one vial: a Kalman filter that uses OD, fluorescence, temperature and doses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.bench import Bench
from envs.coculture.fluorescence import DAY_MIN
from envs.coculture.pair import PairConfig
from experiments.coculture.base import Array, Mask, ShareEstimate

Rows = NDArray[np.intp]

LOGIT, LOG_OD, LOG_F, LOG_Q, BIAS_E, BIAS_P, GAIN, FACTOR, OFFSET, THERMOMETER = range(10)
STATES = 10
OD, LIGHT, SAMPLE = range(3)  # kinds of readings
DILUTED = slice(LOG_OD, LOG_Q)
ERRORS_C = np.linspace(-1.0, 1.0, 5)  # thermometer errors, degC, for which rates and production are computed
FORGET_MIN = 63.0  # time constant of an initial error of production: s = -1.6 exp(-s/2) per hour has Re s = -.946
LAGRANGE = np.linalg.inv(np.vander(ERRORS_C, increasing=True))
DOSES = 60.0  # number of doses in the average from which the spread of doses is estimated
LOWEST_OD = 0.005  # a lower first reading is ignored
LOWEST_LIGHT = 1.0  # counts; lowest fluorescence of the pigment at the start
ITERATIONS = 3  # linearisations of an update
LONGEST_STEP_MIN = 1.0


@dataclass(frozen=True)
class CompositionEstimatorConfig:
    """Settings of the filter: initial estimates, noise and gates.

    The defaults of the light sensor are mean and spread of 17 real reactors, with factors of 0.75 to 1.19 and offsets
    of 151 to 339 counts (Lee et al., Cell Reports Methods 5:101009, 2025, public model). A calibration replaces them
    (docs/coculture.md, Calibration of the sensor).
    """

    share: float = setting(0.5, "initial share of the second species", above=0.0, below=1.0)
    share_sd: float = setting(1.8, "sd of its logit (95 %: 0.03 to 0.97)", above=0.0, at_most=5.0)
    starts: int = setting(5, "number of initial shares in this range, each with its own filter", within=(1, 9))
    bias_sd: float = setting(0.1, "sd of a growth curve's relative error", within=(0, 0.5))
    bias_walk: float = setting(2e-4, "random walk of this error", "1/sqrt(min)", within=(0, 0.05))
    growth_sd: float = setting(3e-4, "spread of either species' growth within a minute", "1/sqrt(min)", within=(0, 0.1))
    pigment_sd: float = setting(1e-3, "spread of ln pigment within a minute", "1/sqrt(min)", within=(0, 0.1))
    pigment_first_sd: float = setting(0.5, "sd of the initial ln (pigment / pigment in balance)", within=(0.01, 5))
    production_first_sd: float = setting(
        0.5, "sd of the initial ln (pigment production / steady production at this temperature)", within=(0, 5)
    )
    thermometer_sd: float = setting(0.25, "sd of true minus measured temperature", "degC", within=(0, 1))
    gain_sd: float = setting(0.05, "sd of the pump's true flow / calibrated flow", within=(0, 1))
    gain_h: float = setting(24.0, "time during which the flow is estimated; then it stays uncertain", "h", at_least=0.0)
    dose_cv: float = setting(0.1, "smallest relative spread of a dose", within=(0, 1))
    od_sd: float = setting(0.005, "sd of an OD reading", "OD", within=(1e-4, 0.1))
    fluorescence_sd: float = setting(30.0, "sd of a fluorescence reading", "counts", within=(0.1, 10_000))
    od_term: float = setting(150.0, "light scattered by cells of both species", "counts/OD", within=(0, 5000))
    factor: float = setting(0.99, "k of the reading k (f + od_term OD) + offset", within=(0.05, 20))
    factor_sd: float = setting(0.13, "sd of factor", within=(0, 5))
    factor_walk: float = setting(0.005, "relative random walk of factor", "1/sqrt(day)", within=(0, 1))
    offset: float = setting(214.0, "offset of a reading", "counts", within=(0, 20_000))
    offset_sd: float = setting(45.0, "sd of offset", "counts", within=(0, 5000))
    gate_sigma: float = setting(5.0, "a reading with a larger innovation is an outlier", "sigma", within=(2, 20))
    gate_max: int = setting(6, "this many outliers in a row are accepted", "readings", within=(1, 100))

    def __post_init__(self) -> None:
        check(self, "composition.estimator")


class CompositionEstimator:
    """Extended Kalman filter for the composition of N cultures.

    State z = [x, ln S, ln f, d, b_e, b_p, g, k, o, c]: x logit of the second species' share, S OD of both species,
    f fluorescence of the pigment, d error of ln production, b_e and b_p relative errors of both growth curves, g true /
    calibrated flow of the pump, k and o factor and offset of the light sensor, c true minus measured temperature. With
    e = S/(1 + exp x) and p = S - e, in h hours after a dose of v mL into a volume of V mL:

      x <- x + h (1 + b_p) m_p - h (1 + b_e) m_e      b_e, b_p, k random walks
      ln S <- ln(e exp(h (1 + b_e) m_e) + p exp(h (1 + b_p) m_p)) - g v/V
      ln f <- ln(f + h q exp(d) p) - g v/V            d <- d exp(-h / 63 min)
      OD = S + noise                                  FL = k (f + 150 S) + o + noise

    m_e and m_p are the curves' rates, 1/h, which lag the temperature by 2 and 60 min; q is the production of pigment
    with its known delayed response to temperature (docs/plant.md, Two species). The filter computes m_e, m_p and q for
    five thermometer errors and interpolates them at c by a polynomial. In these coordinates an OD reading alone does
    not change the share, even if the share is uncertain; with ln e and ln p a linearised filter becomes overconfident.

    The filter iterates each update (Bell, Cathey 1993) and uses Joseph's form. It considers but does not estimate k
    and o (Schmidt 1966): their uncertainty affects every gain, but OD and light do not change them, because in a week
    at one temperature a drifting sensor and a drifting culture look alike. After `gain_h` the same applies to g. A
    counted share (`sample`) changes k, o and g. The initial share is too uncertain for one linearisation, so `starts`
    filters begin at different shares; their weights are the likelihoods of the readings, and the estimate is mean and
    variance of the mixture (Alspach, Sorenson 1972).

    A reading beyond `gate_sigma` is rejected. If it is an OD, the light of the same sample is not used, either. After
    `gate_max` rejections in a row, OD and pigment (for light: the pigment) are reset, without an effect on the share.
    Doses must be reported. If OD readings show a larger spread of doses than `dose_cv`, the filter uses the larger.

    State: mean (N, K, 10), cov (N, K, 10, 10) and log_weight (N, K) of the K filters of each of N cultures.
    Args: config: settings. volume_ml: V, (N,) or one for all. pair: the two species.
    """

    remembers = (
        "mean", "cov", "log_weight", "far", "doses", "began", "minute", "temperature", "lagged", "production", "past",
        "given_ml", "dose",
    )  # fmt: skip

    def __init__(
        self,
        config: CompositionEstimatorConfig,
        volume_ml: Array | float = Bench.volume_ml,
        pair: PairConfig | None = None,
    ) -> None:
        self.config, self._volume_ml, self.pair = config, volume_ml, pair or PairConfig()
        self.reset(1)

    def reset(self, n: int) -> None:
        """Reset the state for n cultures without readings."""
        c, shape = self.config, (n, self.config.starts)
        self.mean, self.log_weight = np.zeros((*shape, STATES)), np.zeros(shape)
        self.mean[..., GAIN], self.mean[..., FACTOR], self.mean[..., OFFSET] = 1.0, c.factor, c.offset
        doubts = (c.production_first_sd, c.bias_sd, c.bias_sd, c.gain_sd, c.factor_sd, c.offset_sd, c.thermometer_sd)
        self.cov = np.tile(np.diag(np.square([0.0, 0.0, 0.0, *doubts])), (*shape, 1, 1))
        self._far = np.zeros((*shape, 2), dtype=np.int64)
        self._doses = np.zeros((*shape, 2))  # see `_judge_dose`
        self._began, self._minute, self._given_ml = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n)
        self._temperature, self._dose = np.full(n, self.pair.even_c), np.zeros(n)  # measured; v/V of the last dose
        self._lagged, self._production = np.zeros((n, 2, ERRORS_C.size)), np.zeros((n, ERRORS_C.size))
        self._past = np.zeros((n, self.pair.pigment.delay_min, ERRORS_C.size))

    def calibrate(self, factor: Array, factor_sd: Array, offset: Array, offset_sd: float) -> None:
        """Set each culture's sensor calibration, before its first reading: factor, its sd and offset, (N,) each."""
        self.mean[..., FACTOR], self.mean[..., OFFSET] = factor[:, None], offset[:, None]
        self.cov[..., FACTOR, FACTOR], self.cov[..., OFFSET, OFFSET] = factor_sd[:, None] ** 2, offset_sd**2

    @property
    def begun(self) -> Mask:
        """Whether each culture has had a reading, (N,)."""
        return np.asarray(np.isfinite(self._minute))

    @property
    def since(self) -> Array:
        """Minute of each culture's newest reading, -inf before its first, (N,)."""
        return np.where(self.begun, self._minute, -np.inf)

    @property
    def volumes_ml(self) -> Array:
        """Volume V of each culture, mL, (N,)."""
        return np.broadcast_to(np.asarray(self._volume_ml, dtype=np.float64), self._given_ml.shape)

    def dosed(self, volume_ml: Array) -> None:
        """Add the fresh medium delivered since the last call, mL, (N,)."""
        self._given_ml = self._given_ml + volume_ml

    @property
    def given_ml(self) -> Array:
        """Fresh medium delivered since each culture's newest reading, mL, (N,)."""
        return self._given_ml

    def gave(self, volume_ml: Array, rows: Mask) -> None:
        """Set the volume delivered since the newest reading of `rows`, mL, (N,)."""
        self._given_ml = np.where(rows, volume_ml, self._given_ml)

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Update the estimates with the new readings of `rows`; arrays (N,).

        Args: od, fluorescence (counts), temperature (degC): readings, nan if missing or invalid. minute: time of the
          readings, by a clock that never goes back.
        """
        new = rows & ~(minute <= self._minute)
        first = np.flatnonzero(new & np.isnan(self._minute) & (od > LOWEST_OD))
        going = np.flatnonzero(new & np.isfinite(self._minute))
        if first.size:
            self._begin(first, od[first], temperature[first])
            self._began[first] = self._minute[first] = minute[first]
        if going.size:
            self._elapse(going, minute[going] - self._minute[going], temperature[going])
            self._minute[going] = minute[going]
            self._take(going, OD, od[going])
        seen = np.concatenate([first, going])
        self._take(seen, LIGHT, fluorescence[seen])
        self._given_ml[seen] = 0.0

    def sample(self, share: Array, sd: Array, rows: Mask) -> None:
        """Update the estimates with shares of the second species counted in samples drawn now; arrays (N,).

        The count is a reading r = 1 / (1 + exp(-x)) + noise. By correlation it also changes sensor, flow and growth
        curves. No count is rejected. Cultures without a reading are skipped.
        Args: share, sd: counted shares and their sds. rows: cultures with a count.
        """
        idx = np.flatnonzero(rows & self.begun & np.isfinite(share))
        reading, noise = share[idx], np.square(sd[idx])
        expected, slope = self._seen(self.mean[idx], SAMPLE)
        spread = np.einsum("nki,nkij,nkj->nk", slope, self.cov[idx], slope) + noise[:, None]
        self.log_weight[idx] -= 0.5 * (np.square(reading[:, None] - expected) / spread + np.log(spread))
        self._update(idx, SAMPLE, reading, noise)

    def _begin(self, idx: Rows, od: Array, temperature: Array) -> None:
        """Start the rows `idx` at their first reading: its OD, the initial shares, pigment and rates in balance."""
        c, warm = self.config, np.where(np.isfinite(temperature), temperature, self.pair.even_c)
        self._temperature[idx] = warm
        each = warm[:, None] + ERRORS_C
        self._lagged[idx] = self.pair.rates(each).swapaxes(1, 2)
        self._production[idx] = self.pair.production(each)
        self._past[idx] = self._production[idx][:, None]
        away, within = _starts(c.starts)
        guess = np.log(c.share / (1.0 - c.share)) + c.share_sd * away
        share = 1.0 / (1.0 + np.exp(-guess))
        made = (self.pair.production(warm) / self.pair.rates(warm)[:, 1] * od)[:, None] * share
        self.mean[idx, :, LOGIT], self.mean[idx, :, LOG_OD] = guess, np.log(od)[:, None]
        self.mean[idx, :, LOG_F] = np.log(np.maximum(made, LOWEST_LIGHT))
        by_share = c.share_sd * within * np.stack([np.ones_like(share), np.zeros_like(share), 1.0 - share], axis=1)
        by_od = (c.od_sd / od)[:, None] * np.array([0.0, 1.0, 1.0])
        self.cov[idx, :, :3, :3] = _square(by_share) + _square(by_od)[:, None]
        self.cov[idx, :, LOG_F, LOG_F] += c.pigment_first_sd**2

    def _elapse(self, idx: Rows, minutes: Array, temperature: Array) -> None:
        """Predict the rows `idx` after `minutes`: in steps of at most 1 min, dose at the start, linear temperature."""
        before = self._temperature[idx]
        after = np.where(np.isfinite(temperature), temperature, before)
        steps = np.maximum(np.ceil(minutes / LONGEST_STEP_MIN - 1e-6), 1.0)
        dose = self._given_ml[idx] / self.volumes_ml[idx]
        for k in range(int(steps.max())):
            on = k < steps
            length, slope = (minutes / steps)[on], ((after - before) / steps)[on]
            mean = before[on] + (k + 0.5) * slope
            self._step(idx[on], length, mean, mean + 0.5 * slope, dose[on] if k == 0 else np.zeros(length.size))
        self._temperature[idx], self._dose[idx] = after, dose

    def _step(self, idx: Rows, minutes: Array, mean: Array, last: Array, dose: Array) -> None:
        """Predict the rows `idx` by one step. Args: mean, last: mean and final temperature, degC. dose: v/V."""
        c, z, hours, dose = self.config, self.mean[idx], minutes / 60.0, dose[:, None]
        weight, change = _through(z[..., THERMOMETER])  # (n, K, errors of the thermometer)
        before, lag = self._lagged[idx], np.array([[self.pair.first.lag_min], [self.pair.second.lag_min]])
        each = mean[:, None] + ERRORS_C
        steady = self.pair.rates(each).swapaxes(1, 2)
        self._lagged[idx] = before + (steady - before) * -np.expm1(-minutes[:, None, None] / lag)
        curves = 0.5 * hours[:, None, None] * (before + self._lagged[idx])
        grown, by_c = (
            np.einsum("nsc,nkc->nks", curves, w) for w in (weight, change)
        )  # growth by the curves, and its slope
        errors = 1.0 + z[..., BIAS_E:GAIN]
        growth, by_c = grown * errors, by_c * errors
        share = 1.0 / (1.0 + np.exp(-z[..., LOGIT]))
        parts = np.stack([1.0 - share, share], axis=-1) * np.exp(growth)
        total = parts.sum(axis=-1)
        later = parts / total[..., None]  # both species' shares at the end
        made_at, of_c = (np.einsum("nc,nkc->nk", self._production[idx], w) for w in (weight, change))
        made_at = np.maximum(made_at, self.pair.pigment.least)
        made = np.exp(z[..., LOG_OD] + 0.5 * growth[..., 1] - z[..., LOG_F] + z[..., LOG_Q])
        made *= hours[:, None] * made_at * share
        new = made / (1.0 + made)  # fraction of the pigment that was made in this step
        fades = np.exp(-minutes / FORGET_MIN)[:, None]
        z[..., LOGIT] += growth[..., 1] - growth[..., 0]
        z[..., LOG_OD] += np.log(total) - z[..., GAIN] * dose
        z[..., LOG_F] += np.log1p(made) - z[..., GAIN] * dose
        z[..., LOG_Q] *= fades
        self.mean[idx] = z
        step = np.tile(np.eye(STATES), (*share.shape, 1, 1))
        step[..., LOGIT, BIAS_E], step[..., LOGIT, BIAS_P] = -grown[..., 0], grown[..., 1]
        step[..., LOGIT, THERMOMETER] = by_c[..., 1] - by_c[..., 0]
        step[..., LOG_OD, LOGIT] = later[..., 1] - share
        step[..., LOG_OD, BIAS_E:GAIN] = later * grown
        step[..., LOG_OD, THERMOMETER] = (later * by_c).sum(axis=-1)
        step[..., LOG_F, LOGIT], step[..., LOG_F, LOG_OD] = new * (1.0 - share), new
        step[..., LOG_F, LOG_F], step[..., LOG_F, BIAS_P] = 1.0 - new, 0.5 * new * grown[..., 1]
        step[..., LOG_F, LOG_Q], step[..., LOG_Q, LOG_Q] = new, fades
        step[..., LOG_F, THERMOMETER] = new * (of_c / made_at + 0.5 * by_c[..., 1])
        step[..., LOG_OD, GAIN] = step[..., LOG_F, GAIN] = -dose
        cov = step @ self.cov[idx] @ step.swapaxes(-1, -2)
        cov[..., DILUTED, DILUTED] += (self._dose_variance(idx) * dose**2)[..., None, None]
        cov[..., FACTOR, FACTOR] += ((c.factor * c.factor_walk) ** 2 * minutes / DAY_MIN)[:, None]
        walks = (2.0**0.5 * c.growth_sd, c.growth_sd, c.pigment_sd, 0.0, c.bias_walk, c.bias_walk)
        for k, sd in enumerate(walks):
            cov[..., k, k] += sd**2 * minutes[:, None]
        self.cov[idx] = cov
        self._produce(idx, minutes, last)

    def _produce(self, idx: Rows, minutes: Array, temperature: Array) -> None:
        """Update the pigment production: it changes by the steady value at this temperature minus its delayed value."""
        now, past = self._production[idx], self._past[idx]
        pigment, steady = self.pair.pigment, self.pair.production(temperature[:, None] + ERRORS_C)
        wanted = now + pigment.follow_per_h / 60.0 * minutes[:, None] * (steady - past[:, 0])
        self._past[idx] = np.concatenate([past[:, 1:], now[:, None]], axis=1)
        self._production[idx] = np.maximum(wanted, pigment.least)

    def _seen(self, z: Array, which: int) -> tuple[Array, Array]:
        """Return the expected reading for states (..., 10), and its gradient (..., 10). which: OD, LIGHT or SAMPLE."""
        od, f, k = np.exp(z[..., LOG_OD]), np.exp(z[..., LOG_F]), z[..., FACTOR]
        slope = np.zeros_like(z)
        if which == OD:
            slope[..., LOG_OD] = od
            return od, slope
        if which == SAMPLE:
            share = 1.0 / (1.0 + np.exp(-z[..., LOGIT]))
            slope[..., LOGIT] = share * (1.0 - share)
            return share, slope
        light = f + self.config.od_term * od
        slope[..., LOG_OD], slope[..., LOG_F] = k * self.config.od_term * od, k * f
        slope[..., FACTOR], slope[..., OFFSET] = light, 1.0
        return k * light + z[..., OFFSET], slope

    def _take(self, idx: Rows, which: int, reading: Array) -> None:
        """Update with OD or light readings; skip nan, outliers, and light of a sample whose OD was an outlier."""
        there = np.isfinite(reading)
        idx, reading = idx[there], reading[there]
        noise = (self.config.od_sd, self.config.fluorescence_sd)[which] ** 2
        expected, slope = self._seen(self.mean[idx], which)
        spread = np.einsum("nki,nkij,nkj->nk", slope, self.cov[idx], slope) + noise
        squared = np.square(reading[:, None] - expected)
        on = np.ones(squared.shape, dtype=np.bool_) if which == OD else self._far[idx, :, OD] == 0
        far = on & (squared > self.config.gate_sigma**2 * spread)
        if which == OD:
            self._judge_dose(idx, squared, spread, expected, ~far)
        times = self._far[idx, :, which]
        times = np.where(far, times + 1, np.where(on, 0, times))
        stays = times >= self.config.gate_max
        of, start = np.nonzero(stays)
        (self._density_anew, self._pigment_anew)[which](idx[of], start, reading[of])
        self._far[idx, :, which] = np.where(stays, 0, times)
        usual = (self._weights()[idx] * (on & ~far)).sum(axis=1) > 0.5  # else the reading does not change the weights
        least = np.minimum(squared / spread, self.config.gate_sigma**2)
        self.log_weight[idx] -= 0.5 * usual[:, None] * (least + np.log(spread))
        self._update(idx, which, reading, np.full(idx.size, noise), on & ~far)

    def _weights(self) -> Array:
        """Return the weights of each culture's filters, (N, K); each row adds up to 1."""
        weight = np.exp(self.log_weight - self.log_weight.max(axis=1, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))

    def _dose_variance(self, idx: Rows) -> Array:
        """Return (relative sd of a dose)^2, (n, K): the configured value, or the larger estimate from OD readings."""
        least = self.config.dose_cv**2
        known, sum_of = self._doses[idx, :, 0], self._doses[idx, :, 1]
        if least == 0.0:
            return np.zeros(known.shape)
        return np.maximum(least, (least**-1 + sum_of) / (least**-2 + known))

    def _judge_dose(self, idx: Rows, squared: Array, spread: Array, od: Array, believed: Mask) -> None:
        """Update the estimated spread of doses from an OD reading after a dose.

        The excess of the squared error e^2 over its other causes, divided by D = (OD v/V)^2, estimates the squared
        spread with variance 2 (E e^2)^2 / D^2. These estimates are averaged by precision over about 60 doses. The
        configured value takes part as one estimate whose sd equals its value.
        """
        size = np.square(od * self._dose[idx][:, None])
        precision = np.square(size / spread) / 2.0
        sum_of = precision * self._dose_variance(idx) + size * (squared - spread) / np.square(spread) / 2.0
        given = (believed & (size > 0.0))[..., None]
        self._doses[idx] += given * (np.stack([precision, sum_of], axis=-1) - self._doses[idx] / DOSES)

    def _density_anew(self, idx: Rows, start: Rows, od: Array) -> None:
        """Reset the density after a persistent jump; the pigment may have changed, too, as by an unrecorded dose."""
        found = np.log(np.maximum(od, LOWEST_OD))
        jump = found - self.mean[idx, start, LOG_OD]
        self.mean[idx, start, LOG_OD], self.mean[idx, start, LOG_F] = found, self.mean[idx, start, LOG_F] + jump
        self.cov[idx, start, LOG_F, LOG_F] += np.square(jump)
        self.cov[idx, start, LOG_OD, :], self.cov[idx, start, :, LOG_OD] = 0.0, 0.0
        self.cov[idx, start, LOG_OD, LOG_OD] = np.square(self.config.od_sd / np.exp(found))

    def _pigment_anew(self, idx: Rows, start: Rows, light: Array) -> None:
        """Reset the pigment after a persistent jump of the light."""
        z, cov = self.mean[idx, start], self.cov[idx, start]
        k, scattered = z[:, FACTOR], self.config.od_term * np.exp(z[:, LOG_OD])
        f = np.maximum((light - z[:, OFFSET]) / k - scattered, LOWEST_LIGHT)
        sensor = np.square(f + scattered) * cov[:, FACTOR, FACTOR] + cov[:, OFFSET, OFFSET]
        self.mean[idx, start, LOG_F] = np.log(f)
        self.cov[idx, start, LOG_F, :], self.cov[idx, start, :, LOG_F] = 0.0, 0.0
        self.cov[idx, start, LOG_F, LOG_F] = (sensor + self.config.fluorescence_sd**2) / np.square(k * f)

    def _update(self, idx: Rows, which: int, reading: Array, noise: Array, on: Mask | None = None) -> None:
        """Update the rows `idx` iteratively, in Joseph's form; states that are not estimated have gain 0.

        Args: reading, noise: reading and variance of its noise, (n,). on: filters to update, (n, K); None: all.
        """
        prior, cov, noise = self.mean[idx], self.cov[idx], noise[:, None]
        estimated = np.ones((idx.size, 1, STATES), dtype=np.bool_)
        if which != SAMPLE:
            estimated[..., [FACTOR, OFFSET]] = False
            estimated[..., 0, GAIN] = self._minute[idx] - self._began[idx] < 60.0 * self.config.gain_h
        if on is not None:
            estimated = estimated & on[..., None]
        z = prior
        for _ in range(ITERATIONS):
            expected, slope = self._seen(z, which)
            towards = np.einsum("nkij,nkj->nki", cov, slope)
            gain = estimated * towards / (np.einsum("nki,nki->nk", slope, towards) + noise)[..., None]
            surprise = reading[:, None] - expected - np.einsum("nki,nki->nk", slope, prior - z)
            z = prior + gain * surprise[..., None]
        kept = np.eye(STATES) - gain[..., :, None] * slope[..., None, :]
        self.mean[idx] = z
        self.cov[idx] = kept @ cov @ kept.swapaxes(-1, -2) + noise[..., None, None] * _square(gain)

    def _mixed(self, of_starts: Array) -> Array:
        """Return each culture's weighted mean over its filters, (N,). Args: of_starts: values, (N, K)."""
        return np.asarray((self._weights() * of_starts).sum(axis=1))

    def estimate(self) -> ShareEstimate:
        """Return the current estimate; before the first reading it has the initial values."""
        z, mixed = self.mean, self._mixed
        logit, error = mixed(z[..., LOGIT]), mixed(z[..., THERMOMETER])
        variance = mixed(self.cov[..., LOGIT, LOGIT] + np.square(z[..., LOGIT] - logit[:, None]))
        weight, _ = _through(z[..., THERMOMETER])
        rate = mixed(np.einsum("nc,nkc->nk", self._lagged[:, 1], weight) * (1.0 + z[..., BIAS_P]))
        errors = mixed(z[..., BIAS_E]), mixed(z[..., BIAS_P])
        return ShareEstimate(logit, np.sqrt(np.maximum(variance, 0.0)), self._temperature + error, rate, *errors, error)

    def growth_errors(self) -> tuple[Array, Array]:
        """Return the relative errors of both growth curves and their sds, (N, 2) each."""
        both = self.mean[..., BIAS_E:GAIN]
        mean = np.stack([self._mixed(both[..., k]) for k in range(2)], axis=-1)
        inside = self.cov[..., [BIAS_E, BIAS_P], [BIAS_E, BIAS_P]] + np.square(both - mean[:, None])
        return mean, np.sqrt(np.stack([self._mixed(inside[..., k]) for k in range(2)], axis=-1))

    def explain(self) -> dict[str, Array]:
        """Return share with 95 % band, errors of growth curves and thermometer, flow, density, pigment; (N,) each."""
        now, (_, error_sds) = self.estimate(), self.growth_errors()
        low, high = (1.0 / (1.0 + np.exp(-now.logit - side * 1.96 * now.sd)) for side in (-1.0, 1.0))
        return {
            "ratio": now.share,
            "ratio_low": low,
            "ratio_high": high,
            "bias_e": now.error_e,
            "bias_p": now.error_p,
            "bias_e_sd": error_sds[:, 0],
            "bias_p_sd": error_sds[:, 1],
            "thermometer_error": now.thermometer,
            "dose_gain": self._mixed(self.mean[..., GAIN]),
            "dose_spread": self._mixed(np.sqrt(self._dose_variance(np.arange(len(self.mean))))),
            "composition_od": self._mixed(np.exp(self.mean[..., LOG_OD])),
            "pigment": self._mixed(np.exp(self.mean[..., LOG_F])),
        }


def _square(a: Array) -> Array:
    """Return the outer products a a', (..., S, S). Args: a: vectors, (..., S)."""
    return np.asarray(a[..., :, None] * a[..., None, :])


def _starts(k: int) -> tuple[Array, float]:
    """Return the positions of k starts, and the sd of each, both in units of the sd of their mixture."""
    if k == 1:
        return np.zeros(1), 1.0
    away = np.linspace(-1.0, 1.0, k)
    within = float(np.sqrt(1.0 - np.mean(away**2)))
    return away, within


def _through(error: Array) -> tuple[Array, Array]:
    """Return weights of values at `ERRORS_C` that give the polynomial through them at `error`, degC, and its slope."""
    at = np.clip(error, ERRORS_C[0], ERRORS_C[-1])[..., None]
    powers = np.arange(ERRORS_C.size)
    slope = powers * at ** np.maximum(powers - 1, 0)
    return at**powers @ LAGRANGE, slope @ LAGRANGE
