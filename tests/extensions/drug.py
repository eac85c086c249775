"""Example of a third fluid: a spare pump's drug holds the growth rate, even if the culture gets used to the drug."""

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
from hardware.memory import Remembers


@dataclass(frozen=True)
class StressConfig:
    """Config of the signal `drug` and of its controller."""

    kind: str = setting("stress", "controller of the drug")
    pump: str = setting("pump 3", "pump of the drug", choices=("pump 3", "pump 4"))
    growth: float = setting(0.015, "growth rate to hold", "1/min", above=0.0, at_most=0.1)
    gain: float = setting(0.02, "increase of the rate per excess growth and sample", "mL/s min", at_least=0.0)
    most: float = setting(0.004, "largest rate of the drug", "mL/s", within=(0, 0.02))
    memory: float = setting(8.0, "samples over which growth is averaged", "samples", at_least=1.0)
    volume_ml: float = setting(20.0, "volume of a culture", "mL", above=0.0)

    def __post_init__(self) -> None:
        check(self, "signals.drug")


class Stress:
    """Controller u <- u + gain (growth - setpoint), with u from 0 to `most`, mL/s."""

    remembers = ("rate",)

    def __init__(self, config: StressConfig) -> None:
        self.config = config
        self.reset(1)

    def reset(self, n: int) -> None:
        self._rate = np.zeros(n)

    def act(self, growth: Array, rows: Mask) -> Array:
        more = self._rate + self.config.gain * (growth - self.config.growth)
        self._rate = np.where(rows, np.clip(more, 0.0, self.config.most), self._rate)
        return self._rate


class Drug:
    """Signal: averaged growth rate, and fraction of the drug's medium in the vial. `Signal` describes the members."""

    name, sees_light, columns = "drug", False, ("drug", "growth", "growth_setpoint")
    remembers = ("law", "growth", "share", "log_od", "minute", "given_ml")

    def __init__(self, config: StressConfig, schedules: Sequence[Scenario]) -> None:
        n = len(schedules)
        self.config, self.actuator, self.law = config, config.pump, registry.build(config, "drug")
        self._growth, self._log_od, self._minute = (np.full(n, np.nan) for _ in range(3))
        self._share, self._given_ml = np.zeros(n), np.zeros(n)  # volume of all pumps since the last sample
        self.law.reset(n)

    def decide(self, sample: Sample) -> Array:
        rows, log_od = sample.believed, np.log(np.maximum(sample.measured.od, 1e-3))
        passed = np.where(sample.minute > self._minute, sample.minute - self._minute, np.nan)
        seen = (log_od - self._log_od + self._given_ml / self.config.volume_ml) / passed
        before = np.where(np.isnan(self._growth), seen, self._growth)
        self._growth = np.where(rows & np.isfinite(seen), before + (seen - before) / self.config.memory, self._growth)
        self._log_od, self._minute = np.where(rows, log_od, self._log_od), np.where(rows, sample.minute, self._minute)
        self._given_ml = np.where(rows, 0.0, self._given_ml)
        known = rows & np.isfinite(sample.elapsed) & np.isfinite(self._growth)
        return np.asarray(self.law.act(np.nan_to_num(self._growth), known))

    def find(self, sample: Sample, given: Array) -> Findings:
        wanted = np.where(np.isfinite(sample.elapsed), self.config.growth, np.nan)
        return Findings({"drug": self._share, "growth": self._growth, "growth_setpoint": wanted}, {"drug_ml_s": given})

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        own = np.array([f"pump {number}" == self.actuator for number in pump]) * volume_ml
        self._share = self._share * np.exp(-volume_ml / self.config.volume_ml) + own / self.config.volume_ml
        self._given_ml = self._given_ml + volume_ml

    @property
    def memory(self) -> Remembers:
        return self


signals.add("drug", Drug)
registry.add("stress", StressConfig, Stress, "More drug while the culture grows too fast.", signal="drug")
