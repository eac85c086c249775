"""Example of an estimator: an extended Kalman filter of OD and growth rate, for a pump of known flow."""

from dataclasses import dataclass

import numpy as np

from conf.schema import check, setting
from envs.task import EnvConfig
from experiments.laws.base import Array, Mask, usable
from experiments.laws.density import estimators


@dataclass(frozen=True)
class EkfConfig:
    """Config of the filter: noise of readings and doses, and spread of mu."""

    kind: str = setting("ekf", "estimator of the density")
    noise: float = setting(0.006, "sd of a reading", "OD", within=(1e-4, 0.1))
    mu_sd: float = setting(0.01, "sd of the initial mu around the model's mu", "1/min", within=(1e-5, 0.1))
    mu_walk: float = setting(3e-4, "random walk of mu", "1/min per sqrt(min)", within=(0, 0.01))
    dose_cv: float = setting(0.15, "relative sd of a dose", within=(0, 1))
    memory: float = setting(12.0, "readings over which squared innovations are averaged", "readings", at_least=2.0)

    def __post_init__(self) -> None:
        check(self, "controller.estimator")


FIXED = {"loud_mean_square": 3.5, "quiet_mean_square": 0.05}


class Ekf:
    """Filter of [x, mu]: x <- x exp(mu dt - V/(60 tau)) with dose V, mu a random walk, reading = x + noise."""

    remembers = ("mean", "cov", "minute", "given_ml", "heard", "square")

    def __init__(self, config: EkfConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.reset(1)

    def reset(self, n: int) -> None:
        self.mean, self.cov = np.tile([0.5, self.model.mu], (n, 1)), np.zeros((n, 2, 2))
        self.cov[:, 1, 1] = self.config.mu_sd**2
        self._minute, self._given_ml, self._square = np.full(n, np.nan), np.zeros(n), np.ones(n)
        self._heard = False

    def dosed(self, volume_ml: Array) -> None:
        self._given_ml, self._heard = volume_ml + (self._given_ml if self._heard else 0.0), True

    def decided(self, rate: Array) -> None:
        if not self._heard:
            self._given_ml = 60.0 * self.model.control_min * rate

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self.see(od, minute, rows)

    def see(self, od: Array, minute: Array, rows: Mask) -> None:
        c = self.config
        new = usable(od, rows) & ~(minute <= self._minute)
        first = new & np.isnan(self._minute)
        dt = np.where(new & ~first, minute - np.nan_to_num(self._minute), 0.0)
        dose = self._given_ml / (60.0 * self.model.tau)
        x, mu = self.mean.T
        step = np.exp(mu * dt - dose)
        slope = np.tile(np.eye(2), (x.size, 1, 1))
        slope[:, 0, 0], slope[:, 0, 1] = step, dt * x * step
        cov = np.einsum("nij,njk,nlk->nil", slope, self.cov, slope)
        cov[:, 0, 0] += (c.dose_cv * dose * x) ** 2
        cov[:, 1, 1] += c.mu_walk**2 * dt
        innovation, total = np.nan_to_num(od) - x * step, cov[:, 0, 0] + c.noise**2
        kalman = cov[:, :, 0] / total[:, None]
        mean = np.stack([x * step, mu], axis=1) + kalman * innovation[:, None]
        cov = cov - kalman[:, :, None] * cov[:, None, 0, :]
        mean[first, 0], mean[first, 1] = np.nan_to_num(od)[first], mu[first]
        cov[first] = np.diag([c.noise**2, c.mu_sd**2])
        mean[:, 0] = np.maximum(mean[:, 0], 1e-3)
        self.mean, self.cov = np.where(new[:, None], mean, self.mean), np.where(new[:, None, None], cov, self.cov)
        square = self._square + (np.minimum(innovation**2 / total, 9.0) - self._square) / c.memory
        self._square = np.where(new & ~first, square, self._square)
        self._minute = np.where(new, minute, self._minute)
        self._given_ml = np.where(new & self._heard, 0.0, self._given_ml)

    @property
    def full_pump(self) -> Array:
        m = self.model
        return np.full(len(self.mean), m.max_pump_rate * m.control_min / m.tau)

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        error = np.log(self.mean[:, 0] / np.maximum(setpoint, 1e-3)) / self.full_pump
        return error, self.mean[:, 1] * self.model.control_min / self.full_pump

    def doubt(self, setpoint: Array) -> tuple[Array, Array]:
        error = np.sqrt(self.cov[:, 0, 0]) / self.mean[:, 0] / self.full_pump
        return error, np.sqrt(self.cov[:, 1, 1]) * self.model.control_min / self.full_pump

    sd = doubt

    @property
    def loudness(self) -> Array:
        return 10.0 * self._square

    @property
    def loud(self) -> Mask:
        return np.asarray(self._square > FIXED["loud_mean_square"])

    @property
    def quiet(self) -> Mask:
        return np.asarray(self._square < FIXED["quiet_mean_square"])

    def explain(self) -> dict[str, Array]:
        return {"od_estimate": self.mean[:, 0].copy(), "mu": self.mean[:, 1].copy()}


estimators.add("ekf", EkfConfig, Ekf, lambda: FIXED)
