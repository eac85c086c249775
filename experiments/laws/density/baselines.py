"""The simple baselines: a classic threshold turbidostat and a constant rate."""

from dataclasses import dataclass

import numpy as np

from conf.schema import setting
from envs.task import MAX_PUMP_RATE, EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable

__all__ = ["Hold", "HoldConfig", "Threshold", "ThresholdConfig"]


@dataclass(frozen=True)
class ThresholdConfig(ControllerConfig):
    """A rate above the setpoint, none below."""

    kind: str = setting("threshold", "which controller")
    rate: float = setting(MAX_PUMP_RATE, "while OD is above the setpoint", "mL/s", above=0.0, at_most=0.05)
    hysteresis: float = setting(0.0, "OD below the setpoint at which it stops again", "OD", within=(0, 0.2))


class Threshold:
    """u = rate from x > setpoint until x <= setpoint - hysteresis, else 0: the turbidostat of the textbooks."""

    remembers = ("on",)

    def __init__(self, config: ThresholdConfig) -> None:
        self.config = config
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Controller.reset`."""
        self._on: Mask = np.zeros(n, dtype=bool)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`."""
        now = usable(od, rows)
        stay = self._on & (od > setpoint - self.config.hysteresis)
        self._on = np.where(now, (od > setpoint) | stay, self._on)
        return np.where(self._on, self.config.rate, 0.0)


@dataclass(frozen=True)
class HoldConfig(ControllerConfig):
    """A constant rate. mu tau of the model holds any OD if the model is true."""

    kind: str = setting("hold", "which controller")
    rate: float | None = setting(
        None, "pump rate; null: mu tau of the model, 0.01 for the nominal one", "mL/s", within=(0, 0.05)
    )


class Hold:
    """u = constant, whatever is measured: a chemostat. `model` is the calibrated growth model."""

    def __init__(self, config: HoldConfig, model: EnvConfig) -> None:
        self.rate = model.mu * model.tau if config.rate is None else config.rate
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Controller.reset`."""
        self._n = n

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`."""
        return np.full(self._n, self.rate)
