"""The closed loop of a policy that sees (error, growth share): e' = e + s - v, with e = ln(x / r) / B, s = mu h / B.

B is what one period of full pump takes off ln x, for the estimated pump gain; v is the share of the full pump that is
dosed. Where the true gain is another, v acts as v (1 + its relative error); e and s are in units of the estimate and do
not change.
"""

from dataclasses import dataclass, replace

import numpy as np

from experiments.certification.bounds import EstimateBounds
from experiments.certification.intervals import Pieces, States
from experiments.certification.network import Array

__all__ = ["ShareCase", "ShareLoop"]


@dataclass(frozen=True)
class ShareCase:
    """Bounds on the errors of e, s and the gain; at a setpoint where the bound of e depends on the OD."""

    name: str
    bounds: EstimateBounds
    setpoint: float | None = None


@dataclass(frozen=True, eq=False)
class ShareLoop:
    """Doses and strips of the growth share.

    doses: shares of the full pump, rising from 0 to 1, (A,). start: range of e from which the band is entered.
    low, high: s of each strip, (S,). clip: ((e, s) lowest, (e, s) highest) that the policy sees; beyond, the nearest.
    """

    doses: Array
    start: tuple[float, float]
    low: Array
    high: Array
    clip: tuple[Array, Array]

    @property
    def growth(self) -> Array:
        """What a period of growth adds to e, (S,)."""
        return self.low

    def at(self, shares: Array) -> "ShareLoop":
        """The same for single values of s in place of strips."""
        return replace(self, low=shares, high=shares)

    def shift(self, case: ShareCase) -> Array:
        """[least, largest] change of e by each action in a period, (S, A, 2)."""
        gain = case.bounds.gain
        least = self.low[:, None] - self.doses * (1.0 + gain)
        return np.stack([least, self.high[:, None] - self.doses * (1.0 - gain)], axis=2)

    def range(self) -> Array:
        """The start, (S, 2)."""
        return np.broadcast_to(np.array(self.start), (self.low.size, 2))

    def seen(self, case: ShareCase) -> tuple[Array, Array]:
        """Growth shares that the policy may be shown in each strip."""
        off = case.bounds.growth_share
        low, high = (np.clip(s, self.clip[0][1], self.clip[1][1]) for s in (self.low - off, self.high + off))
        return low, high

    def _around(self, case: ShareCase, seen: Array) -> tuple[Array, Array]:
        """The lowest and the highest e behind an estimate of it; both rise with the estimate."""
        b, off = case.bounds, np.full_like(seen, case.bounds.error)
        if case.setpoint is not None:
            od = case.setpoint * np.exp(b.full_pump * seen)
            off = np.maximum(off, np.log1p(b.od / od) / b.full_pump)
        return seen - off, seen + off

    def states(self, case: ShareCase) -> States:
        """States behind an estimate. One on the edge of what the policy sees stands for all beyond."""
        (lowest, _), (highest, _) = self.clip

        def around(e: Array, s: Array) -> tuple[Array, Array]:
            low, high = self._around(case, e)
            return np.where(e <= lowest, -np.inf, low), np.where(e >= highest, np.inf, high)

        return around

    def law(self, case: ShareCase) -> Pieces:
        """The one-line law: the dose nearest to clip(e + s, 0, 1)."""
        middle = (self.doses[1:] + self.doses[:-1]) / 2.0
        off = case.bounds.growth_share
        low, _ = self._around(case, middle - self.high[:, None] - off)
        _, high = self._around(case, middle - self.low[:, None] + off)
        ends = np.full((self.low.size, 1), np.inf)
        action = np.broadcast_to(np.arange(self.doses.size), (self.low.size, self.doses.size))
        return Pieces(np.hstack([-ends, low]), np.hstack([high, ends]), action)

    def half_width(self, low: Array, high: Array) -> Array:
        """Largest |e| of a band, (S,)."""
        return np.maximum(-low, high)

    def attack(self, case: ShareCase, state: Array, second: Array, push: Array) -> tuple[Array, Array]:
        """What the policy is shown, (N, 2), and what a period adds to e for each action, (N, A), under disturbances.

        Args: state e (N,); second: s (N,). push: share of each bound, in [-1, 1], (N, 3): of e, s and gain.
        """
        shown = [state + push[:, 0] * case.bounds.error, second + push[:, 1] * case.bounds.growth_share]
        change = second[:, None] - self.doses * (1.0 + push[:, 2:] * case.bounds.gain)
        return np.stack(shown, axis=1), change
