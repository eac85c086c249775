"""Proof of the band of a closed loop, and attacks: simulated worst-case trajectories that try to leave the band."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dqn.policy import Policy
from experiments.certification.intervals import Band, Index, Mask, Points, images
from experiments.certification.loops import Loop
from experiments.certification.polygons import Array

STILL = 1e-9  # smaller changes of the state in a period count as zero
ATTACKED = 60  # periods of a worst-case trajectory
SETTLED = 20  # periods after which the start has no influence any more
LESS = (0.0, 0.3)  # probabilities of a smaller disturbance in a period; each trajectory has one of them
TURNS = (0.5, 0.2, 0.05, 0.0)  # probabilities that the disturbance changes its sign; each trajectory has one of them


@dataclass(frozen=True, eq=False)
class Proof:
    """Proof of a policy in one case, for each strip, (S,).

    holdable: whether the culture always grows without a dose and always shrinks at full pump. band: band of the policy;
    law: band of the one-line controller. half_width, law_half_width: half-widths of these bands.
    allowed: [lowest, highest] allowed state: half-width of the one-line controller plus the margin, (S, 2).
    entry: periods until the state is within `allowed` / those of `physical`; inf: never.
    grows: whether the culture grows under every possible dose while it is below the range of starts.
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
        """Half-width of the band minus that of the one-line controller, (S,)."""
        return self.half_width - self.law_half_width

    @property
    def later(self) -> Array:
        """Periods until the state is within `allowed`, minus those of the one-line controller, (S,); inf: never."""
        of_policy, of_law = (band.until(*self.allowed.T) for band in (self.band, self.law))
        return of_policy - np.where(np.isfinite(of_law), of_law, 0.0)


def physical(start: Array, shift: Array, goal: Array) -> Array:
    """Return the periods from `start` into `goal`: from above at full pump, from below without; the larger, (S,).

    Args: start, goal: [lowest, highest] state, (S, 2). shift: [smallest, largest] shift by each action, (S, A, 2).
    """
    fall, rise = -shift[:, -1, 1], shift[:, 0, 0]
    with np.errstate(divide="ignore"):
        periods = np.stack([(start[:, 1] - goal[:, 1]) / fall, (goal[:, 0] - start[:, 0]) / rise])
    return np.asarray(np.maximum(np.ceil(periods - 1e-9).max(axis=0), 1.0))


def prove(loop: Loop, points: Points, action: Index, case: Any, margin: float = 0.0) -> Proof:
    """Prove the band of every strip from the states in which each action may be chosen.

    Args: points: points of the polygons in the strips that the policy sees (`loop.seen`); action: action of each
    polygon. margin: allowed half-width beyond that of the one-line controller.
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
    """Return the largest distance below the setpoint at which each action or a higher one may be chosen, (actions, S).

    The unit is periods of growth. It is 0 for actions chosen only above the setpoint, and limited by the lowest start.
    """
    pieces = points.pieces(action, loop.states(case), loop.low.size)
    lowest = np.stack([pieces.lowest(a) for a in actions])
    return np.asarray(np.maximum(-np.maximum(lowest, loop.range(case)[:, 0]), 0.0) / loop.growth)


def attacked(policy: Policy, loop: Loop, proof: Proof, trajectories: int) -> tuple[int, Array]:
    """Attack the proven bands: simulate worst-case trajectories of the policy itself, in single precision.

    Each trajectory starts anywhere in the band of a strip. Each disturbance has its largest size. Its sign changes at
    random: often, to find steps between actions, or rarely, to move far. Sometimes a disturbance is smaller, to reach
    more states.
    Returns: number of trajectories that left their band; fraction of each strip's band that was reached after
    `SETTLED` periods, (S,), nan without a band.
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
