"""What a law of the composition is told and what it answers: N cultures in, N thermostat targets out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from experiments.laws.base import Array, Mask
from hardware.memory import Remembers

__all__ = ["Array", "Estimate", "Law", "Mask", "ShareEstimator", "Wanted"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is believed of N cultures.

    logit: of the share r of the second species. sd: of that logit. temperature: of the vial, degC. rate: lagged growth
    rate m_p of the second species, 1/h. Each of shape (N,). Source: docs/coculture.md, Estimate.
    """

    logit: Array
    sd: Array
    temperature: Array
    rate: Array

    @property
    def share(self) -> Array:
        """r = 1 / (1 + exp(-logit)), (N,)."""
        return 1.0 / (1.0 + np.exp(-self.logit))

    @property
    def state(self) -> Array:
        """Columns as in `envs/coculture/task.py`: logit, temperature, rate, (N, 3)."""
        return np.stack([self.logit, self.temperature, self.rate], axis=-1)


@dataclass(frozen=True, eq=False)
class Wanted:
    """What the program asks for.

    setpoint: share in force, nan where none is (then the schedule's temperature holds). following: the next one that is
    announced, else the present one. minutes: until then, 0 where none is announced. Each of shape (N,).
    """

    setpoint: Array
    following: Array
    minutes: Array


class ShareEstimator(Remembers, Protocol):
    """What is believed of N cultures, by their readings and doses; arrays (N,)."""

    @property
    def begun(self) -> Mask:
        """Which cultures have been seen."""
        ...

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""
        ...

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """A sample: OD, counts, degC, min since the run began; rows: True where it is new and believed."""
        ...

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in since this was last called, mL."""
        ...

    def estimate(self) -> Estimate:
        """What is believed now."""
        ...

    def explain(self) -> dict[str, Array]:
        """The estimate for recording and journal: ratio, ratio_low, ratio_high and more."""
        ...


class Law(Remembers, Protocol):
    """Chooses thermostat targets from an estimate. Rows are independent."""

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""
        ...

    def act(self, estimate: Estimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """Thermostat targets, degC, (N,), called once per control period of the density.

        A law with a longer period of its own keeps its target until that is over. Args: minute: since the program
        began, (N,). rows: True where the estimate is new and a setpoint is in force; only these rows' state advances.
        """
        ...
