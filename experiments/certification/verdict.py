"""Proof of a closed loop's band, and attacks on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dqn.policy import Policy
from experiments.certification.intervals import Band, Index, Mask, Points, images
from experiments.certification.loops import Loop
from experiments.certification.polygons import Array

STILL = 1e-9  # smaller changes of the state in a period count as zero
ATTACKED = 60  # periods of an attacking trajectory
SETTLED = 20  # of them until the start has no influence
LESS = (0.0, 0.3)  # probabilities of intermediate disturbances, for each half of the trajectories
TURNS = (0.5, 0.2, 0.05, 0.0)  # probabilities of a change of side, for each quarter of the trajectories


@dataclass(frozen=True, eq=False)
class Proof:
    """Proof of a policy under one case, for each strip, (S,).

    holdable: without a dose the culture grows, with the full pump it is diluted, under any disturbance.
    band, law: of the policy, and of the one-line controller. half_width, law_half_width: of the bands.
    allowed: [lowest, highest] state of a half-width that exceeds the controller's by what is allowed, (S, 2).
    entry: periods until the state is allowed, over those of the physics; inf: never.
    grows: below the range of starts every possible dose lets it grow.
    """

    case: Any
    holdable: Mask
    band: Band
    law: Band
    half_width: Array
    law_half_width: Array
    allowed: Array
    entry: Array
    grows: Mask

    @property
    def excess(self) -> Array:
        """Half-width beyond the one-line controller's, (S,)."""
        return self.half_width - self.law_half_width

    @property
    def later(self) -> Array:
        """Periods after the one-line controller until within `allowed`, (S,); inf: never."""
        of_policy, of_law = (band.until(*self.allowed.T) for band in (self.band, self.law))
        return of_policy - np.where(np.isfinite(of_law), of_law, 0.0)


def physical(start: Array, shift: Array, goal: Array) -> Array:
    """Return the periods from the ends of `start` into `goal`, at full pump or without, the slower one, (S,).

    Args: start, goal: [lowest, highest] state, (S, 2). shift: [least, largest] of each action, (S, A, 2).
    """
    fall, rise = -shift[:, -1, 1], shift[:, 0, 0]
    with np.errstate(divide="ignore"):
        periods = np.stack([(start[:, 1] - goal[:, 1]) / fall, (goal[:, 0] - start[:, 0]) / rise])
    return np.asarray(np.maximum(np.ceil(periods - 1e-9).max(axis=0), 1.0))


def prove(loop: Loop, points: Points, action: Index, case: Any, margin: float = 0.0) -> Proof:
    """Prove the band of every strip from the states in which each action may be chosen.

    Args: points: of polygons in the strips that the policy sees (`loop.seen`); action: of each polygon. margin: allowed
    half-width beyond the controller's.
    """
    pieces = points.pieces(action, loop.states(case), loop.low.size)
    shift, start = loop.shift(case), loop.range(case)
    band, law = images(pieces, shift, start), images(loop.law(case), shift, start)
    own = np.take_along_axis(shift[..., 0], pieces.action, axis=1)
    below = pieces.low <= start[:, :1]
    law_half_width = loop.half_width(law.low, law.high)
    allowed = np.stack(loop.within(np.nan_to_num(law_half_width) + margin), axis=1)  # without a band: only the margin
    return Proof(
        case,
        (shift[:, 0, 0] > STILL) & (shift[:, -1, 1] < -STILL),
        band,
        law,
        loop.half_width(band.low, band.high),
        law_half_width,
        allowed,
        band.until(*allowed.T) / physical(start, shift, allowed),
        np.asarray((~below | (own > 0.0)).all(axis=1)),
    )


def dose_below(loop: Loop, points: Points, action: Index, case: Any, actions: Sequence[int]) -> Array:
    """Return how far below the setpoint each action or a higher one is chosen, periods of growth, (actions, S).

    0 if it is only chosen above; limited to the range of starts.
    """
    pieces = points.pieces(action, loop.states(case), loop.low.size)
    lowest = np.stack([pieces.lowest(a) for a in actions])
    return np.asarray(np.maximum(-np.maximum(lowest, loop.range(case)[:, 0]), 0.0) / loop.growth)


def attacked(policy: Policy, loop: Loop, proof: Proof, trajectories: int) -> tuple[int, Array]:
    """Attack the proven band by trajectories of the policy itself, in single precision.

    They start anywhere in the band of a strip. Every disturbance has its largest size, with a sign that changes at
    random: often, to find the steps of the policy, or seldom, to move far. Sometimes it is intermediate, to reach the
    states from which the ends are reached.
    Returns: the number that left the band; the fraction of each strip's band reached after `SETTLED` periods, (S,), nan
    without a band.
    """
    rng = np.random.default_rng(0)
    proven = np.flatnonzero(proof.band.invariant & proof.holdable)
    reached = np.full(loop.low.size, np.nan)
    if not proven.size or not trajectories:
        return 0, reached
    strip = proven[np.arange(trajectories) % proven.size]
    second = np.stack([loop.low[strip], loop.high[strip]], axis=1)
    low, high = proof.band.low[strip], proof.band.high[strip]
    state = low + rng.uniform(size=strip.size) * (high - low)
    left = np.zeros(strip.size, dtype=bool)
    least, largest = np.full(reached.size, np.inf), np.full(reached.size, -np.inf)
    side, turn, weak = (rng.choice(values, strip.size) for values in ((-1.0, 1.0), TURNS, LESS))
    for period in range(ATTACKED):
        side = np.where(rng.uniform(size=strip.size) < turn, -side, side)
        free = (rng.uniform(size=strip.size) < weak)[:, None]
        push = np.where(free, rng.uniform(-1.0, 1.0, (strip.size, 2)), side[:, None])
        seen, change = loop.attack(proof.case, state, second, push)
        state = state + np.take_along_axis(change, policy.act(seen)[:, None], axis=1)[:, 0]
        left |= (state < low - 1e-9) | (state > high + 1e-9)
        if period >= SETTLED:
            np.minimum.at(least, strip, state)
            np.maximum.at(largest, strip, state)
    width = (proof.band.high - proof.band.low)[proven]
    reached[proven] = (largest - least)[proven] / width
    return int(left.sum()), reached
