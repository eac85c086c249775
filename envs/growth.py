"""Growth and dilution of bacteria: growth laws, temperature responses and the mass balances of one vial.

Everything takes a leading axis of N vials; one vial is N = 1. Units: min, 1/min, mL/s (pump rate), degC; OD has none.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "REFERENCE_TEMPERATURE", "Arrhenius", "Cardinal", "DilutedCulture", "Exponential", "GrowthLaw", "Monod",
    "relative_to_37",
]  # fmt: skip

Array = NDArray[np.float64]

REFERENCE_TEMPERATURE = 37.0  # reference temperature of every rate below, degC
GAS_CONSTANT = 8.314462618e-3  # kJ/(mol K)


class GrowthLaw(Protocol):
    """Specific growth rate of suspended cells; the interface shared by training model and plant."""

    def specific_rate(self, substrate: Array) -> Array:
        """Compute mu in 1/min, shape (N,).

        Args: substrate: limiting substrate relative to fresh medium (1 = fresh, 0 = exhausted), shape (N,), >= 0.
        Raises: nothing; parameters are checked where they are set.
        """


@dataclass(frozen=True, eq=False)
class Exponential:
    """mu is constant: the paper's growth law, x' = (mu - u/tau) x (equation 5).

    Args: mu: 1/min, scalar or shape (N,), >= 0.
    """

    mu: float | Array

    def specific_rate(self, substrate: Array) -> Array:
        """Return mu for any substrate; see `GrowthLaw.specific_rate`."""
        return np.broadcast_to(np.asarray(self.mu, dtype=np.float64), substrate.shape)


@dataclass(frozen=True, eq=False)
class Monod:
    """mu = mu_max * s / (k_s + s) (Monod 1949, Annu. Rev. Microbiol. 3:371).

    Args:
      mu_max: rate at saturation, 1/min, scalar or shape (N,), >= 0.
      k_s: relative substrate at half rate, scalar or shape (N,), > 0.
    """

    mu_max: float | Array
    k_s: float | Array

    def specific_rate(self, substrate: Array) -> Array:
        """Monod's rate; see `GrowthLaw.specific_rate`."""
        return np.asarray(self.mu_max * substrate / (self.k_s + substrate))


@dataclass(frozen=True)
class Arrhenius:
    """phi(T) = exp(-Ea / (R (T + 273.15))), valid 21 to 37 degC for E. coli (Ingraham & Marr, BioNumbers 105003).

    Args: activation_kj_mol: Ea, kJ/mol; 54 to 59 in the literature, mu(30)/mu(37) = 0.59 to 0.62.
    """

    activation_kj_mol: float = 56.0

    def __call__(self, temperature: Array) -> Array:
        """phi(T), not normalised, shape of `temperature` (degC)."""
        return np.exp(-self.activation_kj_mol / (GAS_CONSTANT * (temperature + 273.15)))


@dataclass(frozen=True)
class Cardinal:
    """Cardinal temperature model with inflexion (Rosso 1993): 1 at t_opt, 0 outside [t_min, t_max].

    phi(T) = (T - t_max)(T - t_min)^2
             / {(t_opt - t_min)[(t_opt - t_min)(T - t_opt) - (t_opt - t_max)(t_opt + t_min - 2 T)]}

    Args: t_min, t_opt, t_max: degC, t_min < t_opt < t_max.
    """

    t_min: float = 6.0
    t_opt: float = 41.0
    t_max: float = 47.2

    def __call__(self, temperature: Array) -> Array:
        """phi(T), shape of `temperature` (degC)."""
        inside = (temperature > self.t_min) & (temperature < self.t_max)
        t = np.where(inside, temperature, self.t_opt)
        span = self.t_opt - self.t_min
        low = span * (t - self.t_opt) - (self.t_opt - self.t_max) * (self.t_opt + self.t_min - 2.0 * t)
        return np.where(inside, (t - self.t_max) * (t - self.t_min) ** 2 / (span * low), 0.0)


def relative_to_37(response: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Return phi(T) / phi(37 degC), the factor of a rate that is given for 37 degC."""
    reference = response(np.asarray(REFERENCE_TEMPERATURE))
    return lambda temperature: response(temperature) / reference


@dataclass(frozen=True, eq=False)
class DilutedCulture:
    """Mass balances of a diluted culture with state [x, s]: OD and relative substrate.

    x' = (mu(s) - u/tau) x
    s' = (u/tau) (1 - s) - mu(s) x / yield_od

    The first line with `Exponential` is equation (5) of the paper; the second is the chemostat's substrate
    balance (Monod 1950) in units of fresh medium.

    Args:
      law: specific growth rate.
      tau: u/tau is the dilution rate in 1/min for u in mL/s; tau = volume_ml / 60 for a true flow. Scalar or (N,), > 0.
      yield_od: OD produced by one fill of fresh medium; inf: substrate never runs out. Scalar or (N,), > 0.
    """

    law: GrowthLaw
    tau: float | Array
    yield_od: float | Array = np.inf

    def derivative(self, state: Array, pump_rate: Array) -> Array:
        """d[x, s]/dt in 1/min.

        Args: state: [x, s], shape (N, 2). pump_rate: u, mL/s, shape (N,), >= 0.
        Returns: shape (N, 2).
        """
        x, s = state[:, 0], state[:, 1]
        mu = self.law.specific_rate(s)
        dilution = pump_rate / self.tau
        return np.stack([(mu - dilution) * x, dilution * (1.0 - s) - mu * x / self.yield_od], axis=1)
