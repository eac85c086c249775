"""The best possible doses of the mixing chamber, by dynamic programming, while the reservoir is held.

State: ln X and logit rho, the reservoir at its density and full. On a grid of both the cost-to-go is linear in every
cell, and what a pair of doses does to the grid is one sparse matrix. Backward induction (Bellman 1957):

  V_k = min_(v1, v2) [cost(X', rho') + V_(k+1)(X', rho')],     V_K = 0

over doses that flow: none, or from the smallest useful one to the largest. Greedy doses look one minute ahead by the
exact model, from whatever is believed of the reservoir.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.sparse import csr_array

from envs.dual_chamber.rig import TINY, RigConfig, advance
from envs.dual_chamber.task import cost, mixture, start

__all__ = ["Grid", "Model", "best_dose", "cost_to_go", "doses", "model"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """Points of ln X and logit rho, fine where they are asked for, and levels of each dose with zero and the largest.

    finest: distance of points at a setpoint. widening: by how much it grows with the distance from it.
    """

    finest: float = 0.008
    widening: float = 0.4
    levels: int = 13
    od_span: float = 1.1  # of ln X to either side
    logit_span: float = 3.5  # largest |logit|

    def axes(self, od: float, ratios: tuple[float, ...]) -> tuple[Array, Array]:
        """Points of ln X and of logit rho for these setpoints."""
        logits = [math.log(r / (1.0 - r)) for r in ratios]
        x = math.log(od)
        return self._axis([x], x - self.od_span, x + self.od_span), self._axis(
            logits, -self.logit_span, self.logit_span
        )

    def _axis(self, goals: list[float], low: float, high: float) -> Array:
        """Rising points from low to high through every goal; their density is 1 / (finest + widening distance)."""
        stops, points = sorted({low, *goals, high}), [low]
        for left, right in pairwise(stops):
            mesh = np.linspace(left, right, 2001)
            spacing = self.finest + self.widening * np.abs(mesh[:, None] - np.array(goals)).min(axis=1)
            passed = cumulative_trapezoid(1.0 / spacing, mesh, initial=0)
            points += [*np.interp(np.linspace(0.0, passed[-1], math.ceil(passed[-1]) + 1)[1:], passed, mesh)]
        return np.array(points)


def doses(config: RigConfig, smallest: float, levels: int) -> Array:
    """Every pair of doses (fresh, reservoir) that flows, with no supply of the reservoir, mL, (A, 3)."""
    level = np.linspace(0.0, config.largest_ml, levels)
    level = level[(level == 0.0) | (level >= smallest - TINY)]
    fresh, slow = np.meshgrid(level, level, indexing="ij")
    return np.stack([fresh.ravel(), slow.ravel(), np.zeros(fresh.size)], axis=-1)


@dataclass(frozen=True, eq=False)
class Model:
    """What every pair of doses makes of every grid point.

    doses: (A, 3). state: after the minute, (A, G, 4). matrix: values there from values on the grid, (A G, G).
    """

    axes: tuple[Array, Array]
    doses: Array
    state: Array
    matrix: csr_array

    def value_at(self, value: Array, state: Array) -> Array:
        """V at states (N, A, 4), (N, A); of one setpoint, (G,), or of one per row, (G, N)."""
        index, weight = _corners(self.axes, state)
        rows = np.arange(state.shape[0])[:, None, None]
        found = value[index] if value.ndim == 1 else value[index, rows]
        return np.asarray((found * weight).sum(axis=-1))


def _corners(axes: tuple[Array, Array], state: Array) -> tuple[NDArray[np.int32], Array]:
    """The four grid points around states (..., 4) and their weights, (..., 4) each; beyond the grid its edge."""
    total, share = mixture(state)
    (i, a), (j, b) = (
        _cell(at, axis) for at, axis in zip((np.log(total), np.log(share / (1.0 - share))), axes, strict=True)
    )
    index = (i * axes[1].size + j)[..., None] + np.array([0, 1, axes[1].size, axes[1].size + 1])
    weight = np.stack([(1.0 - a) * (1.0 - b), (1.0 - a) * b, a * (1.0 - b), a * b], axis=-1)
    return index.astype(np.int32), weight


def _cell(at: Array, axis: Array) -> tuple[NDArray[np.intp], Array]:
    """Index of the grid point below and the share of the one above."""
    left = np.clip(np.searchsorted(axis, at, side="right") - 1, 0, axis.size - 2)
    return left, np.clip((at - axis[left]) / (axis[left + 1] - axis[left]), 0.0, 1.0)


@lru_cache(maxsize=4)
def model(config: RigConfig, smallest: float, od: float, ratios: tuple[float, ...], grid: Grid = Grid()) -> Model:
    """The rig on a grid, kept for the last few. Args: smallest: useful dose, mL. od, ratios: setpoints."""
    axes, pairs = grid.axes(od, ratios), doses(config, smallest, grid.levels)
    x, r = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    after = advance(config, start(config, np.exp(x), 1.0 / (1.0 + np.exp(-r))), pairs[:, None])
    index, weight = _corners(axes, after)
    rows = after.shape[0] * after.shape[1]
    matrix = csr_array((weight.ravel(), index.ravel(), np.arange(rows + 1) * 4), shape=(rows, x.size))
    return Model(axes, pairs, after, matrix)


def cost_to_go(of: Model, od: float, ratios: Array) -> Array:
    """V_0 to V_K of programs of the share, (K + 1, G, B). Args: ratios: asked for in each minute, (K, B)."""
    minutes, programs = ratios.shape
    value = np.zeros((minutes + 1, of.state.shape[1], programs))
    costs = {ratio: cost(of.state, od, ratio) for ratio in np.unique(ratios)}
    for k in range(minutes - 1, -1, -1):
        ahead = (of.matrix @ value[k + 1]).reshape(*of.state.shape[:2], programs)
        for b in range(programs):
            value[k, :, b] = (costs[ratios[k, b]] + ahead[..., b]).min(axis=0)
    return value


def best_dose(config: RigConfig, of: Model, state: Array, od: float, ratio: Array, value: Array | None) -> Array:
    """Doses (N, 3) with the least cost of this minute and, given a value, of those after it.

    Args: state: believed, (N, 4). ratio: asked for, (N,). value: after this minute, (G,) or (G, N); None: nothing
      counts after it, which is the myopic law.
    """
    after = advance(config, state[:, None], of.doses)  # (N, A, 4)
    total = cost(after, od, np.asarray(ratio)[:, None])
    if value is not None:
        total = total + of.value_at(value, after)
    return np.asarray(of.doses[total.argmin(axis=1)])
