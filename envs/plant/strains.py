"""Properties of the strains in a vial: growth rate, its temperature dependence, and the share at the start."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Curve = Callable[[Array], Array]

REFERENCE_TEMPERATURE = 37.0  # degC; every growth rate is given at this temperature
GAS_CONSTANT = 8.314462618e-3  # kJ/(mol K)


def arrhenius(activation_kj_mol: float) -> Curve:
    """Return phi(T) = exp(-Ea / (R (T + 273.15))), for E. coli from 21 to 37 degC (Ingraham & Marr, BioNumbers 105003).

    Args: activation_kj_mol: Ea; 54 to 59 in the literature, which gives mu(30)/mu(37) = 0.59 to 0.62.
    """
    return lambda temperature: np.exp(-activation_kj_mol / (GAS_CONSTANT * (temperature + 273.15)))


def cardinal(t_min: float = 6.0, t_opt: float = 41.0, t_max: float = 47.2) -> Curve:
    """Return the cardinal temperature model with inflexion (Rosso 1993): 1 at t_opt, 0 outside t_min..t_max, degC.

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
"""Names of the temperature laws."""


def add_law(name: str, make: Callable[[Any, float, int], Curve]) -> None:
    """Register a temperature law. Args: make: (plant's config, activation energy in kJ/mol, strain's index) -> phi."""
    LAWS[name] = make
    TEMPERATURE_LAWS.append(name)


def response(law: str, plant: Any, activation_kj_mol: float, number: int) -> Curve:
    """Return phi(T) / phi(37 degC) of a law of `TEMPERATURE_LAWS`; the other arguments go to its `make` function."""
    phi = LAWS[law](plant, activation_kj_mol, number)
    reference = phi(np.asarray(REFERENCE_TEMPERATURE))
    return lambda temperature: phi(temperature) / reference


@dataclass(frozen=True, eq=False)
class Strain:
    """One strain in N vials.

    mu: specific growth rate in fresh medium at 37 degC, 1/min, (N,). phi: temperature -> mu relative to 37 degC.
    lag_min: time constant of phi, min. share: share of the OD at reset, (N,); the first strain gets the rest instead.
    """

    mu: Array
    phi: Curve
    lag_min: float
    share: Array
