"""Closed loops that are proven. Their state is one number per strip; growth and dose of a period shift it.

Policy that sees (OD, setpoint): the state is d = ln(x / r), d' = d + h (mu - u / tau). A strip is a range of setpoints.
Policy that sees (error, growth share): the state is e = ln(x / r) / B, e' = e + s - v, with s = mu h / B and v the dose
as a fraction of full pump. A strip is a range of growth shares. B is the decrease of ln x in one period of full pump.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from experiments.certification.bounds import EstimateBounds
from experiments.certification.intervals import Pieces, States
from experiments.certification.polygons import Array

NEAR_ZERO = 1e-9  # fraction of the setpoint that stands for an OD of zero


@dataclass(frozen=True)
class OdCase:
    """Allowed deviations from the nominal model.

    share: relative deviation of mu and tau, +-, which may change in every period. noise: error of a reading, +-, OD.
    """

    name: str
    share: float
    noise: float


@dataclass(frozen=True)
class ShareCase:
    """Bounds on the errors of e, s and the gain. setpoint: needed for a bound on e that depends on the OD.

    slow: the estimate of the gain has a lasting error: v acts as requested, but the policy sees e in units of the wrong
    B, as (1 +- gain) e. Otherwise each dose has a separate error: v acts as v (1 +- gain).
    """

    name: str
    bounds: EstimateBounds
    setpoint: float | None = None
    slow: bool = False

    @property
    def spread(self) -> float:
        """Largest relative error of a single dose."""
        return 0.0 if self.slow else self.bounds.gain

    @property
    def scale(self) -> float:
        """Largest relative error of the unit of e."""
        return self.bounds.gain if self.slow else 0.0


class Loop(Protocol):
    """Interface of the closed loops, one per strip. A `case` defines the possible disturbances.

    low, high: range of the second coordinate of each strip, (S,). levels: doses of the actions, rising from 0, (A,).
    growth: smallest increase of the state in a period without a dose, (S,).
    shift: [smallest, largest] change of the state by each action in a period, (S, A, 2).
    range: interval of possible starts in each strip, (S, 2). seen: range of second coordinates that the policy may see.
    states: function of what the policy sees -> smallest and largest true state; over a convex polygon its extremes are
      at corners. law: pieces of the one-line controller. _turns: smallest and largest state at which it changes from
      one level to the next, (S, A - 1); between: means of neighbouring levels. key: equal for cases with equal loops.
    half_width: largest distance of a band from the setpoint, (S,), in OD or periods. within: band of a half-width,
      valid at every setpoint of a strip. in_od: a half-width in OD, None without a setpoint.
    attack: what the policy sees, (N, 2), and the change of the state by each action, (N, A), under worst-case errors.
      push: size of the errors of what is seen and of the dynamics, (N, 2). At 1 the policy sees the lowest state and
      second coordinate, growth is fastest and doses are weakest; at -1 the opposite; else proportional. second:
      [lowest, highest] of the strips, (N, 2).
    """

    low: Array
    high: Array
    levels: Array

    @property
    def growth(self) -> Array: ...
    def shift(self, case: Any) -> Array: ...
    def range(self, case: Any) -> Array: ...
    def states(self, case: Any) -> States: ...
    def half_width(self, low: Array, high: Array) -> Array: ...
    def within(self, half_width: Array) -> tuple[Array, Array]: ...
    def in_od(self, case: Any, half_width: float) -> float | None: ...
    def attack(self, case: Any, state: Array, second: Array, push: Array) -> tuple[Array, Array]: ...
    def _turns(self, case: Any, between: Array) -> tuple[Array, Array]: ...
    def seen(self, case: Any) -> tuple[Array, Array]:
        return self.low, self.high

    def key(self, case: Any) -> object:
        return case

    def law(self, case: Any) -> Pieces:
        low, high = self._turns(case, (self.levels[1:] + self.levels[:-1]) / 2.0)
        ends = np.full((self.low.size, 1), np.inf)
        action = np.broadcast_to(np.arange(self.levels.size), (self.low.size, self.levels.size))
        return Pieces(np.hstack([-ends, low]), np.hstack([high, ends]), action)


@dataclass(frozen=True, eq=False)
class OdLoop(Loop):
    """Closed loops of a policy that sees (OD, setpoint).

    mu: 1/min. tau: u/tau is the dilution rate, 1/min. control_min: min. levels: mL/s, (A,). start: range of starts, OD.
    """

    mu: float
    tau: float
    control_min: float
    levels: Array
    start: tuple[float, float]
    low: Array
    high: Array

    @property
    def growth(self) -> Array:
        return np.full(self.low.size, self.mu * self.control_min)

    def at(self, setpoints: Array) -> "OdLoop":
        return replace(self, low=setpoints, high=setpoints)

    def shift(self, case: OdCase) -> Array:
        change = np.stack([self._change(1.0 - case.share), self._change(1.0 + case.share)], axis=1)
        return np.broadcast_to(change, (self.low.size, *change.shape))

    def _change(self, factor: Array | float) -> Array:
        """Return the change of d in a period if mu and tau are multiplied by `factor`; it rises with the factor."""
        return np.asarray(self.control_min * (self.mu * factor - self.levels / (self.tau * factor)))

    def range(self, case: OdCase) -> Array:
        return np.log(np.stack([self.start[0] / self.high, self.start[1] / self.low], axis=1))

    def states(self, case: OdCase) -> States:
        return lambda y, r: (_log((y - case.noise) / r), _log((y + case.noise) / r))

    def _turns(self, case: OdCase, between: Array) -> tuple[Array, Array]:
        reading = np.exp(self.control_min * (between / self.tau - self.mu))  # y / r
        off = case.noise / self.low[:, None]
        return _log(reading - off), _log(reading + off)

    def half_width(self, low: Array, high: Array) -> Array:
        return self.high * np.maximum(np.expm1(high), -np.expm1(low))

    def within(self, half_width: Array) -> tuple[Array, Array]:
        ratio = half_width / self.high
        return np.log(np.maximum(1.0 - ratio, NEAR_ZERO)), np.log1p(ratio)

    def in_od(self, case: OdCase, half_width: float) -> float:
        return half_width

    def attack(self, case: OdCase, state: Array, second: Array, push: Array) -> tuple[Array, Array]:
        shows, acts = push.T
        setpoint = second.mean(axis=1) - shows * (second[:, 1] - second[:, 0]) / 2.0
        reading = setpoint * np.exp(state) - shows * case.noise
        return np.stack([reading, setpoint], axis=1), self._change((1.0 + acts * case.share)[:, None])


def _log(ratio: Array) -> Array:
    """Return ln(ratio), -inf where ratio <= 0."""
    return np.log(ratio, out=np.full_like(ratio, -np.inf), where=ratio > 0.0)


@dataclass(frozen=True, eq=False)
class ShareLoop(Loop):
    """Closed loops of a policy that sees (error, growth share).

    levels: fractions of full pump, from 0 to 1, (A,). start: range of starts, OD. setpoints: lowest and highest, OD.
    clip: lowest (e, s) and highest (e, s) that the policy sees; others are clipped to these.
    """

    levels: Array
    start: tuple[float, float]
    setpoints: tuple[float, float]
    low: Array
    high: Array
    clip: tuple[Array, Array]

    @property
    def growth(self) -> Array:
        return self.low

    def shift(self, case: ShareCase) -> Array:
        least = self.low[:, None] - self.levels * (1.0 + case.spread)
        return np.stack([least, self.high[:, None] - self.levels * (1.0 - case.spread)], axis=2)

    def range(self, case: ShareCase) -> Array:
        lowest, highest = self.setpoints if case.setpoint is None else (case.setpoint, case.setpoint)
        ratio = np.array([self.start[0] / highest, self.start[1] / lowest])
        return np.broadcast_to(np.log(ratio) / (case.bounds.full_pump * (1.0 - case.scale)), (self.low.size, 2))

    def seen(self, case: ShareCase) -> tuple[Array, Array]:
        off = case.bounds.growth_share
        low, high = (np.clip(s, self.clip[0][1], self.clip[1][1]) for s in (self.low - off, self.high + off))
        return low, high

    def _around(self, case: ShareCase, seen: Array) -> tuple[Array, Array]:
        """Return the smallest and the largest true e of each estimate; both rise with the estimate."""
        off = case.bounds.error_at(seen, case.setpoint)
        low, high = seen - off, seen + off
        least, most = 1.0 - case.scale, 1.0 + case.scale
        return low / np.where(low > 0.0, most, least), high / np.where(high > 0.0, least, most)

    def states(self, case: ShareCase) -> States:
        (lowest, _), (highest, _) = self.clip

        def around(e: Array, s: Array) -> tuple[Array, Array]:
            low, high = self._around(case, e)  # an estimate on the edge stands for all estimates beyond it
            return np.where(e <= lowest, -np.inf, low), np.where(e >= highest, np.inf, high)

        return around

    def _turns(self, case: ShareCase, between: Array) -> tuple[Array, Array]:
        off = case.bounds.growth_share
        low, _ = self._around(case, between - self.high[:, None] - off)
        return low, self._around(case, between - self.low[:, None] + off)[1]

    def half_width(self, low: Array, high: Array) -> Array:
        return np.maximum(-low, high)

    def within(self, half_width: Array) -> tuple[Array, Array]:
        return -half_width, half_width

    def key(self, case: ShareCase) -> object:
        (low, _), (high, _) = self.clip
        errors = case.bounds.error_at(np.linspace(low, high, 65), case.setpoint)
        return case.slow, case.bounds.gain, case.bounds.growth_share, errors.round(12).tobytes()

    def in_od(self, case: ShareCase, half_width: float) -> float | None:
        if case.setpoint is None:
            return None
        most = case.bounds.full_pump * (1.0 + case.scale)  # largest B
        return float(case.setpoint * np.expm1(most * half_width))

    def attack(self, case: ShareCase, state: Array, second: Array, push: Array) -> tuple[Array, Array]:
        b, (shows, acts) = case.bounds, push.T
        side, size = np.sign(shows), np.abs(shows)
        half, middle = (second[:, 1] - second[:, 0]) / 2.0, second.mean(axis=1)
        furthest = b.estimate((1.0 - np.sign(state) * side * case.scale) * state, -side, case.setpoint)
        shown = state + size * (furthest - state), middle - shows * (half + b.growth_share)
        change = (middle + acts * half)[:, None] - self.levels * (1.0 - acts[:, None] * case.spread)
        return np.stack(shown, axis=1), change
