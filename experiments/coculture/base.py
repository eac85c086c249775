"""Inputs of composition controllers: estimate and setpoint of the share, for N cultures."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from experiments.laws.base import Array as Array
from experiments.laws.base import Mask as Mask

SHARE = "share"
"""Name of the signal under which its controllers are registered."""
SEEN = ("logit_share", "temperature", "rate", "logit_setpoint")
SEEN_AHEAD = (*SEEN, "logit_next", "minutes_to_change")
"""Observations of learned controllers (envs/coculture/task.py): without and with announced changes."""


@dataclass(frozen=True, eq=False)
class ShareEstimate:
    """Estimate of N cultures (docs/coculture.md, Estimate); arrays (N,).

    logit: logit of the share r of the second species. sd: standard deviation of this logit. temperature: true vial
    temperature, degC. rate: lagged growth rate m_p of the second species, 1/h. error_e, error_p: relative errors of
    both species' growth curves. thermometer: true minus measured temperature, degC.
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
        """Relative errors of both growth curves, (N, 2)."""
        return np.stack([self.error_e, self.error_p], axis=-1)

    @property
    def share(self) -> Array:
        """Share r = 1 / (1 + exp(-logit)), (N,)."""
        return 1.0 / (1.0 + np.exp(-self.logit))

    @property
    def state(self) -> Array:
        """State of the task in `envs/coculture/task.py`: logit, temperature, rate, (N, 3)."""
        return np.stack([self.logit, self.temperature, self.rate], axis=-1)


@dataclass(frozen=True, eq=False)
class Wanted:
    """Setpoints of the share in N programs; arrays (N,).

    setpoint: current share, nan without one (then the schedule's temperature is used). following: the next setpoint if
    it is announced, else the current one. minutes: time until the next setpoint, 0 if it is not announced.
    """

    setpoint: Array
    following: Array
    minutes: Array
