"""Kalman filter for OD, growth rate, pump gain and the effect of temperature on growth, of N vials."""

from copy import copy
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.task import EnvConfig
from experiments.laws.base import Array, Mask, usable

USUAL = 0.75  # mean square of an innovation on a sound reactor
SHARE_SD = 0.02  # change of the growth share at rest besides the filter's error of it
LOG_OD, MU, GAIN, WARMTH = range(4)


@dataclass(frozen=True)
class Fixed:
    """Constants of the filter; a certificate has them beside the settings."""

    lowest_od: float = 0.005  # below it the logarithm of a reading is meaningless
    gain_range: tuple[float, float] = (0.2, 3.0)  # of the relative pump gain; a head outside is broken
    noise_range: tuple[float, float] = (0.1, 100.0)  # of the learned variance over the assumed one
    trend_weight: float = 0.4  # weight of the newest innovation in the running mean
    calm: float = 1.5  # a mean within this many sd is no sign of a change
    farthest: float = 3.0  # limit of an innovation in sd
    last: int = 10  # newest readings monitored for too large innovations ...
    long: int = 40  # ... and for too small ones
    loud: float = 21.0  # sum of the last squares above which the filter is wrong: less than one false alarm a day
    quiet: float = 6.0 / 40.0  # mean of the long window below which its sd is too large


FIXED = Fixed()
TREND_SD = (FIXED.trend_weight / (2.0 - FIXED.trend_weight)) ** 0.5  # of that mean while the model holds


@dataclass(frozen=True)
class EstimatorConfig:
    """Prior of sensor and plant, and active parts of the filter.

    Measured noise of a reading is 0.0033 OD at the floor; 0.005 is the value of the device makers' own filter.
    mu of one medium spans 0.018 to 0.032 1/min in the literature. Heads of a pump differ up to 50 %; the measured
    spread of a dose is 0.05 to 0.30. Growth falls by up to 40 % from 37 to 30 degC.
    """

    kind: str = setting("kalman", "estimator")
    noise_floor: float = setting(0.005, "sd of a reading = hypot(floor, relative * OD)", "OD", within=(1e-4, 0.1))
    noise_relative: float = setting(0.003, "see noise_floor", within=(0, 0.1))
    noise_memory: float = setting(
        40.0, "readings over which the noise level is learned; 0: not learned", "readings", within=(0, 10_000)
    )
    mu_sd: float = setting(0.012, "sd of the initial mu, around the model's", "1/min", within=(1e-5, 0.1))
    mu_walk: float = setting(2e-4, "random walk of mu", "1/min per sqrt(min)", within=(0, 0.01))
    gain_sd: float = setting(0.25, "sd of the initial gain: true over calibrated flow of the pump", within=(0, 1))
    gain_walk: float = setting(2e-3, "random walk of the gain", "per sqrt(min)", within=(0, 0.1))
    warmth: float = setting(
        0.025, "relative change of growth per degree: 0 to 40 % over 7 degrees", "1/degC", within=(0, 0.2)
    )
    warmth_sd: float = setting(
        0.02, "sd of that initial value; 0 with warmth = 0: temperature is not used", "1/degC", within=(0, 0.2)
    )
    pulse_cv: float = setting(0.15, "relative spread of a dose", within=(0, 1))
    first_dose: float = setting(0.7, "fraction delivered by the first dose after a pause: 0.3 to 1", within=(0.1, 1))
    first_dose_sd: float = setting(0.25, "sd of that fraction", within=(0, 1))
    pause_min: float = setting(10.0, "length of such a pause", "min", within=(1, 1440))
    growth_cv: float = setting(0.05, "spread of the growth within a minute, relative to mu (assumption)", within=(0, 1))
    gate_sigma: float = setting(5.0, "innovation above which a reading is an outlier", "sigma", within=(2, 20))
    gate_max: int = setting(
        6, "agreeing outliers in a row that are accepted; bubbles: up to 5", "readings", within=(1, 20)
    )
    gate_od: float = setting(
        0.025,
        "a jump is accepted after one agreeing reading per this much OD, at least 2, at most gate_max; 0: gate_max",
        "OD",
        within=(0, 1),
        note="the smaller it is, the less harm following it does",
    )
    hurry: float = setting(
        150.0,
        "speed-up of the random walks while innovations agree in sign: variance times 1 + hurry (m - 1.5)^2 if their "
        "running mean is m > 1.5 of its sd; 0: none",
        within=(0, 10_000),
    )
    recovery: bool = setting(True, "use readings before the schedule begins")
    told: bool = setting(True, "use the volume delivered instead of the volume requested")

    def __post_init__(self) -> None:
        check(self, "controller.estimator")


def fixed() -> dict[str, Any]:
    """Return the constants that affect decisions, by name."""
    return asdict(FIXED)


class Estimator:
    """State z = [ln x, mu, g, w]: OD x, growth rate mu at the first temperature T0, relative pump gain g, w = dmu/dT.

    dt minutes after a dose V mL over the nominal volume 60 tau of the model (tau for a pump of 1 mL/s)

      ln x <- ln x + dt (mu + w (T - T0)) - g V/(60 tau),   mu and g random walks,   y = ln(reading) = ln x + noise

    which is linear for a known dose and temperature: a time-varying Kalman filter (Kalman 1960), exact without
    linearising. Further parts: the noise level is learned from the innovations. A reading beyond `gate_sigma` is
    ignored unless following readings agree, and then only OD is reset. The first dose after a pause is expected to be
    smaller. mu and g may change faster while innovations agree in sign.

    Args: config: prior and parts; model: mu, tau, control period and largest pump rate, the initial estimate.
    """

    remembers = (
        "mean", "cov", "minute", "thermometer", "warm", "first_warm", "given_ml", "idle_min", "heard", "noise",
        "learned", "far", "far_surprise", "trend", "squares",
    )  # fmt: skip

    def __init__(self, config: EstimatorConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.reset(1)

    def reset(self, n: int) -> None:
        c, mu = self.config, self.model.mu
        self.mean = np.tile([0.0, mu, 1.0, c.warmth * mu], (n, 1))
        self.cov = np.tile(np.diag([0.0, c.mu_sd**2, c.gain_sd**2, (c.warmth_sd * mu) ** 2]), (n, 1, 1))
        self._minute, self._thermometer, self._warm, self._first_warm = (np.full(n, np.nan) for _ in range(4))
        self._given_ml, self._idle_min = np.zeros(n), np.zeros(n)
        self._heard = False  # volumes delivered are reported
        self._noise, self._learned = np.ones(n), np.zeros(n)
        self._far, self._far_surprise = np.zeros(n, dtype=np.int64), np.zeros(n)
        self._trend = np.zeros(n)  # running mean of the innovations in units of their sd
        self._squares = np.full((n, FIXED.long), np.nan)  # squares of the newest of them

    def dosed(self, volume_ml: Array) -> None:
        if self.config.told:
            self._given_ml, self._heard = volume_ml + (self._given_ml if self._heard else 0.0), True

    def decided(self, rate: Array) -> None:
        """Take the decided pump rates, mL/s, (N,); they count as delivered until volumes are reported."""
        if not self._heard:
            self._given_ml = 60.0 * self.model.control_min * rate

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Take the temperatures and, with `recovery`, the readings of `rows`; arguments as `see`."""
        self._thermometer = np.where(np.isfinite(temperature), temperature, self._thermometer)
        if self.config.recovery:
            self.see(od, minute, rows)

    def see(self, od: Array, minute: Array, rows: Mask) -> None:
        """Take the new readings of `rows`, each shape (N,); nan is no reading."""
        idx = np.flatnonzero(usable(od, rows) & ~(minute <= self._minute))
        if not idx.size:
            return
        reading = np.maximum(od[idx], FIXED.lowest_od)
        began = ~np.isnan(self._minute[idx])
        dt = np.where(began, minute[idx] - np.where(began, self._minute[idx], 0.0), 0.0)
        self._predict(idx, dt, self._warmer(idx))
        self._update(idx, np.log(reading), self._assumed(reading), began)
        self._minute[idx] = minute[idx]
        if self._heard:
            self._given_ml[idx] = 0.0

    def _assumed(self, reading: Array) -> Array:
        """Variance of the logarithm of a reading, before the level of the noise is learned."""
        return np.asarray(np.hypot(self.config.noise_floor, self.config.noise_relative * reading) ** 2 / reading**2)

    def ahead(self, steps_min: Array, volume_ml: Array) -> Array:
        """Predict ln of readings after steps of so many minutes, each after a dose, (K,) of one vial: mean, sd, (K, 2).

        What it knows does not change.
        """
        future, one, found = copy(self), np.zeros(1, dtype=np.intp), []
        future.mean, future.cov, future._idle_min = self.mean.copy(), self.cov.copy(), self._idle_min.copy()
        warmer = np.nan_to_num(self._warm - self._first_warm)
        for minutes, ml in zip(steps_min, volume_ml, strict=True):
            future._given_ml = np.full(1, ml)
            future._predict(one, np.full(1, minutes), warmer)
            reading = np.maximum(np.exp(future.mean[:, LOG_OD]), FIXED.lowest_od)
            variance = future.cov[:, LOG_OD, LOG_OD] + self._assumed(reading) * self._noise
            found.append((future.mean[0, LOG_OD], np.sqrt(variance[0])))
        return np.reshape(found, (-1, 2))

    def _warmer(self, idx: NDArray[np.intp]) -> Array:
        """Return the mean temperature since the previous reading, relative to the first, degC; 0 if unknown."""
        now = self._thermometer[idx]
        before = np.where(np.isfinite(self._warm[idx]), self._warm[idx], now)
        self._first_warm[idx] = np.where(np.isfinite(self._first_warm[idx]), self._first_warm[idx], now)
        self._warm[idx] = now
        return np.asarray(np.nan_to_num(0.5 * (now + before) - self._first_warm[idx]))

    def _predict(self, idx: NDArray[np.intp], dt: Array, warmer: Array) -> None:
        """Advance the rows `idx` by dt minutes, the dose, and the temperature difference."""
        c, n = self.config, idx.size
        dose = self._given_ml[idx] / (60.0 * self.model.tau)  # ln of the dilution by a normal pump
        first = (self._idle_min[idx] >= c.pause_min) & (dose > 0.0)
        self._idle_min[idx] = np.where(dose > 0.0, 0.0, self._idle_min[idx] + dt)
        arrives = np.where(first, c.first_dose, 1.0)
        spread = np.hypot(c.pulse_cv, np.where(first, c.first_dose_sd, 0.0))
        step = np.tile(np.eye(4), (n, 1, 1))
        step[:, LOG_OD, MU], step[:, LOG_OD, GAIN], step[:, LOG_OD, WARMTH] = dt, -dose * arrives, dt * warmer
        faster = 1.0 + c.hurry * np.maximum(np.abs(self._trend[idx]) / TREND_SD - FIXED.calm, 0.0) ** 2
        noise = np.zeros((n, 4, 4))
        noise[:, LOG_OD, LOG_OD] = (spread * dose) ** 2 + (c.growth_cv * self.model.mu) ** 2 * dt
        noise[:, MU, MU], noise[:, GAIN, GAIN] = c.mu_walk**2 * dt * faster, c.gain_walk**2 * dt * faster
        self.mean[idx] = np.einsum("nij,nj->ni", step, self.mean[idx])
        self.cov[idx] = np.einsum("nij,njk,nlk->nil", step, self.cov[idx], step) + noise

    def _update(self, idx: NDArray[np.intp], y: Array, assumed: Array, began: Mask) -> None:
        """Update the rows `idx` with y = ln OD and its assumed variances."""
        c, mean, cov = self.config, self.mean[idx], self.cov[idx]
        surprise = y - mean[:, LOG_OD]
        variance = assumed * self._noise[idx]
        total = cov[:, LOG_OD, LOG_OD] + variance
        far = (np.abs(surprise) > c.gate_sigma * np.sqrt(total)) & began
        agrees = np.abs(surprise - self._far_surprise[idx]) < c.gate_sigma * np.sqrt(2.0 * variance)
        self._far[idx] = np.where(far, np.where(agrees, self._far[idx], 0) + 1, 0)
        self._far_surprise[idx] = surprise
        # A first reading, or a persistent jump, resets only the OD.
        jump = np.abs(np.expm1(surprise)) * np.exp(mean[:, LOG_OD])
        asked = np.clip(np.ceil(jump / c.gate_od), 2, c.gate_max) if c.gate_od else c.gate_max
        anew = ~began | (self._far[idx] >= asked)
        kalman = cov[:, :, LOG_OD] / total[:, None]
        better = np.where(far[:, None], mean, mean + kalman * surprise[:, None])
        smaller = np.where(far[:, None, None], cov, cov - kalman[:, :, None] * cov[:, None, LOG_OD, :])
        better[anew, LOG_OD], better[anew, MU:] = y[anew], mean[anew, MU:]
        fresh = cov.copy()
        fresh[:, LOG_OD, :], fresh[:, :, LOG_OD] = 0.0, 0.0
        fresh[:, LOG_OD, LOG_OD] = variance
        self.mean[idx] = better
        self.cov[idx] = np.where(anew[:, None, None], fresh, smaller)
        self._far[idx] = np.where(anew, 0, self._far[idx])
        self._learn(idx[~far & began], (surprise**2 - cov[:, LOG_OD, LOG_OD])[~far & began] / assumed[~far & began])
        square = np.where(began, np.minimum(surprise**2 / total, FIXED.farthest**2), np.nan)
        self._squares[idx] = np.concatenate([self._squares[idx, 1:], square[:, None]], axis=1)
        trend = self._trend[idx] + FIXED.trend_weight * (surprise / np.sqrt(total) - self._trend[idx])
        self._trend[idx] = np.where(anew, 0.0, np.where(far, self._trend[idx], trend))

    def _learn(self, idx: NDArray[np.intp], observed: Array) -> None:
        """Learn the noise variance over the assumed one, as an average that begins with five readings' weight of 1."""
        if not self.config.noise_memory:
            return
        self._learned[idx] += 1.0
        weight = 1.0 / np.minimum(self._learned[idx] + 5.0, self.config.noise_memory)
        level = self._noise[idx] + weight * (np.clip(observed, 0.0, FIXED.noise_range[1]) - self._noise[idx])
        self._noise[idx] = np.clip(level, *FIXED.noise_range)

    @property
    def gain(self) -> Array:
        """Relative pump gain within its possible range, (N,)."""
        return np.asarray(np.clip(self.mean[:, GAIN], *FIXED.gain_range))

    @property
    def full_pump(self) -> Array:
        """B = g u_max h / tau: decrease of ln x in one period at full pump rate, (N,)."""
        m = self.model
        return np.asarray(self.gain * m.max_pump_rate * m.control_min / m.tau)

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the current error e = ln(x/r)/B and growth share s = mu h / B (`envs/relative.py`), each (N,)."""
        warmer = np.nan_to_num(self._warm - self._first_warm)
        mu = self.mean[:, MU] + self.mean[:, WARMTH] * warmer
        error = self.mean[:, LOG_OD] - np.log(np.maximum(setpoint, FIXED.lowest_od))
        return error / self.full_pump, mu * self.model.control_min / self.full_pump

    @property
    def loudness(self) -> Array:
        """Sum of squares of the last ten innovations in units of their sd, each at most 9; normally about 8."""
        return np.asarray(np.nansum(self._squares[:, -FIXED.last :], axis=1))

    @property
    def square(self) -> Array:
        """Square of the newest innovation in units of its sd, at most 9, (N,); nan before the second reading."""
        return np.asarray(self._squares[:, -1])

    @property
    def loud(self) -> NDArray[np.bool_]:
        return np.asarray(self.loudness > FIXED.loud)

    @property
    def quiet(self) -> NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            return np.asarray(self._squares.mean(axis=1) < FIXED.quiet)

    def doubt(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the filter's standard deviations of the error e and of the growth share s of `relative`, each (N,).

        To first order, with the covariances of ln x, mu and g: at rest mu = g u / tau is known better than either. For
        e, B counts as known, as in the proof, which treats an error of the gain separately.
        """
        warmer = np.nan_to_num(self._warm - self._first_warm)
        share, period = self.relative(setpoint)[1], self.model.control_min / self.full_pump
        slope = np.stack([np.zeros_like(share), period, -share / self.gain, period * warmer], axis=1)
        variance = np.einsum("ni,nij,nj->n", slope, self.cov, slope)
        return np.sqrt(self.cov[:, LOG_OD, LOG_OD]) / self.full_pump, np.sqrt(np.maximum(variance, 0.0))

    def sd(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the standard deviations for the user: with B's uncertainty in e, scaled by recent innovations.

        The sd of s refers to the growth share at rest, which has a further change.
        """
        _, share = self.doubt(setpoint)
        slope = np.zeros((len(share), 4))
        slope[:, LOG_OD], slope[:, GAIN] = 1.0 / self.full_pump, -self.relative(setpoint)[0] / self.gain
        error = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", slope, self.cov, slope), 0.0))
        larger = np.ones_like(share)
        for recent in (self._squares[:, -FIXED.last :], self._squares):
            count = np.maximum(np.isfinite(recent).sum(axis=1), 1)
            larger = np.maximum(larger, np.sqrt(np.nansum(recent, axis=1) / count / USUAL))
        return error * larger, np.hypot(share * larger, SHARE_SD)

    def explain(self) -> dict[str, Array]:
        """Explain the estimates: OD, growth rate (1/min), relative pump gain, sd of a reading over the assumed one."""
        od, mu, gain = np.exp(self.mean[:, LOG_OD]), self.mean[:, MU].copy(), self.mean[:, GAIN].copy()
        return {"od_estimate": od, "mu": mu, "gain": gain, "noise": np.sqrt(self._noise)}
