"""Kalman filter for OD, growth rate, pump gain and the effect of temperature on growth, of N vials."""

from copy import copy
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.task import EnvConfig
from experiments.laws.base import Array, Mask, usable

USUAL = 0.75  # mean square of the innovations, in units of their sd, while the model holds
SHARE_SD = 0.02  # sd of changes of the growth share at rest that the filter does not model
LOG_OD, MU, GAIN, WARMTH = range(4)


@dataclass(frozen=True)
class Fixed:
    """Constants of the filter; a certificate contains them and the settings."""

    lowest_od: float = 0.005  # lower readings count as this OD, because their logarithm is meaningless
    gain_range: tuple[float, float] = (0.2, 3.0)  # relative pump gain of a working pump head
    noise_range: tuple[float, float] = (0.1, 100.0)  # learned variance divided by the assumed variance
    trend_weight: float = 0.4  # weight of the newest innovation in the running mean
    calm: float = 1.5  # a running mean up to this many sd does not indicate a change
    farthest: float = 3.0  # larger innovations count as this many sd
    last: int = 10  # number of readings monitored for too large innovations
    long: int = 40  # number of readings monitored for too small innovations
    loud: float = 21.0  # alarm above this sum of the last 10 squares; gives less than one false alarm a day
    quiet: float = 6.0 / 40.0  # alarm below this mean of the last 40 squares: the filter's sd is too large


FIXED = Fixed()
TREND_SD = (FIXED.trend_weight / (2.0 - FIXED.trend_weight)) ** 0.5  # sd of the running mean while the model holds


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of the filter, with the sources of the defaults.

    The measured noise at low OD is 0.0033 OD; the device makers' own filter uses 0.005. In the literature mu in one
    medium is 0.018 to 0.032 1/min. Pump heads differ by up to 50 %; the measured spread of doses is 0.05 to 0.30.
    Growth falls by up to 40 % from 37 to 30 degC.
    """

    kind: str = setting("kalman", "estimator")
    noise_floor: float = setting(0.005, "sd of a reading = hypot(floor, relative * OD)", "OD", within=(1e-4, 0.1))
    noise_relative: float = setting(0.003, "see noise_floor", within=(0, 0.1))
    noise_memory: float = setting(
        40.0, "readings over which the noise level is learned; 0: not learned", "readings", within=(0, 10_000)
    )
    mu_sd: float = setting(0.012, "sd of the initial mu", "1/min", within=(1e-5, 0.1))
    mu_walk: float = setting(2e-4, "random walk of mu", "1/min per sqrt(min)", within=(0, 0.01))
    gain_sd: float = setting(0.25, "sd of the initial gain (true flow / calibrated flow)", within=(0, 1))
    gain_walk: float = setting(2e-3, "random walk of the gain", "per sqrt(min)", within=(0, 0.1))
    warmth: float = setting(
        0.025, "initial relative change of growth per degree (0 to 40 % in 7 degrees)", "1/degC", within=(0, 0.2)
    )
    warmth_sd: float = setting(
        0.02, "sd of initial warmth; if both are 0, temperature is not used", "1/degC", within=(0, 0.2)
    )
    pulse_cv: float = setting(0.15, "relative spread of a dose", within=(0, 1))
    first_dose: float = setting(0.7, "fraction delivered by the first dose after a pause: 0.3 to 1", within=(0.1, 1))
    first_dose_sd: float = setting(0.25, "sd of first_dose", within=(0, 1))
    pause_min: float = setting(10.0, "shortest pause before a first dose", "min", within=(1, 1440))
    growth_cv: float = setting(0.05, "spread of growth within a minute, relative to mu (assumption)", within=(0, 1))
    gate_sigma: float = setting(5.0, "a reading with a larger innovation is an outlier", "sigma", within=(2, 20))
    gate_max: int = setting(
        6, "this many agreeing outliers in a row are accepted; bubbles: up to 5", "readings", within=(1, 20)
    )
    gate_od: float = setting(
        0.025,
        "a jump of OD is accepted after jump / gate_od agreeing readings, at least 2, at most gate_max; 0: gate_max",
        "OD",
        within=(0, 1),
        note="accepting a small jump does little harm",
    )
    hurry: float = setting(
        150.0,
        "faster random walks while innovations agree in sign: variance times 1 + hurry (m - 1.5)^2 if their running "
        "mean is m > 1.5 of its sd; 0: never",
        within=(0, 10_000),
    )
    recovery: bool = setting(True, "use readings before the schedule begins")
    told: bool = setting(True, "use the delivered volume, not the requested volume")

    def __post_init__(self) -> None:
        check(self, "controller.estimator")


def fixed() -> dict[str, Any]:
    """Return the constants that affect decisions, by name."""
    return asdict(FIXED)


class Estimator:
    """Kalman filter with state z = [ln x, mu, g, w] for N vials.

    x is OD, mu the growth rate at the first temperature T0, g the relative pump gain, w = dmu/dT. With the model's
    nominal volume 60 tau (for a pump of 1 mL/s), a dose of V mL and dt minutes change the state by

      ln x <- ln x + dt (mu + w (T - T0)) - g V/(60 tau),   mu and g random walks,   y = ln(reading) = ln x + noise

    This is linear for a known dose and temperature, so a time-varying Kalman filter (Kalman 1960) is exact. Further
    parts: the filter learns the noise level from the innovations. It ignores a reading beyond `gate_sigma` unless the
    following readings agree with it; then it resets only OD. It expects a smaller first dose after a pause. mu and g
    may change faster while innovations agree in sign.

    Args: config: settings. model: initial mu, tau, control period and largest pump rate.
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
        self._heard = False  # whether delivered volumes are reported
        self._noise, self._learned = np.ones(n), np.zeros(n)
        self._far, self._far_surprise = np.zeros(n, dtype=np.int64), np.zeros(n)
        self._trend = np.zeros(n)  # running mean of the innovations in units of their sd
        self._squares = np.full((n, FIXED.long), np.nan)  # squares of the newest innovations

    def dosed(self, volume_ml: Array) -> None:
        if self.config.told:
            self._given_ml, self._heard = volume_ml + (self._given_ml if self._heard else 0.0), True

    def decided(self, rate: Array) -> None:
        """Process the decided pump rates, mL/s, (N,); they count as delivered until volumes are reported."""
        if not self._heard:
            self._given_ml = 60.0 * self.model.control_min * rate

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Store the temperatures and, with setting `recovery`, process the readings of `rows`, as `see` does."""
        self._thermometer = np.where(np.isfinite(temperature), temperature, self._thermometer)
        if self.config.recovery:
            self.see(od, minute, rows)

    def see(self, od: Array, minute: Array, rows: Mask) -> None:
        """Update the estimates with the new readings of `rows`; arrays (N,); nan is no reading."""
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
        """Return the assumed variance of the logarithm of a reading, without the learned noise level."""
        return np.asarray(np.hypot(self.config.noise_floor, self.config.noise_relative * reading) ** 2 / reading**2)

    def ahead(self, steps_min: Array, volume_ml: Array) -> Array:
        """Predict ln of the readings of one vial after K further steps: mean and sd, (K, 2), without a change of state.

        Args: steps_min: length of each step, (K,). volume_ml: dose at the start of each step, (K,).
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
        """Return the mean temperature since the last reading minus the first temperature, degC; 0 if unknown."""
        now = self._thermometer[idx]
        before = np.where(np.isfinite(self._warm[idx]), self._warm[idx], now)
        self._first_warm[idx] = np.where(np.isfinite(self._first_warm[idx]), self._first_warm[idx], now)
        self._warm[idx] = now
        return np.asarray(np.nan_to_num(0.5 * (now + before) - self._first_warm[idx]))

    def _predict(self, idx: NDArray[np.intp], dt: Array, warmer: Array) -> None:
        """Predict the state of the rows `idx` after the dose and dt minutes. Args: warmer: as `_warmer` returns."""
        c, n = self.config, idx.size
        dose = self._given_ml[idx] / (60.0 * self.model.tau)  # decrease of ln OD by a pump of gain 1
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
        """Update the rows `idx` with readings y = ln OD. Args: assumed: variances. began: had a reading before."""
        c, mean, cov = self.config, self.mean[idx], self.cov[idx]
        surprise = y - mean[:, LOG_OD]
        variance = assumed * self._noise[idx]
        total = cov[:, LOG_OD, LOG_OD] + variance
        far = (np.abs(surprise) > c.gate_sigma * np.sqrt(total)) & began
        agrees = np.abs(surprise - self._far_surprise[idx]) < c.gate_sigma * np.sqrt(2.0 * variance)
        self._far[idx] = np.where(far, np.where(agrees, self._far[idx], 0) + 1, 0)
        self._far_surprise[idx] = surprise
        # A first reading or a persistent jump resets only the OD.
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
        """Update the ratio of noise variance to assumed variance: a running mean that starts as five readings of 1."""
        if not self.config.noise_memory:
            return
        self._learned[idx] += 1.0
        weight = 1.0 / np.minimum(self._learned[idx] + 5.0, self.config.noise_memory)
        level = self._noise[idx] + weight * (np.clip(observed, 0.0, FIXED.noise_range[1]) - self._noise[idx])
        self._noise[idx] = np.clip(level, *FIXED.noise_range)

    @property
    def gain(self) -> Array:
        """Relative pump gain, cut to its possible range, (N,)."""
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
        """Sum of squares of the last ten innovations in units of their sd, each cut to 9; usually about 8."""
        return np.asarray(np.nansum(self._squares[:, -FIXED.last :], axis=1))

    @property
    def square(self) -> Array:
        """Square of the newest innovation in units of its sd, cut to 9, (N,); nan before the second reading."""
        return np.asarray(self._squares[:, -1])

    @property
    def loud(self) -> NDArray[np.bool_]:
        return np.asarray(self.loudness > FIXED.loud)

    @property
    def quiet(self) -> NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            return np.asarray(self._squares.mean(axis=1) < FIXED.quiet)

    def doubt(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the filter's standard deviations of error e and growth share s, (N,) each.

        They are first-order and use the covariances of ln x, mu and g: at rest, mu = g u / tau is known better than mu
        or g. For e, B is assumed exact, because the proof treats an error of the gain separately.
        """
        warmer = np.nan_to_num(self._warm - self._first_warm)
        share, period = self.relative(setpoint)[1], self.model.control_min / self.full_pump
        slope = np.stack([np.zeros_like(share), period, -share / self.gain, period * warmer], axis=1)
        variance = np.einsum("ni,nij,nj->n", slope, self.cov, slope)
        return np.sqrt(self.cov[:, LOG_OD, LOG_OD]) / self.full_pump, np.sqrt(np.maximum(variance, 0.0))

    def sd(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of e and s that are reported to the user, (N,) each; both grow with recent innovations.

        The sd of e includes the uncertainty of B. The sd of s refers to the growth share at rest and includes SHARE_SD.
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
        """Return OD, growth rate (1/min), relative pump gain, and a reading's sd divided by the assumed sd."""
        od, mu, gain = np.exp(self.mean[:, LOG_OD]), self.mean[:, MU].copy(), self.mean[:, GAIN].copy()
        return {"od_estimate": od, "mu": mu, "gain": gain, "noise": np.sqrt(self._noise)}
