"""What a composition controller gets and returns: N cultures in, N thermostat targets out."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from experiments.laws.base import Array as Array
from experiments.laws.base import Mask as Mask

SHARE = "share"
"""The signal, by which its laws are known."""
SEEN = ("logit_share", "temperature", "rate", "logit_setpoint")
SEEN_AHEAD = (*SEEN, "logit_next", "minutes_to_change")
"""Observation of a learned controller (envs/coculture/task.py), and with announced changes; it returns degC."""


@dataclass(frozen=True, eq=False)
class ShareEstimate:
    """Estimate of N cultures.

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
