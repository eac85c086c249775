"""What tells the strains in a vial apart: growth rate, how it follows temperature, and how much each begins with."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.growth import Arrhenius, Cardinal, relative_to_37

__all__ = ["TEMPERATURE_LAWS", "Curve", "Strain", "add_law", "response"]

Array = NDArray[np.float64]
Curve = Callable[[Array], Array]

LAWS: dict[str, Callable[[Any, float, int], Curve]] = {
    "none": lambda plant, activation, number: np.ones_like,
    "arrhenius": lambda plant, activation, number: Arrhenius(activation),
    "cardinal": lambda plant, activation, number: Cardinal(),
}
TEMPERATURE_LAWS = list(LAWS)
"""Their names."""


def add_law(name: str, make: Callable[[Any, float, int], Curve]) -> None:
    """Make a law known. Args: make: from plant's config, activation energy in kJ/mol and strain's number."""
    LAWS[name] = make
    TEMPERATURE_LAWS.append(name)


def response(law: str, plant: Any, activation_kj_mol: float, number: int) -> Curve:
    """phi(T) / phi(37 degC) of a temperature law, one of `TEMPERATURE_LAWS`; the others as of `add_law`."""
    return relative_to_37(LAWS[law](plant, activation_kj_mol, number))


@dataclass(frozen=True, eq=False)
class Strain:
    """One strain of N vials.

    mu: specific growth rate in fresh medium at 37 degC, 1/min, (N,). phi: how that follows temperature. lag_min: with
    which time constant. share: of the OD at reset, (N,); that of the first strain is what the others leave.
    """

    mu: Array
    phi: Curve
    lag_min: float
    share: Array
