"""What is known of two species in one vial: a Kalman filter on OD, fluorescence, temperature and doses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.bench import Bench
from envs.coculture.rates import EQUAL_RATES_C, LAG_E_MIN, LAG_P_MIN, e_coli_rate, p_putida_rate
from envs.plant.fluorescence import DELAY_MIN, FOLLOW_PER_H, LEAST, steady_production
from experiments.laws.share.base import Array, Estimate, Mask

__all__ = ["CompositionEstimator", "CompositionEstimatorConfig"]

LOGIT, LOG_OD, LOG_F, BIAS_E, BIAS_P, GAIN, FACTOR, OFFSET = range(8)
STATES = 8
CONSIDERED = (FACTOR, OFFSET)
DILUTED = slice(LOG_OD, BIAS_E)
LOWEST_OD = 0.005  # below it a first reading says nothing
LOWEST_LIGHT = 1.0  # counts; what the logarithm of the pigment begins from at least
ITERATIONS = 3  # of an update, about the newest estimate
LONGEST_STEP_MIN = 1.0


@dataclass(frozen=True)
class CompositionEstimatorConfig:
    """What the filter believes before it has seen anything.

    Seventeen real reactors had factors of 0.75 to 1.19 and offsets of 151 to 339 counts (Lee et al., Cell Reports
    Methods 5:101009, 2025, public model); their mean and spread are the defaults, which a calibration replaces
    (docs/coculture.md, Calibration of the sensor).
    """

    share: float = setting(0.5, "first guess of the share of P. putida", above=0.0, below=1.0)
    share_sd: float = setting(1.0, "sd of its logit: 0.12 to 0.88 in 95 %", above=0.0, at_most=5.0)
    bias_sd: float = setting(0.07, "sd of a growth curve's relative error", within=(0, 0.5))
    bias_walk: float = setting(2e-4, "its random walk", "1/sqrt(min)", within=(0, 0.05))
    growth_sd: float = setting(3e-4, "spread of either species' growth within a minute", "1/sqrt(min)", within=(0, 0.1))
    pigment_sd: float = setting(1e-3, "spread of ln pigment within a minute", "1/sqrt(min)", within=(0, 0.1))
    pigment_first_sd: float = setting(0.5, "sd of the first guess of ln (pigment over its balance)", within=(0.01, 5))
    gain_sd: float = setting(0.05, "sd of the pump's true flow over the calibrated one", within=(0, 1))
    dose_cv: float = setting(0.1, "spread of a dose", within=(0, 1))
    od_sd: float = setting(0.005, "of an OD reading", "OD", within=(1e-4, 0.1))
    fluorescence_sd: float = setting(30.0, "of a fluorescence reading", "counts", within=(0.1, 10_000))
    od_term: float = setting(150.0, "light that cells of any kind scatter into the band", "counts/OD", within=(0, 5000))
    factor: float = setting(0.99, "k of the reading k (f + od_term OD) + offset", within=(0.05, 20))
    factor_sd: float = setting(0.13, "its sd", within=(0, 5))
    factor_walk: float = setting(0.005, "its relative random walk: lamp, optics, biofilm", "1/sqrt(day)", within=(0, 1))
    offset: float = setting(214.0, "of the reading", "counts", within=(0, 20_000))
    offset_sd: float = setting(45.0, "its sd", "counts", within=(0, 5000))
    gate_sigma: float = setting(5.0, "a reading further off than this is an outlier ...", "sigma", within=(2, 20))
    gate_max: int = setting(6, "... unless it is so many times in a row", "readings", within=(1, 100))

    def __post_init__(self) -> None:
        check(self, "composition.estimator")


class CompositionEstimator:
    """State z = [x, ln S, ln f, b_e, b_p, g, k, o]: logit of the share of P. putida, OD of both species, pigment,
    errors of the two growth curves, true over calibrated flow of the pump, factor and offset of the light sensor. With
    e = S/(1 + exp x) and p = S - e, and over h hours in which v of V mL were replaced

      x <- x + h (1 + b_p) m_p - h (1 + b_e) m_e      b_e, b_p, k random walks
      ln S <- ln(e exp(h (1 + b_e) m_e) + p exp(h (1 + b_p) m_p)) - g v/V
      ln f <- ln(f + h q p) - g v/V
      OD = S + noise                                  FL = k (f + 150 S) + o + noise

    with m_e, m_p the curves' rates, 1/h, lagging the measured temperature by 2 and 60 min, and q the production of
    pigment, whose delayed answer to temperature is known (docs/plant.md, Two species). In these coordinates the OD says
    nothing of the share at once, however unsure that is; in ln e and ln p a linearised filter soon believes too much.

    An extended Kalman filter, iterated about the newest estimate (Bell, Cathey 1993), in Joseph's form. k and o are
    considered and not estimated (Schmidt 1966): how unsure they are counts in every gain, but no reading changes them,
    because in a week at one temperature nothing tells a sensor that drifts from a culture that does.
    A reading further off than `gate_sigma` is left out, and with an OD the light beside it. Where it stays, the density
    with the pigment, or the pigment alone, is set anew, and the share learns nothing from it. Doses must be told.

    State: mean (N, 8), cov (N, 8, 8). Args: config: first guesses and noise. volume_ml: V, (N,) or one for all.
    """

    remembers = ("mean", "cov", "minute", "temperature", "lagged", "production", "past", "given_ml", "far")

    def __init__(self, config: CompositionEstimatorConfig, volume_ml: Array | float = Bench.volume_ml) -> None:
        self.config, self._volume_ml = config, volume_ml
        self.reset(1)

    def reset(self, n: int) -> None:
        """Forget everything; N cultures that have not been seen yet."""
        c = self.config
        self.mean = np.zeros((n, STATES))
        self.mean[:, GAIN] = 1.0
        self.mean[:, FACTOR], self.mean[:, OFFSET] = c.factor, c.offset
        self.cov = np.tile(
            np.diag(np.square([0.0, 0.0, 0.0, c.bias_sd, c.bias_sd, c.gain_sd, c.factor_sd, c.offset_sd])), (n, 1, 1)
        )
        self._minute, self._given_ml = np.full(n, np.nan), np.zeros(n)
        self._temperature = np.full(n, EQUAL_RATES_C)
        self._lagged, self._production = np.zeros((n, 2)), np.zeros(n)
        self._past = np.zeros((n, DELAY_MIN))
        self._far = np.zeros((n, 2), dtype=np.int64)

    def calibrate(self, factor: Array, factor_sd: Array, offset: Array, offset_sd: float) -> None:
        """Each culture's own sensor, before its first reading: factor, its sd and offset, (N,) each; in counts."""
        self.mean[:, FACTOR], self.mean[:, OFFSET] = factor, offset
        self.cov[:, FACTOR, FACTOR], self.cov[:, OFFSET, OFFSET] = factor_sd**2, offset_sd**2

    @property
    def begun(self) -> Mask:
        """Which cultures have been seen, (N,)."""
        return np.asarray(np.isfinite(self._minute))

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in since this was last called, mL, (N,)."""
        self._given_ml = self._given_ml + volume_ml

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Take the readings of `rows` that were not taken yet, each (N,).

        Args: od; fluorescence: counts; temperature: degC; nan: none, or none that is believed, which is skipped.
          minute: when they were taken, on any clock that only rises.
        """
        new = rows & ~(minute <= self._minute)
        first = np.flatnonzero(new & np.isnan(self._minute) & (od > LOWEST_OD))
        going = np.flatnonzero(new & np.isfinite(self._minute))
        if first.size:
            self._begin(first, od[first], temperature[first])
        if going.size:
            self._elapse(going, minute[going] - self._minute[going], temperature[going])
            self._take(going, 0, od[going])
        seen = np.concatenate([first, going])
        self._take(seen, 1, np.where(self._far[seen, 0] > 0, np.nan, fluorescence[seen]))
        self._minute[seen] = minute[seen]
        self._given_ml[seen] = 0.0

    def _begin(self, idx: NDArray[np.intp], od: Array, temperature: Array) -> None:
        """First reading: its OD, the share as guessed, everything in balance with the temperature."""
        c, warm = self.config, np.where(np.isfinite(temperature), temperature, EQUAL_RATES_C)
        self._temperature[idx] = warm
        self._lagged[idx] = np.stack([e_coli_rate(warm), p_putida_rate(warm)], axis=1)
        self._production[idx] = steady_production(warm)
        self._past[idx] = self._production[idx, None]
        made = np.maximum(self._production[idx] * c.share * od / self._lagged[idx, 1], LOWEST_LIGHT)
        self.mean[idx, LOGIT] = np.log(c.share / (1.0 - c.share))
        self.mean[idx, LOG_OD], self.mean[idx, LOG_F] = np.log(od), np.log(made)
        by_share = c.share_sd * np.array([1.0, 0.0, 1.0 - c.share])
        by_od = (c.od_sd / od)[:, None] * np.array([0.0, 1.0, 1.0])
        self.cov[idx, :3, :3] = np.outer(by_share, by_share) + by_od[:, :, None] * by_od[:, None, :]
        self.cov[idx, LOG_F, LOG_F] += c.pigment_first_sd**2

    def _elapse(self, idx: NDArray[np.intp], minutes: Array, temperature: Array) -> None:
        """Time passes in steps of at most a minute, temperature changes along a line, doses come at the beginning."""
        before = self._temperature[idx]
        after = np.where(np.isfinite(temperature), temperature, before)
        steps = np.maximum(np.ceil(minutes / LONGEST_STEP_MIN - 1e-6), 1.0)
        dose = self._given_ml[idx] / np.broadcast_to(self._volume_ml, self._given_ml.shape)[idx]
        for k in range(int(steps.max())):
            on = k < steps
            length, slope = (minutes / steps)[on], ((after - before) / steps)[on]
            mean = before[on] + (k + 0.5) * slope
            self._step(idx[on], length, mean, mean + 0.5 * slope, dose[on] if k == 0 else np.zeros(length.size))
        self._temperature[idx] = after

    def _step(self, idx: NDArray[np.intp], minutes: Array, mean: Array, last: Array, dose: Array) -> None:
        """One step. Args: mean, last: temperature in it and at its end, degC; dose: v/V."""
        c, z, hours = self.config, self.mean[idx], minutes / 60.0
        before, lag = self._lagged[idx], np.array([LAG_E_MIN, LAG_P_MIN])
        steady = np.stack([e_coli_rate(mean), p_putida_rate(mean)], axis=1)
        self._lagged[idx] = before + (steady - before) * -np.expm1(-minutes[:, None] / lag)
        grown = 0.5 * hours[:, None] * (before + self._lagged[idx])  # of each curve itself, (N, 2)
        growth = grown * (1.0 + z[:, BIAS_E:GAIN])
        share = 1.0 / (1.0 + np.exp(-z[:, LOGIT]))
        parts = np.stack([1.0 - share, share], axis=1) * np.exp(growth)
        total = parts.sum(axis=1)
        later = parts / total[:, None]  # both species' shares at the end
        made = hours * self._production[idx] * share * np.exp(z[:, LOG_OD] + 0.5 * growth[:, 1] - z[:, LOG_F])
        new = made / (1.0 + made)  # share of the pigment that is of this step
        z[:, LOGIT] += growth[:, 1] - growth[:, 0]
        z[:, LOG_OD] += np.log(total) - z[:, GAIN] * dose
        z[:, LOG_F] += np.log1p(made) - z[:, GAIN] * dose
        self.mean[idx] = z
        step = np.tile(np.eye(STATES), (idx.size, 1, 1))
        step[:, LOGIT, BIAS_E], step[:, LOGIT, BIAS_P] = -grown[:, 0], grown[:, 1]
        step[:, LOG_OD, LOGIT] = later[:, 1] - share
        step[:, LOG_OD, BIAS_E:GAIN] = later * grown
        step[:, LOG_F, LOGIT], step[:, LOG_F, LOG_OD] = new * (1.0 - share), new
        step[:, LOG_F, LOG_F], step[:, LOG_F, BIAS_P] = 1.0 - new, 0.5 * new * grown[:, 1]
        step[:, LOG_OD, GAIN] = step[:, LOG_F, GAIN] = -dose
        cov = step @ self.cov[idx] @ step.swapaxes(1, 2)
        cov[:, DILUTED, DILUTED] += ((c.dose_cv * dose) ** 2)[:, None, None]
        cov[:, FACTOR, FACTOR] += (c.factor * c.factor_walk) ** 2 * minutes / 1440.0
        for k, sd in enumerate((2.0**0.5 * c.growth_sd, c.growth_sd, c.pigment_sd, c.bias_walk, c.bias_walk)):
            cov[:, k, k] += sd**2 * minutes
        self.cov[idx] = cov
        self._produce(idx, minutes, last)

    def _produce(self, idx: NDArray[np.intp], minutes: Array, temperature: Array) -> None:
        """Production of pigment follows what the temperature asks for, less its own value half an hour ago."""
        now, past = self._production[idx], self._past[idx]
        wanted = now + FOLLOW_PER_H / 60.0 * minutes * (steady_production(temperature) - past[:, 0])
        self._past[idx] = np.concatenate([past[:, 1:], now[:, None]], axis=1)
        self._production[idx] = np.maximum(wanted, LEAST)

    def _seen(self, z: Array, which: int) -> tuple[Array, Array]:
        """Expected reading of states (N, 8) and its slope, (N,) and (N, 8). Args: which: 0 OD, 1 fluorescence."""
        od, f, k = np.exp(z[:, LOG_OD]), np.exp(z[:, LOG_F]), z[:, FACTOR]
        slope = np.zeros_like(z)
        if which == 0:
            slope[:, LOG_OD] = od
            return od, slope
        light = f + self.config.od_term * od
        slope[:, LOG_OD], slope[:, LOG_F] = k * self.config.od_term * od, k * f
        slope[:, FACTOR], slope[:, OFFSET] = light, 1.0
        return k * light + z[:, OFFSET], slope

    def _take(self, idx: NDArray[np.intp], which: int, reading: Array) -> None:
        """Update with one kind of reading; nan is skipped. Args: which: 0 OD, 1 fluorescence."""
        there = np.isfinite(reading)
        idx, reading = idx[there], reading[there]
        noise = (self.config.od_sd, self.config.fluorescence_sd)[which] ** 2
        prior, cov = self.mean[idx], self.cov[idx]
        expected, slope = self._seen(prior, which)
        spread = np.einsum("ni,nij,nj->n", slope, cov, slope) + noise
        far = np.square(reading - expected) > self.config.gate_sigma**2 * spread
        self._far[idx, which] = np.where(far, self._far[idx, which] + 1, 0)
        stays = self._far[idx, which] >= self.config.gate_max
        (self._density_anew, self._pigment_anew)[which](idx[stays], reading[stays])
        self._far[idx[stays], which] = 0
        self._update(idx[~far], which, reading[~far], noise)

    def _density_anew(self, idx: NDArray[np.intp], od: Array) -> None:
        """A density that jumped and stays is believed; maybe the pigment went with it, as by a dose nobody told."""
        found = np.log(np.maximum(od, LOWEST_OD))
        jump = found - self.mean[idx, LOG_OD]
        self.mean[idx, LOG_OD], self.mean[idx, LOG_F] = found, self.mean[idx, LOG_F] + jump
        self.cov[idx, LOG_F, LOG_F] += np.square(jump)
        self.cov[idx, LOG_OD, :], self.cov[idx, :, LOG_OD] = 0.0, 0.0
        self.cov[idx, LOG_OD, LOG_OD] = np.square(self.config.od_sd / np.exp(found))

    def _pigment_anew(self, idx: NDArray[np.intp], light: Array) -> None:
        """Light that jumped and stays is believed to be the pigment's."""
        z = self.mean[idx]
        k, scattered = z[:, FACTOR], self.config.od_term * np.exp(z[:, LOG_OD])
        f = np.maximum((light - z[:, OFFSET]) / k - scattered, LOWEST_LIGHT)
        sensor = np.square(f + scattered) * self.cov[idx, FACTOR, FACTOR] + self.cov[idx, OFFSET, OFFSET]
        self.mean[idx, LOG_F] = np.log(f)
        self.cov[idx, LOG_F, :], self.cov[idx, :, LOG_F] = 0.0, 0.0
        self.cov[idx, LOG_F, LOG_F] = (sensor + self.config.fluorescence_sd**2) / np.square(k * f)

    def _update(self, idx: NDArray[np.intp], which: int, reading: Array, noise: float) -> None:
        """Iterated update in Joseph's form, which holds for any gain; that of what is considered is zero."""
        prior, cov = self.mean[idx], self.cov[idx]
        z = prior
        for _ in range(ITERATIONS):
            expected, slope = self._seen(z, which)
            towards = np.einsum("nij,nj->ni", cov, slope)
            gain = towards / (np.einsum("ni,ni->n", slope, towards) + noise)[:, None]
            gain[:, CONSIDERED] = 0.0
            surprise = reading - expected - np.einsum("ni,ni->n", slope, prior - z)
            z = prior + gain * surprise[:, None]
        kept = np.eye(STATES) - gain[:, :, None] * slope[:, None, :]
        self.mean[idx] = z
        self.cov[idx] = kept @ cov @ kept.swapaxes(1, 2) + noise * gain[:, :, None] * gain[:, None, :]

    def estimate(self) -> Estimate:
        """Share, temperature and rate as they are believed; before the first reading the first guess."""
        sd = np.sqrt(np.maximum(self.cov[:, LOGIT, LOGIT], 0.0))
        rate = self._lagged[:, 1] * (1.0 + self.mean[:, BIAS_P])
        return Estimate(self.mean[:, LOGIT].copy(), sd, self._temperature.copy(), rate)

    def explain(self) -> dict[str, Array]:
        """Share with its 95 % band, relative errors of the growth curves, density, pigment in counts, each (N,)."""
        now = self.estimate()
        low, high = (1.0 / (1.0 + np.exp(-now.logit - side * 1.96 * now.sd)) for side in (-1.0, 1.0))
        return {
            "ratio": now.share,
            "ratio_low": low,
            "ratio_high": high,
            "bias_e": self.mean[:, BIAS_E].copy(),
            "bias_p": self.mean[:, BIAS_P].copy(),
            "dose_gain": self.mean[:, GAIN].copy(),
            "composition_od": np.exp(self.mean[:, LOG_OD]),
            "pigment": np.exp(self.mean[:, LOG_F]),
        }
