"""What a composition controller gets and returns: N cultures in, N thermostat targets out."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from experiments.laws.base import Array, Mask
from hardware.memory import Remembers

__all__ = ["SEEN", "SEEN_AHEAD", "SHARE", "Acts", "Array", "Law", "Mask", "ShareEstimate", "ShareEstimator", "Wanted"]

SHARE = "share"
"""The signal, by which its laws are known."""
SEEN = ("logit_share", "temperature", "rate", "logit_setpoint")
SEEN_AHEAD = (*SEEN, "logit_next", "minutes_to_change")
"""Observation of a learned controller (envs/coculture/task.py), and with announced changes; it returns degC."""


@dataclass(frozen=True, eq=False)
class ShareEstimate:
    """What is believed of N cultures.

    logit: of the share r of the second species. sd: of that logit. temperature: of the vial, degC. rate: lagged growth
    rate m_p of the second species, 1/h. error_e, error_p: relative, of the growth curves. thermometer: true less
    measured temperature, degC. Each of shape (N,). Source: docs/coculture.md, Estimate.
    """

    logit: Array
    sd: Array
    temperature: Array
    rate: Array
    error_e: Array
    error_p: Array
    thermometer: Array

    def of(self, idx: NDArray[np.intp]) -> "ShareEstimate":
        """Return the estimate of some of the cultures."""
        return ShareEstimate(*(getattr(self, f.name)[idx] for f in fields(self)))

    @property
    def errors(self) -> Array:
        """Of both growth curves, (N, 2)."""
        return np.stack([self.error_e, self.error_p], axis=-1)

    @property
    def share(self) -> Array:
        """Compute r = 1 / (1 + exp(-logit)), (N,)."""
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

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Watch a sample: OD, counts, degC, min since the run began; rows: True where it is new and used."""

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in since this was last called, mL."""

    def sample(self, share: Array, sd: Array, minute: float, rows: Mask) -> bool:
        """Shares counted in samples drawn at a minute since the run began; False where that is too long ago."""

    @property
    def behind(self) -> bool:
        """Whether samples are still on their way into the estimate."""

    @property
    def known(self) -> Array:
        """Up to which minute `retell` needs nothing of each culture; -inf where it needs all."""

    def retell(self, shown: Iterable[tuple[float, str, tuple[Any, ...]]]) -> None:
        """Minute, method and arguments of what was called in earlier lives of a run, in order, behind `known`."""

    def estimate(self) -> ShareEstimate:
        """Return the current estimate."""

    def explain(self) -> dict[str, Array]:
        """Explain the estimate for recording and journal: ratio, ratio_low, ratio_high and more."""


class Acts(Protocol):
    """Chooses thermostat targets from an estimate. Rows are independent."""

    def act(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """Thermostat targets, degC, (N,), called once per control period of the density.

        A law with a longer period of its own keeps its target until that is over. Args: minute: since the program
        began, (N,). rows: True where the estimate is new and a setpoint is in force; only these rows' state advances.
        """


class Law(Acts, Remembers, Protocol):
    """What a run goes on with when it is resumed."""

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""
