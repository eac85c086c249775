"""The honest baselines: a classic threshold turbidostat and a constant rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs.actions import MAX_PUMP_RATE
from envs.task import EnvConfig
from experiments.controllers.base import Array, Mask, usable

__all__ = ["Hold", "HoldConfig", "Threshold", "ThresholdConfig"]


@dataclass(frozen=True)
class ThresholdConfig:
    """rate: mL/s while OD is above the setpoint; hysteresis: OD below the setpoint at which it stops again."""

    kind: str = "threshold"
    rate: float = MAX_PUMP_RATE
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.rate <= 0.05:
            raise ValueError(f"controller.rate = {self.rate} mL/s: allowed 0 < rate <= 0.05")
        if not 0.0 <= self.hysteresis <= 0.2:
            raise ValueError(f"controller.hysteresis = {self.hysteresis} OD: allowed 0 to 0.2")


class Threshold:
    """u = rate from x > setpoint until x <= setpoint - hysteresis, else 0: the turbidostat of the textbooks."""

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
class HoldConfig:
    """rate: constant pump rate, mL/s; None means mu tau of the model, which holds any OD if the model is true."""

    kind: str = "hold"
    rate: float | None = None

    def __post_init__(self) -> None:
        if self.rate is not None and not 0.0 <= self.rate <= 0.05:
            raise ValueError(f"controller.rate = {self.rate} mL/s: allowed 0 to 0.05, or null for mu tau of the model")


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
