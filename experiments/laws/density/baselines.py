"""Simple controllers: threshold turbidostat, gain-scheduled proportional control, and constant rate."""

from dataclasses import dataclass

import numpy as np

from conf.schema import require, setting
from envs.task import MAX_PUMP_RATE, EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable

LOWEST_OD = 1e-3  # a lower reading or setpoint counts as this value, so that its logarithm exists


@dataclass(frozen=True)
class ThresholdConfig(ControllerConfig):
    """Settings of the threshold controller, which pumps above the setpoint only."""

    kind: str = setting("threshold", "controller")
    rate: float = setting(MAX_PUMP_RATE, "rate while OD is above the setpoint", "mL/s", above=0.0, at_most=0.05)
    hysteresis: float = setting(0.0, "distance below the setpoint at which the pump stops", "OD", within=(0, 0.2))


class Threshold:
    """Classic turbidostat: u = rate from x > setpoint until x <= setpoint - hysteresis, else 0."""

    remembers = ("on",)

    def __init__(self, config: ThresholdConfig) -> None:
        self.config = config
        self.reset(1)

    def reset(self, n: int) -> None:
        self._on: Mask = np.zeros(n, dtype=bool)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        now = usable(od, rows)
        stay = self._on & (od > setpoint - self.config.hysteresis)
        self._on = np.where(now, (od > setpoint) | stay, self._on)
        return np.where(self._on, self.config.rate, 0.0)


@dataclass(frozen=True)
class GainScheduledConfig(ControllerConfig):
    """Table of growth rate and proportional gain over temperature; the default mu changes as in the paper."""

    kind: str = setting("gain_scheduled", "controller")
    temperatures: tuple[float, ...] = setting((30.0, 37.0), "rising temperatures", "degC", within=(0, 60), some=True)
    mu: tuple[float, ...] = setting((0.027, 0.03), "growth rate at each temperature", "1/min", within=(0, 0.1))
    gain: tuple[float, ...] = setting(
        (0.5, 0.5), "fraction of ln(x/r) removed per control period, at each temperature", within=(0, 2)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        degc, rising = self.temperatures, sorted(set(self.temperatures))
        require(list(degc) == rising, "controller.temperatures", degc, "strictly rising values")
        for name in ("mu", "gain"):
            column = getattr(self, name)
            require(len(column) == len(degc), f"controller.{name}", column, f"{len(degc)} values, one per temperature")


class GainScheduled:
    """Proportional control with feed-forward; gain and growth rate come from a table over vial temperature.

      u = clip(tau (mu(T) + K(T) ln(x/r) / h), 0, u_max)

    mu(T) (1/min) and K(T) (dimensionless) are interpolated linearly in the table and constant beyond its ends; h is
    the control period (min), u is in mL/s, shape (N,). If mu(T) is true, each period multiplies ln(x/r) by 1 - K. In
    ln x the plant is an integrator at every temperature, so the default K is constant. T is the last known
    temperature, initially the highest of the table. Gain scheduling: Rugh and Shamma 2000, Automatica 36:1401; the
    paper's introduction mentions such controllers.

    Args: config: the table. model: tau, control period and largest pump rate.
    """

    remembers = ("degc", "rate")

    def __init__(self, config: GainScheduledConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.reset(1)

    def reset(self, n: int) -> None:
        self._degc, self._rate = np.full(n, self.config.temperatures[-1]), np.zeros(n)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self._degc = np.where(rows & np.isfinite(temperature), temperature, self._degc)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        now, table = usable(od, rows), self.config
        mu, gain = (np.interp(self._degc, table.temperatures, column) for column in (table.mu, table.gain))
        z = np.log(np.maximum(np.where(now, od, 1.0), LOWEST_OD) / np.maximum(setpoint, LOWEST_OD))
        wanted = self.model.tau * (mu + gain * z / self.model.control_min)
        self._rate = np.where(now, np.clip(wanted, 0.0, self.model.max_pump_rate), self._rate)
        return self._rate.copy()


@dataclass(frozen=True)
class HoldConfig(ControllerConfig):
    """Settings of a constant pump rate. With a correct model, the rate mu tau keeps any OD constant."""

    kind: str = setting("hold", "controller")
    rate: float | None = setting(
        None, "pump rate; null: mu tau of the model (0.01 for the nominal model)", "mL/s", within=(0, 0.05)
    )


class Hold:
    """Chemostat: constant pump rate u. Args: model: growth model that gives the default rate."""

    def __init__(self, config: HoldConfig, model: EnvConfig) -> None:
        self.rate = model.mu * model.tau if config.rate is None else config.rate
        self.reset(1)

    def reset(self, n: int) -> None:
        self._n = n

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        return np.full(self._n, self.rate)
