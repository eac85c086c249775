"""From a policy to what is proven of its closed loop, and whether that is enough."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dqn.policy import Policy
from experiments.certification.intervals import Band, Index, Mask, Pieces, Points, States, images
from experiments.certification.network import Array

__all__ = ["Loop", "Proof", "dose_below", "escapes", "prove"]

STILL = 1e-9  # a smaller change of the state in a period is none
ATTACKED = 60  # periods of a trajectory that tries to leave the band


class Loop(Protocol):
    """A family of closed loops with one number as state, a member per strip; cases are what may disturb it."""

    low: Array
    high: Array

    @property
    def growth(self) -> Array: ...
    def shift(self, case: Any) -> Array: ...
    def range(self) -> Array: ...
    def seen(self, case: Any) -> tuple[Array, Array]: ...
    def states(self, case: Any) -> States: ...
    def law(self, case: Any) -> Pieces: ...
    def half_width(self, low: Array, high: Array) -> Array: ...
    def attack(self, case: Any, state: Array, second: Array, push: Array) -> tuple[Array, Array]: ...


@dataclass(frozen=True, eq=False)
class Proof:
    """What is proven of a policy under one case, for each strip, (S,).

    holdable: doing nothing lets the culture grow, and the full pump thins it, whatever the disturbance.
    band, law: of the policy, and of the one-line law. half_width, law_half_width: of the bands.
    entry: periods over those of the physics. grows: below the range of starts every possible dose lets it grow.
    """

    case: Any
    holdable: Mask
    band: Band
    law: Band
    half_width: Array
    law_half_width: Array
    entry: Array
    grows: Mask

    @property
    def excess(self) -> Array:
        """Half-width over that of the law, (S,)."""
        return self.half_width - self.law_half_width


def physical(loop: Loop, shift: Array, band: Band) -> Array:
    """Periods from the ends of the range into a band, at full pump and without, the slower one, (S,).

    Args: shift: [least, largest] of each action, (S, A, 2).
    """
    start, fall, rise = loop.range(), -shift[:, -1, 1], shift[:, 0, 0]
    with np.errstate(divide="ignore"):
        periods = np.stack([(start[:, 1] - band.high) / fall, (band.low - start[:, 0]) / rise])
    return np.asarray(np.maximum(np.ceil(periods - 1e-9).max(axis=0), 1.0))


def prove(loop: Loop, points: Points, action: Index, case: Any) -> Proof:
    """What follows for every strip from where the policy may choose which action.

    Args: points: of polygons in the strips that the policy is shown (`loop.seen`); action: of each polygon.
    """
    pieces = points.pieces(action, loop.states(case), loop.low.size)
    shift, start = loop.shift(case), loop.range()
    band, law = images(pieces, shift, start), images(loop.law(case), shift, start)
    own = np.take_along_axis(shift[..., 0], pieces.action, axis=1)
    below = pieces.low <= start[:, :1]
    return Proof(
        case,
        (shift[:, 0, 0] > STILL) & (shift[:, -1, 1] < -STILL),
        band,
        law,
        loop.half_width(band.low, band.high),
        loop.half_width(law.low, law.high),
        band.periods / physical(loop, shift, band),
        np.asarray((~below | (own > 0.0)).all(axis=1)),
    )


def dose_below(loop: Loop, points: Points, action: Index, case: Any, actions: Sequence[int]) -> Array:
    """How far below the setpoint each action or a higher one may still be chosen, periods of growth, (actions, S).

    0 where it is only chosen above; no further than the range of starts reaches.
    """
    pieces = points.pieces(action, loop.states(case), loop.low.size)
    lowest = np.stack([pieces.lowest(a) for a in actions])
    return np.asarray(np.maximum(-np.maximum(lowest, loop.range()[:, 0]), 0.0) / loop.growth)


def escapes(policy: Policy, loop: Loop, proof: Proof, trajectories: int) -> int:
    """Trajectories of the policy itself, in single precision, that leave the proven band under the worst disturbances.

    They start anywhere in the band of any strip that has one. Each disturbance stands at one of its bounds for a
    random number of periods.
    """
    rng = np.random.default_rng(0)
    proven = np.flatnonzero(proof.band.invariant & proof.holdable)
    if not proven.size or not trajectories:
        return 0
    strip = proven[rng.integers(proven.size, size=trajectories)]
    second = loop.low[strip] + rng.uniform(size=strip.size) * (loop.high - loop.low)[strip]
    low, high = proof.band.low[strip], proof.band.high[strip]
    state = low + rng.uniform(size=strip.size) * (high - low)
    push = rng.choice([-1.0, 1.0], (strip.size, 3))
    left = np.zeros(strip.size, dtype=bool)
    for _ in range(ATTACKED):
        push = np.where(rng.uniform(size=push.shape) < 0.3, -push, push)
        seen, change = loop.attack(proof.case, state, second, push)
        state = state + np.take_along_axis(change, policy.act(seen)[:, None], axis=1)[:, 0]
        left |= (state < low - 1e-9) | (state > high + 1e-9)
    return int(left.sum())
