"""Inverse control on the estimator: the pump rate that puts the next reading on the setpoint."""

from dataclasses import dataclass

import numpy as np

from conf.schema import part, setting
from envs.task import EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable
from experiments.laws.density.estimator import Estimator, EstimatorConfig

__all__ = ["Inverse", "InverseConfig"]


@dataclass(frozen=True)
class InverseConfig(ControllerConfig):
    """The one-line law and what it believes."""

    kind: str = setting("inverse", "which controller")
    estimator: EstimatorConfig = part(EstimatorConfig, "what the filter believes")


class Inverse:
    """Certainty-equivalent inverse control: u = u_max clip(e + s, 0, 1) with the estimates of error and growth share.

    That is u = tau/g (mu + ln(x/r)/h), clipped to the pump's range.

    Args: config: the filter's beliefs; model: mu, tau, control period and largest pump rate, the first guess.
    """

    remembers = ("estimator", "rate")

    def __init__(self, config: InverseConfig, model: EnvConfig) -> None:
        self.model = model
        self.estimator = Estimator(config.estimator, model)
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Controller.reset`."""
        self.estimator.reset(n)
        self._rate = np.zeros(n)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """See `Watches.watch`."""
        self.estimator.watch(od, temperature, minute, rows)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`."""
        self.estimator.see(od, minute, rows)
        error, share = self.estimator.relative(setpoint)
        wanted = self.model.max_pump_rate * np.clip(error + share, 0.0, 1.0)
        self._rate = np.where(usable(od, rows), wanted, self._rate)
        self.estimator.decided(self._rate)
        return self._rate.copy()

    def dosed(self, volume_ml: Array) -> None:
        """See `Accounts.dosed`."""
        self.estimator.dosed(volume_ml)

    def explain(self) -> dict[str, Array]:
        """See `Estimator.explain`."""
        return self.estimator.explain()
