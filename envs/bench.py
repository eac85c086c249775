"""Bench values, which all parts of the program share: culture volume, control period, largest pump rate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting

VIAL_ML = 30.0
"""Volume of a Chi.Bio vial up to its rim, mL (docs/biology.md, Volume)."""

WITHIN_ML = (5.0, 38.0)


@dataclass(frozen=True)
class Bench:
    """Bench values for interlock, driver, estimators, controllers, certificate, timetable and simulated vials.

    A pump rate in mL/s is the mean over a control period. The driver chooses the actual flow of the pump.

    Raises: ValueError with key, value and allowed range.
    """

    volume_ml: float = setting(20.0, "culture volume up to the waste tube", "mL", within=WITHIN_ML)
    volumes_ml: dict[str, float] = setting(
        {}, "volume of reactors that differ from volume_ml, e.g. bench.volumes_ml.M1=14", "mL"
    )
    period_s: float = setting(60.0, "control period: from one sample and its dose to the next", "s", within=(1, 3600))
    max_rate: float = setting(
        0.02, "largest pump rate; the Chi.Bio's regulator has this limit", "mL/s", above=0.0, at_most=0.05
    )
    bottle_ml: float = setting(2000.0, "fresh medium per reactor at the start", "mL", above=0.0, below=math.inf)

    def __post_init__(self) -> None:
        check(self, "bench")
        for name, ml in self.volumes_ml.items():
            low, high = WITHIN_ML
            require(low <= ml <= high, f"bench.volumes_ml.{name}", f"{ml} mL", f"{low:g} to {high:g}")

    @property
    def control_min(self) -> float:
        """Control period, min."""
        return self.period_s / 60.0

    @property
    def stale_s(self) -> float:
        """Age at which the newest sample is too old for a dose, s: the larger of period + 40 s and 1.1 periods."""
        return max(self.period_s + 40.0, 1.1 * self.period_s)

    @property
    def tau(self) -> float:
        """V/60 for the volume V in mL; then u/tau is the dilution rate in 1/min at the pump rate u in mL/s."""
        return self.volume_ml / 60.0

    def volume_of(self, reactor: str) -> float:
        """Return the culture volume of one reactor, mL."""
        return self.volumes_ml.get(reactor, self.volume_ml)

    def volumes(self, reactors: Sequence[str]) -> NDArray[np.float64]:
        """Return the culture volume of each reactor, mL, (N,)."""
        return np.array([self.volume_of(name) for name in reactors])
