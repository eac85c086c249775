"""The closed loop of a policy that sees (error, growth share): e' = e + s - v, with e = ln(x / r) / B, s = mu h / B.

B is the decrease of ln x in one period at full pump rate; v is the dose as a fraction of the full pump. The error of
the gain has two forms. Each dose has its own error (`spread`): v acts as v (1 +- gain). Or the estimate of the gain is
wrong for a long time (`slow`): v acts as requested, and the policy sees e in units of the estimated B, as (1 +- gain)
e.
"""

from dataclasses import dataclass

import numpy as np

from experiments.certification.bounds import EstimateBounds
from experiments.certification.intervals import Pieces, States
from experiments.certification.network import Array

__all__ = ["ShareCase", "ShareLoop"]


@dataclass(frozen=True)
class ShareCase:
    """Bounds on the errors of e, s and the gain, at a setpoint if the bound of e depends on the OD.

    slow: the gain error is in the estimate, not in each dose.
    """

    name: str
    bounds: EstimateBounds
    setpoint: float | None = None
    slow: bool = False

    @property
    def spread(self) -> float:
        """Relative error of each dose."""
        return 0.0 if self.slow else self.bounds.gain

    @property
    def scale(self) -> float:
        """Relative error of the unit of e."""
        return self.bounds.gain if self.slow else 0.0


@dataclass(frozen=True, eq=False)
class ShareLoop:
    """Doses and strips of the growth share.

    doses: fractions of the full pump, rising from 0 to 1, (A,). start: range of OD from which the band is entered.
    setpoints: lowest and highest. low, high: s of each strip, (S,). clip: ((e, s) lowest, (e, s) highest) that the
    policy sees; beyond, the nearest.
    """

    doses: Array
    start: tuple[float, float]
    setpoints: tuple[float, float]
    low: Array
    high: Array
    clip: tuple[Array, Array]

    @property
    def growth(self) -> Array:
        """Increase of e in a period of growth, (S,)."""
        return self.low

    def shift(self, case: ShareCase) -> Array:
        """Return the [least, largest] change of e by each action in a period, (S, A, 2)."""
        least = self.low[:, None] - self.doses * (1.0 + case.spread)
        return np.stack([least, self.high[:, None] - self.doses * (1.0 - case.spread)], axis=2)

    def range(self, case: ShareCase) -> Array:
        """Return the start as e, at the case's setpoint or at any, (S, 2)."""
        lowest, highest = self.setpoints if case.setpoint is None else (case.setpoint, case.setpoint)
        ratio = np.array([self.start[0] / highest, self.start[1] / lowest])
        return np.broadcast_to(np.log(ratio) / (case.bounds.full_pump * (1.0 - case.scale)), (self.low.size, 2))

    def seen(self, case: ShareCase) -> tuple[Array, Array]:
        """Return the growth shares that the policy may see in each strip."""
        off = case.bounds.growth_share
        low, high = (np.clip(s, self.clip[0][1], self.clip[1][1]) for s in (self.low - off, self.high + off))
        return low, high

    def _around(self, case: ShareCase, seen: Array) -> tuple[Array, Array]:
        """Bound the true e of an estimate from below and above; both bounds rise with the estimate."""
        off = case.bounds.error_at(seen, case.setpoint)
        low, high = seen - off, seen + off
        least, most = 1.0 - case.scale, 1.0 + case.scale
        return low / np.where(low > 0.0, most, least), high / np.where(high > 0.0, least, most)

    def states(self, case: ShareCase) -> States:
        """Return the possible states of an estimate. An estimate on the edge represents all beyond."""
        (lowest, _), (highest, _) = self.clip

        def around(e: Array, s: Array) -> tuple[Array, Array]:
            low, high = self._around(case, e)
            return np.where(e <= lowest, -np.inf, low), np.where(e >= highest, np.inf, high)

        return around

    def law(self, case: ShareCase) -> Pieces:
        """Apply the one-line controller: the dose nearest to clip(e + s, 0, 1)."""
        middle = (self.doses[1:] + self.doses[:-1]) / 2.0
        off = case.bounds.growth_share
        low, _ = self._around(case, middle - self.high[:, None] - off)
        _, high = self._around(case, middle - self.low[:, None] + off)
        ends = np.full((self.low.size, 1), np.inf)
        action = np.broadcast_to(np.arange(self.doses.size), (self.low.size, self.doses.size))
        return Pieces(np.hstack([-ends, low]), np.hstack([high, ends]), action)

    def half_width(self, low: Array, high: Array) -> Array:
        """Return the largest |e| of a band, (S,)."""
        return np.maximum(-low, high)

    def within(self, half_width: Array) -> tuple[Array, Array]:
        """Return the lowest and the highest e of a half-width (S,)."""
        return -half_width, half_width

    def key(self, case: ShareCase) -> object:
        """Return a key; cases of the same key have the same loop."""
        (low, _), (high, _) = self.clip
        errors = case.bounds.error_at(np.linspace(low, high, 65), case.setpoint)
        return case.slow, case.bounds.gain, case.bounds.growth_share, errors.round(12).tobytes()

    def in_od(self, case: ShareCase, half_width: float) -> float | None:
        """Convert a half-width to OD at the case's setpoint; None without one. B is at most (1 + gain) the case's."""
        if case.setpoint is None:
            return None
        return float(case.setpoint * np.expm1(case.bounds.full_pump * (1.0 + case.scale) * half_width))

    def attack(self, case: ShareCase, state: Array, second: Array, push: Array) -> tuple[Array, Array]:
        """Return what the policy sees under attack, (N, 2), and the change of e for each action, (N, A).

        At push 1 the policy sees the lowest e and s, doses are smallest and s is the strip's highest; at -1 the
        opposite; in between proportionally.
        Args: state: e (N,). second: [lowest, highest] s of the strips, (N, 2). push: in [-1, 1], of the estimates and
        of the dynamics, (N, 2).
        """
        b, (shows, acts) = case.bounds, push.T
        side, size = np.sign(shows), np.abs(shows)
        half, middle = (second[:, 1] - second[:, 0]) / 2.0, second.mean(axis=1)
        furthest = b.estimate((1.0 - np.sign(state) * side * case.scale) * state, -side, case.setpoint)
        shown = state + size * (furthest - state), middle - shows * (half + b.growth_share)
        change = (middle + acts * half)[:, None] - self.doses * (1.0 - acts[:, None] * case.spread)
        return np.stack(shown, axis=1), change
