"""Noise model of a recording, averaged over its unknown parameters by adaptive multiple importance sampling.

A point of the noise model is computed from seven independent standard normals z. So each parameter below is a function
of its z, which also defines its prior. F is the normal distribution function:

    p      clip(1.5 F(z) - 0.25)      fraction of the noise variance that grows with OD^2; the rest is constant
    dose   0.3 exp(1.7 z)             sd of the effect of a mean dose, in sd of a reading
    wander 0.1 exp(1.5 z)             sd of the growth fluctuations, in sd of a reading per minute
    memory 5 + 35 exp(z) min          correlation time of the growth fluctuations
    phi    0.9 F(z)                   correlation of reading noise from row to row
    late   clip(1.5 F(z) - 0.25)^2    fraction of a dose missing from the next reading; 1/6 probability of 0, and of 1
    mixing late clip(1.5 F(z) - 0.25) fraction of this missing part that is still missing one reading later; equals
                                      late if the vial mixes in first order; limited to 0.7, because a dose that never
                                      appears contains no information on tau

`average` draws points in rounds and weights them by their likelihood. The first round is drawn from the prior, each
later one from a Student t with five degrees of freedom, fitted to all points so far. If few points have nearly all
weight, the weights are tempered for this fit. The weight of a point is relative to the mixture of all rounds (Cornuet
et al. 2012, Scand. J. Stat. 39:798).
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FULL = 10 * (128,)  # points of each round
QUICK = (128, 64, 64)  # for many short series, where no single interval is decisive
TAIL = 5  # degrees of freedom of a proposal, the distribution of a round
FEWEST_EFFECTIVE = 24  # smallest number of effective points for the fit of a proposal
LEAST_SPREAD = 0.01  # smallest sd of a proposal in each direction; the prior's is 1


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """G points of the noise model for each of M series; parameters as in the module's docstring, each (M, G)."""

    p: Array
    dose: Array
    wander: Array
    memory: Array
    phi: Array
    late: Array
    mixing: Array

    @classmethod
    def at(cls, z: Array) -> "NoiseModel":
        """Build the noise models of the points z, shape (M, G, 7)."""
        from scipy.special import ndtr

        p, dose, wander, memory, phi, late, again = np.moveaxis(z, -1, 0)
        p, late, again = (np.clip(1.5 * ndtr(share) - 0.25, 0.0, 1.0) for share in (p, late, again))
        late = late**2  # gives more of the small values above 0
        return cls(
            p=p,
            dose=0.3 * np.exp(1.7 * dose),
            wander=0.1 * np.exp(1.5 * wander),
            memory=5.0 + 35.0 * np.exp(memory),
            phi=0.9 * ndtr(phi),
            late=late,
            mixing=np.minimum(late * again, 0.7),
        )


def average(score: Callable[[Array], Array], series: int, rounds: tuple[int, ...], seed: int) -> tuple[Array, Array]:
    """Draw points of the noise model and compute their weights, for each of M series.

    Args: score: logarithm of the likelihood at z, (M, g, 7) -> (M, g). series: M. rounds: number of points in each
      round. seed: random seed, the same for every series, so that a result does not depend on the other series.
    Returns: z (M, G, 7) and weights (M, G) that sum to 1.
    """
    rng, d = np.random.default_rng(seed), len(fields(NoiseModel))
    proposals = [_Student(np.zeros((series, d)), np.tile(np.eye(d), (series, 1, 1)), np.inf)]
    z, scores = np.empty((series, 0, d)), np.empty((series, 0))
    for i, points in enumerate(rounds):
        fresh = proposals[i].draw(rng, points)
        z = np.concatenate([z, fresh], axis=1)
        scores = np.concatenate([scores, score(fresh)], axis=1)
        density = [np.log(n) + q.log_density(z) for n, q in zip(rounds, proposals, strict=False)]
        log_weight = scores + proposals[0].log_density(z) - np.logaddexp.reduce(density, axis=0)
        proposals.append(_fitted(z, _tempered(log_weight)))
    return z, _normalised(log_weight)


@dataclass(frozen=True, eq=False)
class _Student:
    """Student t distribution per series: centre (M, 7), root of the spread (M, 7, 7), degrees (inf: normal)."""

    centre: Array
    root: Array
    degrees: float

    def draw(self, rng: np.random.Generator, points: int) -> Array:
        """Draw points, shape (M, points, 7)."""
        step = rng.standard_normal((points, self.centre.shape[1]))
        if np.isfinite(self.degrees):
            step *= np.sqrt(self.degrees / rng.chisquare(self.degrees, (points, 1)))
        return np.asarray(self.centre[:, None] + step @ self.root.swapaxes(-1, -2))

    def log_density(self, z: Array) -> Array:
        """Return the log density of z (M, G, 7) up to a constant, shape (M, G)."""
        from scipy.special import gammaln

        away = np.linalg.solve(self.root, (z - self.centre[:, None]).swapaxes(-1, -2))
        square = np.sum(away**2, axis=1)
        size = np.log(np.einsum("mii->mi", self.root)).sum(axis=1)[:, None]
        d, nu = z.shape[-1], self.degrees
        if not np.isfinite(nu):
            return np.asarray(-0.5 * square - size - 0.5 * d * np.log(2.0 * np.pi))
        half = 0.5 * (nu + d)
        constant = gammaln(half) - gammaln(0.5 * nu) - 0.5 * d * np.log(nu * np.pi)
        return np.asarray(constant - size - half * np.log1p(square / nu))


def _fitted(z: Array, weight: Array) -> _Student:
    """Fit a proposal to the mean and covariance of weighted points."""
    centre = np.sum(weight[..., None] * z, axis=1)
    away = z - centre[:, None]
    spread = (weight[..., None] * away).swapaxes(-1, -2) @ away + LEAST_SPREAD**2 * np.eye(z.shape[-1])
    return _Student(centre, np.linalg.cholesky(spread), TAIL)


def _normalised(log_weight: Array) -> Array:
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def effective(weight: Array) -> Array:
    """Return the effective number of points, 1 / sum w^2 (Kish 1965), shape (M,)."""
    return np.asarray(1.0 / np.sum(weight**2, axis=1))


def _tempered(log_weight: Array) -> Array:
    """Return weights raised to the largest power <= 1 that leaves FEWEST_EFFECTIVE effective points, normalised."""
    chosen = _normalised(log_weight)
    for power in np.geomspace(0.8, 1e-6, 60):
        thin = effective(chosen) < FEWEST_EFFECTIVE
        if not thin.any():
            break
        chosen = np.where(thin[:, None], _normalised(power * log_weight), chosen)
    return chosen
