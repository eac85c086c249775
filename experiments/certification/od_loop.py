"""The closed loop of a policy that sees (OD, setpoint), in d = ln(x / r): d' = d + h (mu - u / tau)."""

from dataclasses import dataclass, replace

import numpy as np

from experiments.certification.intervals import Pieces, States
from experiments.certification.network import Array

__all__ = ["OdCase", "OdLoop"]

NEAR_ZERO = 1e-9  # fraction of a setpoint that represents an OD of zero


@dataclass(frozen=True)
class OdCase:
    """Deviations from the nominal model.

    Growth rate and pump constant lie within +- `share` of it, changing from period
    to period, and a reading within +- `noise` OD of the culture.
    """

    name: str
    share: float
    noise: float


@dataclass(frozen=True, eq=False)
class OdLoop:
    """Model, pump rates and strips of setpoints.

    mu: 1/min. tau, control_min: min. rates: mL/s, rising from 0, (A,). start: OD from which the band is entered.
    low, high: setpoints of each strip, (S,).
    """

    mu: float
    tau: float
    control_min: float
    rates: Array
    start: tuple[float, float]
    low: Array
    high: Array

    @property
    def growth(self) -> Array:
        """Increase of d in a period of nominal growth, (S,)."""
        return np.full(self.low.size, self.mu * self.control_min)

    def at(self, setpoints: Array) -> "OdLoop":
        """Return the same loop for single setpoints in place of strips."""
        return replace(self, low=setpoints, high=setpoints)

    def shift(self, case: OdCase) -> Array:
        """Return the [least, largest] change of d by each action in a period, (S, A, 2).

        Least: the smallest mu with the smallest tau, which dilutes most; largest: the other way round.
        """
        factor = 1.0 + case.share * np.array([-1.0, 1.0])
        change = self.control_min * (self.mu * factor - self.rates[:, None] / (self.tau * factor))
        return np.broadcast_to(change, (self.low.size, *change.shape))

    def range(self, case: OdCase) -> Array:
        """Return the start as d, for every setpoint of each strip, (S, 2)."""
        return np.log(np.stack([self.start[0] / self.high, self.start[1] / self.low], axis=1))

    def seen(self, case: OdCase) -> tuple[Array, Array]:
        """Return the setpoints that the policy sees in each strip."""
        return self.low, self.high

    def states(self, case: OdCase) -> States:
        """Return the states d of y -+ noise of a reading y at setpoint r. Linear-fractional, so extreme at corners."""
        return lambda y, r: (_log((y - case.noise) / r), _log((y + case.noise) / r))

    def law(self, case: OdCase) -> Pieces:
        """Apply the one-line controller of the nominal model: the rate nearest to tau (mu + ln(y / r) / h)."""
        middle = (self.rates[1:] + self.rates[:-1]) / 2.0
        reading = np.exp(self.control_min * (middle / self.tau - self.mu))  # y / r between two rates
        off = case.noise / self.low[:, None]
        ends = np.full((self.low.size, 1), np.inf)
        action = np.broadcast_to(np.arange(self.rates.size), (self.low.size, self.rates.size))
        return Pieces(np.hstack([-ends, _log(reading - off)]), np.hstack([_log(reading + off), ends]), action)

    def half_width(self, low: Array, high: Array) -> Array:
        """Return the largest |x - r| of a band in d, OD, (S,)."""
        return self.high * np.maximum(np.expm1(high), -np.expm1(low))

    def within(self, half_width: Array) -> tuple[Array, Array]:
        """Return the lowest and the highest d of |x - r| <= half_width (S,), at every setpoint of each strip."""
        ratio = half_width / self.high
        return np.log(np.maximum(1.0 - ratio, NEAR_ZERO)), np.log1p(ratio)

    def key(self, case: OdCase) -> object:
        """Return the case: every case is a loop of its own."""
        return case

    def in_od(self, case: OdCase, half_width: float) -> float:
        """Return a half-width, which is in OD already."""
        return half_width

    def attack(self, case: OdCase, state: Array, second: Array, push: Array) -> tuple[Array, Array]:
        """Return what the policy sees under attack, (N, 2), and the change of d for each action, (N, A).

        At push 1 the reading is lowest, growth fastest and a dose weakest; at -1 the opposite; in between
        proportionally.
        Args: state: d (N,). second: [lowest, highest] setpoint of the strips, (N, 2). push: in [-1, 1], of the reading
        and of the dynamics, (N, 2).
        """
        shows, acts = push.T
        setpoint = second.mean(axis=1) - shows * (second[:, 1] - second[:, 0]) / 2.0
        reading = setpoint * np.exp(state) - shows * case.noise
        factor = 1.0 + acts * case.share
        change = self.control_min * ((self.mu * factor)[:, None] - self.rates / (self.tau * factor)[:, None])
        return np.stack([reading, setpoint], axis=1), change


def _log(ratio: Array) -> Array:
    """Return ln, -inf for an OD that is not above zero."""
    return np.log(ratio, out=np.full_like(ratio, -np.inf), where=ratio > 0.0)
