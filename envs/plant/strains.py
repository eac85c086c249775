"""What tells the strains in a vial apart: growth rate, how it follows temperature, and how much each begins with."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Curve = Callable[[Array], Array]

REFERENCE_TEMPERATURE = 37.0  # degC, at which every rate is given
GAS_CONSTANT = 8.314462618e-3  # kJ/(mol K)


def arrhenius(activation_kj_mol: float) -> Curve:
    """phi(T) = exp(-Ea / (R (T + 273.15))), valid 21 to 37 degC for E. coli (Ingraham & Marr, BioNumbers 105003).

    Args: activation_kj_mol: Ea; 54 to 59 in the literature, mu(30)/mu(37) = 0.59 to 0.62.
    """
    return lambda temperature: np.exp(-activation_kj_mol / (GAS_CONSTANT * (temperature + 273.15)))


def cardinal(t_min: float = 6.0, t_opt: float = 41.0, t_max: float = 47.2) -> Curve:
    """Cardinal temperature model with inflexion (Rosso 1993): 1 at t_opt, 0 outside [t_min, t_max], degC.

    phi(T) = (T - t_max)(T - t_min)^2
             / {(t_opt - t_min)[(t_opt - t_min)(T - t_opt) - (t_opt - t_max)(t_opt + t_min - 2 T)]}
    """

    def phi(temperature: Array) -> Array:
        inside = (temperature > t_min) & (temperature < t_max)
        t, span = np.where(inside, temperature, t_opt), t_opt - t_min
        low = span * (t - t_opt) - (t_opt - t_max) * (t_opt + t_min - 2.0 * t)
        return np.where(inside, (t - t_max) * (t - t_min) ** 2 / (span * low), 0.0)

    return phi


LAWS: dict[str, Callable[[Any, float, int], Curve]] = {
    "none": lambda plant, activation, number: np.ones_like,
    "arrhenius": lambda plant, activation, number: arrhenius(activation),
    "cardinal": lambda plant, activation, number: cardinal(),
}
TEMPERATURE_LAWS = list(LAWS)
"""Their names."""


def add_law(name: str, make: Callable[[Any, float, int], Curve]) -> None:
    """Make a law known. Args: make: from plant's config, activation energy in kJ/mol and strain's number."""
    LAWS[name] = make
    TEMPERATURE_LAWS.append(name)


def response(law: str, plant: Any, activation_kj_mol: float, number: int) -> Curve:
    """phi(T) / phi(37 degC) of a temperature law, one of `TEMPERATURE_LAWS`; the others as of `add_law`."""
    phi = LAWS[law](plant, activation_kj_mol, number)
    reference = phi(np.asarray(REFERENCE_TEMPERATURE))
    return lambda temperature: phi(temperature) / reference


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
