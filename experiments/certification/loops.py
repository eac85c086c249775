"""The closed loops that are proven: one number d per strip, which a period of growth and a dose shift.

Of a policy that sees (OD, setpoint): d = ln(x / r), d' = d + h (mu - u / tau); a strip is of setpoints.
Of a policy that sees (error, growth share): e' = e + s - v, with e = ln(x / r) / B, s = mu h / B, and v the dose as a
fraction of the full pump; a strip is of growth shares. B is the decrease of ln x in one period at full pump rate.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from experiments.certification.bounds import EstimateBounds
from experiments.certification.intervals import Pieces, States
from experiments.certification.polygons import Array

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


@dataclass(frozen=True)
class ShareCase:
    """Bounds on the errors of e, s and the gain, at a setpoint if the bound of e depends on the OD.

    slow: the estimate of the gain is wrong for a long time: v acts as requested, and the policy sees e in units of the
    estimated B, as (1 +- gain) e. Otherwise each dose has an error of its own: v acts as v (1 +- gain).
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


class Loop(Protocol):
    """A family of closed loops, one per strip; a case says what may disturb them.

    low, high: second coordinate of each strip, (S,). levels: what the actions give, rising from 0, (A,).
    growth: least increase of the state in a period without a dose, (S,).
    shift: [least, largest] change of the state by each action in a period, (S, A, 2).
    range: the starts as states of each strip, (S, 2). seen: second coordinates that the policy may see in each strip.
    states: [least, largest] state of what the policy sees; over a convex polygon extreme at its corners.
    law: the one-line controller, by `_turns`: the least and the largest state, (S, A - 1), at which it goes on to the
      next level, whose mean with the level before is `between`. key: cases of the same key have the same loop.
    half_width: largest distance of a band of states from the setpoint, (S,), in OD or periods; `within`: its inverse,
      at every setpoint of a strip; `in_od`: in OD, None without a setpoint.
    attack: what the policy sees, (N, 2), and the change of the state for each action, (N, A). At push 1, of what is
      seen and of the dynamics, (N, 2), it sees the lowest state and second coordinate, growth is fastest and a dose
      weakest; at -1 the opposite; in between proportionally. second: [lowest, highest] of the strips, (N, 2).
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
    """Of (OD, setpoint).

    mu: 1/min. tau, control_min: min. levels: mL/s, (A,). start: OD from which the band is entered.
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
        """Change of d: the smallest mu with the smallest tau dilutes most. Args: factor: of both."""
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
    """Return ln, -inf for an OD that is not above zero."""
    return np.log(ratio, out=np.full_like(ratio, -np.inf), where=ratio > 0.0)


@dataclass(frozen=True, eq=False)
class ShareLoop(Loop):
    """Of (error, growth share).

    levels: fractions of the full pump, to 1, (A,). start: range of OD from which the band is entered. setpoints: lowest
    and highest. clip: ((e, s) lowest, (e, s) highest) that the policy sees; beyond, the nearest.
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
        """Bound the true e of an estimate from below and above; both bounds rise with the estimate."""
        off = case.bounds.error_at(seen, case.setpoint)
        low, high = seen - off, seen + off
        least, most = 1.0 - case.scale, 1.0 + case.scale
        return low / np.where(low > 0.0, most, least), high / np.where(high > 0.0, least, most)

    def states(self, case: ShareCase) -> States:
        (lowest, _), (highest, _) = self.clip

        def around(e: Array, s: Array) -> tuple[Array, Array]:
            low, high = self._around(case, e)  # an estimate on the edge represents all beyond
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
        most = case.bounds.full_pump * (1.0 + case.scale)  # of B
        return float(case.setpoint * np.expm1(most * half_width))

    def attack(self, case: ShareCase, state: Array, second: Array, push: Array) -> tuple[Array, Array]:
        b, (shows, acts) = case.bounds, push.T
        side, size = np.sign(shows), np.abs(shows)
        half, middle = (second[:, 1] - second[:, 0]) / 2.0, second.mean(axis=1)
        furthest = b.estimate((1.0 - np.sign(state) * side * case.scale) * state, -side, case.setpoint)
        shown = state + size * (furthest - state), middle - shows * (half + b.growth_share)
        change = (middle + acts * half)[:, None] - self.levels * (1.0 - acts[:, None] * case.spread)
        return np.stack(shown, axis=1), change
