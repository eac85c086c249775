"""Example of a signal: the thermostat holds the light of a culture of two species, which is brighter when colder."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.scenario import Scenario
from experiments.laws import registry
from experiments.laws.base import Array, Mask
from experiments.loop import signals
from experiments.loop.signals import Findings, Sample
from hardware.actuator import THERMOSTAT
from hardware.memory import Remembers


@dataclass(frozen=True)
class IntegralConfig:
    """Config of the signal `light` and of its controller."""

    kind: str = setting("integral", "controller of the light")
    setpoint: float = setting(1500.0, "light to hold", "counts", within=(0, 20_000))
    gain: float = setting(0.003, "fall of the temperature per missing count", "degC", within=(0, 1))
    integral: float = setting(1e-5, "further fall per missing count at each sample", "degC", within=(0, 1))
    memory: float = setting(5.0, "readings over which the light is averaged", "readings", at_least=1.0)
    far: float = setting(100.0, "deviation from the setpoint above which the run warns", "counts", above=0.0)

    def __post_init__(self) -> None:
        check(self, "signals.light")


class Integral:
    """Controller T = 33 - gain e - I, degC, with e = setpoint - light and I <- I + integral e."""

    remembers = ("integral",)

    def __init__(self, config: IntegralConfig) -> None:
        self.config = config
        self.reset(1)

    def reset(self, n: int) -> None:
        self._integral = np.zeros(n)

    def act(self, light: Array, rows: Mask) -> Array:
        error = self.config.setpoint - light
        self._integral = np.where(rows, self._integral + self.config.integral * error, self._integral)
        return 33.0 - self.config.gain * error - self._integral


class Light:
    """Signal: light averaged over some readings. `Signal` describes the members."""

    name, actuator, columns = "light", THERMOSTAT.name, ("light", "light_setpoint")
    remembers, sees_light = ("law", "mean"), True

    def __init__(self, config: IntegralConfig, schedules: Sequence[Scenario]) -> None:
        self.config, self.law = config, registry.build(config, "light")
        self._mean = np.full(len(schedules), np.nan)
        self.law.reset(len(schedules))

    def decide(self, sample: Sample) -> Array:
        rows = sample.believed & np.isfinite(sample.light)
        first = np.where(np.isnan(self._mean), sample.light, self._mean)
        self._mean = np.where(rows, first + (sample.light - first) / self.config.memory, self._mean)
        asked = np.isfinite(sample.elapsed)
        return np.where(asked, self.law.act(self._mean, rows & asked), np.nan)

    def find(self, sample: Sample, given: Array) -> Findings:
        setpoint = np.where(np.isfinite(sample.elapsed), self.config.setpoint, np.nan)
        far = sample.believed & (np.abs(self._mean - setpoint) > self.config.far)
        said = [f"light_far: {self._mean[n]:.0f} counts; reported; wait" if far[n] else None for n in range(far.size)]
        return Findings({"light": self._mean, "light_setpoint": setpoint}, {"thermostat_degc": given}, said)

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        pass

    @property
    def memory(self) -> Remembers:
        return self


signals.add("light", Light)
registry.add("integral", IntegralConfig, Integral, "Proportional-integral controller of the light.", signal="light")
