"""Inverse control with the estimator: it gives the pump rate that brings the next reading to the setpoint."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from conf.schema import part, require, setting
from envs.relative import nearest_level
from envs.task import EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable
from experiments.laws.density import estimators
from experiments.laws.density.estimator import EstimatorConfig


@dataclass(frozen=True)
class InverseConfig(ControllerConfig):
    """Settings of the one-line controller and its estimator."""

    kind: str = setting("inverse", "controller")
    levels: int = setting(
        0, "number of equally spaced pump rates; the nearest is used; 0: any rate is used", within=(0, 1001)
    )
    estimator: Any = part(EstimatorConfig, "settings of the estimator", estimators.config_at)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.levels != 1, "controller.levels", self.levels, "0, or 2 to 1001")


class Inverse:
    """Inverse control u = u_max clip(e + s, 0, 1) with the estimated error e and growth share s, as if both were exact.

    That is u = tau/g (mu + ln(x/r)/h), clipped to the pump's range and rounded to the nearest level if `levels` > 0.

    Args: config: levels, settings of the estimator. model: control period, largest pump rate, initial mu and tau.
    """

    remembers = ("estimator", "rate")

    def __init__(self, config: InverseConfig, model: EnvConfig) -> None:
        self.model, self._levels = model, config.levels
        self.estimator = estimators.build(config.estimator, model)
        self.reset(1)

    def reset(self, n: int) -> None:
        self.estimator.reset(n)
        self._rate = np.zeros(n)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self.estimator.watch(od, temperature, minute, rows)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        self.estimator.see(od, minute, rows)
        error, share = self.estimator.relative(setpoint)
        wanted = np.clip(error + share, 0.0, 1.0)
        if self._levels:
            wanted = nearest_level(error, share, self._levels) / (self._levels - 1)
        wanted = self.model.max_pump_rate * wanted
        self._rate = np.where(usable(od, rows), wanted, self._rate)
        self.estimator.decided(self._rate)
        return self._rate.copy()

    def dosed(self, volume_ml: Array) -> None:
        self.estimator.dosed(volume_ml)

    def explain(self) -> dict[str, Array]:
        return self.estimator.explain()
