"""A Kalman filter for OD, growth rate and pump gain, and the pump rate that puts the next reading on the setpoint."""

from dataclasses import dataclass

import numpy as np

from conf.schema import check, setting
from envs.task import EnvConfig
from experiments.controllers.base import Array, Mask, usable

__all__ = ["AdaptiveInverse", "AdaptiveInverseConfig"]

LOWEST_OD = 0.005  # below it the logarithm of a reading says nothing
GAIN_RANGE = (0.2, 3.0)  # of the relative pump gain; a head outside is broken, not slow


@dataclass(frozen=True)
class AdaptiveInverseConfig:
    """What the filter believes about sensor and plant.

    Measured noise of a reading is 0.0033 OD at the floor; 0.005 is what the device's makers put into their own filter.
    mu of one medium spans 0.018 to 0.032 1/min in the literature. -40 % in the 30 min of a cooling vial is 0.0022 per
    sqrt(30 min). Heads of a pump differ up to 50 %; the measured spread of a dose is 0.05 to 0.30.
    """

    kind: str = setting("adaptive_inverse", "which controller")
    noise_floor: float = setting(0.005, "sd of a reading = hypot(floor, relative * OD)", "OD", within=(1e-4, 0.1))
    noise_relative: float = setting(0.003, "see noise_floor", within=(0, 0.1))
    mu_sd: float = setting(0.008, "sd of the first guess of mu, around the model's", "1/min", within=(1e-5, 0.1))
    mu_walk: float = setting(5e-4, "random walk of mu", "1/min per sqrt(min)", within=(0, 0.01))
    gain_sd: float = setting(0.2, "sd of the first guess of the pump's flow over the calibrated one", within=(0, 1))
    gain_walk: float = setting(3e-3, "its random walk", "per sqrt(min)", within=(0, 0.1))
    pulse_cv: float = setting(0.1, "spread of a dose", within=(0, 1))
    growth_cv: float = setting(0.05, "spread of the growth within a minute, relative to mu (assumption)", within=(0, 1))
    gate_sigma: float = setting(5.0, "a reading further off than this is an outlier ...", "sigma", within=(2, 20))
    gate_max: int = setting(6, "... unless this many come in a row; bubbles last up to 5", "readings", within=(1, 20))

    def __post_init__(self) -> None:
        check(self, "controller")


class AdaptiveInverse:
    """Certainty-equivalent inverse control.

    State s = [ln x, mu, g] with the relative pump gain g; dt minutes after a dose of u over one control period h

      ln x <- ln x + dt mu - g u h / tau,   mu and g random walks,   y = ln(reading) = ln x + noise

    which is linear for a known u: a time-varying Kalman filter (Kalman 1960), exact without linearising. Known is what
    was dosed, where somebody tells it (`dosed`), else what it decided. Then

      u = tau/g (mu + (ln x - ln r)/h), clipped to the pump's range.

    Args: config: the filter's beliefs; model: mu, tau, control period and largest pump rate of the calibrated model.
    """

    def __init__(self, config: AdaptiveInverseConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Controller.reset`."""
        c = self.config
        self._mean = np.tile([0.0, self.model.mu, 1.0], (n, 1))
        self._cov = np.tile(np.diag([0.0, c.mu_sd**2, c.gain_sd**2]), (n, 1, 1))
        self._started: Mask = np.zeros(n, dtype=bool)
        self._gated = np.zeros(n, dtype=np.int64)
        self._minute, self._rate = np.zeros(n), np.zeros(n)
        self._given_ml: Array | None = None  # since the newest reading; None while nobody tells

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`."""
        now = usable(od, rows)
        if now.any():
            idx = np.flatnonzero(now)
            reading = np.maximum(od[idx], LOWEST_OD)
            variance = np.hypot(self.config.noise_floor, self.config.noise_relative * reading) ** 2 / reading**2
            self._predict(idx, np.maximum(minute[idx] - self._minute[idx], 0.0))
            self._update(idx, np.log(reading), variance)
            self._minute[idx] = minute[idx]
            if self._given_ml is not None:
                self._given_ml[idx] = 0.0
            log_od, mu, gain = self._mean[idx].T
            gain = np.clip(gain, *GAIN_RANGE)
            error = log_od - np.log(np.maximum(setpoint[idx], LOWEST_OD))
            wanted = self.model.tau / gain * (mu + error / self.model.control_min)
            self._rate[idx] = np.clip(wanted, 0.0, self.model.max_pump_rate)
        return self._rate.copy()

    def dosed(self, volume_ml: Array) -> None:
        """See `Accounts.dosed`."""
        self._given_ml = volume_ml + (0.0 if self._given_ml is None else self._given_ml)

    def _predict(self, idx: np.ndarray, dt: Array) -> None:
        """Advance the rows `idx` by dt minutes and what was dosed since their newest reading."""
        c, n = self.config, idx.size
        decided_ml = self._rate * 60.0 * self.model.control_min
        given_ml = decided_ml if self._given_ml is None else self._given_ml
        dose = given_ml[idx] / (60.0 * self.model.tau)  # ln of the dilution by a sound pump
        step = np.tile(np.eye(3), (n, 1, 1))
        step[:, 0, 1], step[:, 0, 2] = dt, -dose
        noise = np.zeros((n, 3, 3))
        noise[:, 0, 0] = (c.pulse_cv * dose) ** 2 + (c.growth_cv * self.model.mu) ** 2 * dt
        noise[:, 1, 1], noise[:, 2, 2] = c.mu_walk**2 * dt, c.gain_walk**2 * dt
        self._mean[idx] = np.einsum("nij,nj->ni", step, self._mean[idx])
        self._cov[idx] = np.einsum("nij,njk,nlk->nil", step, self._cov[idx], step) + noise

    def _update(self, idx: np.ndarray, y: Array, variance: Array) -> None:
        """Take the readings y = ln OD with their variances into the rows `idx`."""
        mean, cov = self._mean[idx], self._cov[idx]
        surprise = y - mean[:, 0]
        total = cov[:, 0, 0] + variance
        far = np.abs(surprise) > self.config.gate_sigma * np.sqrt(total)
        self._gated[idx] = np.where(far & self._started[idx], self._gated[idx] + 1, 0)
        # A first reading, or a jump that stays, sets the OD anew and teaches nothing about mu and gain.
        anew = ~self._started[idx] | (self._gated[idx] >= self.config.gate_max)
        kalman = cov[:, :, 0] / total[:, None]
        better = mean + kalman * surprise[:, None]
        smaller = cov - kalman[:, :, None] * cov[:, None, 0, :]
        better = np.where(far[:, None], mean, better)
        smaller = np.where(far[:, None, None], cov, smaller)
        better[anew, 0], better[anew, 1:] = y[anew], mean[anew, 1:]
        fresh = cov.copy()
        fresh[:, 0, :], fresh[:, :, 0] = 0.0, 0.0
        fresh[:, 0, 0] = variance
        self._mean[idx] = better
        self._cov[idx] = np.where(anew[:, None, None], fresh, smaller)
        self._gated[idx] = np.where(anew, 0, self._gated[idx])
        self._started[idx] = True

    def explain(self) -> dict[str, Array]:
        """The estimates behind the last decision: OD, growth rate (1/min) and relative pump gain."""
        return {"od_estimate": np.exp(self._mean[:, 0]), "mu": self._mean[:, 1].copy(), "gain": self._mean[:, 2].copy()}
