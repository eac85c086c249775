"""The best possible composition controllers, by dynamic programming, for any program known ahead.

State: logit x of the share, temperature T, lagged rate m. On a grid of all three, the cost-to-go is linear in every
cell, and what an action does to the grid is one sparse matrix. Backward induction (Bellman 1957) over the decisions
that are left:

  V_k = min_a [(r'_a - s_k)^2 + V_{k+1}(x'_a, T'_a, m'_a)],     V_K = 0

with s_k the setpoint in force during decision k. Greedy actions look one decision ahead by the exact model.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from envs.coculture.task import CocultureConfig, advance, share

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """Points of logit share, temperature and lagged rate on which values are kept. logit_span: largest |x|."""

    logits: int = 161
    temperatures: int = 15
    rates: int = 9
    logit_span: float = 6.0

    def axes(self, config: CocultureConfig) -> tuple[Array, Array, Array]:
        """Points of T, m, x, in the order of a value's axes."""
        rate = config.scale_p * config.pair.rates(np.linspace(*config.span, 71))[:, 1]
        return (
            np.linspace(config.span[0], config.pair.temperatures[1], self.temperatures),
            np.linspace(rate.min(), rate.max(), self.rates),
            np.linspace(-self.logit_span, self.logit_span, self.logits),
        )


@dataclass(frozen=True, eq=False)
class Transitions:
    """What every action makes of every grid point.

    share: r' after the decision, (A, G). matrix: values after the decision from values on the grid, (A G, G).
    """

    axes: tuple[Array, Array, Array]
    share: Array
    matrix: "csr_array"

    def value_at(self, value: Array, state: Array) -> Array:
        """V at states (N, A, 3); of one program, (G,), or of one program per state, (G, N)."""
        index, weight = _corners(self.axes, state)
        if value.ndim == 1:
            return np.asarray((value[index] * weight).sum(axis=-1))
        own = np.arange(value.shape[1])[:, None, None]
        return np.asarray((value[index, own] * weight).sum(axis=-1))


def _corners(axes: tuple[Array, Array, Array], state: Array) -> tuple[NDArray[np.int32], Array]:
    """Find the eight grid points around states (..., 3) and their weights, (..., 8) each."""
    cells = [_cell(state[..., k], axis) for k, axis in zip((1, 2, 0), axes, strict=True)]
    index, weight = np.empty((*state.shape[:-1], 8), dtype=np.int32), np.empty((*state.shape[:-1], 8))
    for corner in range(8):
        bits = [(corner >> k) & 1 for k in range(3)]
        points = [c[0] + b for c, b in zip(cells, bits, strict=True)]
        index[..., corner] = np.ravel_multi_index(points, [axis.size for axis in axes])
        weight[..., corner] = np.prod([c[1] if b else 1.0 - c[1] for c, b in zip(cells, bits, strict=True)], axis=0)
    return index, weight


def _cell(at: Array, axis: Array) -> tuple[NDArray[np.intp], Array]:
    """Index of the grid point below and the share of the one above; values beyond the ends take the end's."""
    position = np.clip((at - axis[0]) / (axis[1] - axis[0]), 0.0, axis.size - 1.0)
    left = np.minimum(position.astype(np.intp), axis.size - 2)
    return left, position - left


@lru_cache(maxsize=4)
def transitions(config: CocultureConfig, grid: Grid = Grid()) -> Transitions:
    """Tabulate the model on a grid; kept for the last few configs."""
    from scipy.sparse import csr_array

    axes = grid.axes(config)
    t, m, x = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    state = np.stack([x, t, m], axis=-1)
    after = advance(config, state, config.targets()[:, None], config.control_min)  # (A, G, 3)
    index, weight = _corners(axes, after)
    rows = after.shape[0] * after.shape[1]
    pointers = np.arange(rows + 1) * 8
    matrix = csr_array((weight.ravel(), index.ravel(), pointers), shape=(rows, state.shape[0]))
    return Transitions(axes, share(after[..., 0]), matrix)


def sweep(model: Transitions, value: Array, setpoint: Array) -> Array:
    """V_k from V_{k+1}, both (G, B), for B programs whose setpoint is `setpoint`, shares (B,)."""
    actions, points = model.share.shape
    ahead = (model.matrix @ value).reshape(actions, points, -1)
    best = np.full(value.shape, np.inf)
    for reached, then in zip(model.share, ahead, strict=True):
        np.minimum(best, (reached[:, None] - setpoint) ** 2 + then, out=best)
    return best


def cost_to_go(model: Transitions, setpoints: Array) -> Array:
    """V_0 to V_K of programs, (K + 1, G, B). Args: setpoints: share in force during each decision, (K, B)."""
    steps, programs = setpoints.shape
    value = np.zeros((steps + 1, model.share.shape[1], programs))
    for k in range(steps - 1, -1, -1):
        value[k] = sweep(model, value[k + 1], setpoints[k])
    return value


def best_action(
    config: CocultureConfig,
    model: Transitions | None,
    value: Array | None,
    state: Array,
    setpoint: Array,
    errors: Array | None = None,
) -> NDArray[np.intp]:
    """Index of the action with the least cost of this decision and, given a value, of those after it.

    Args: state: (N, 3). setpoint: share in force, (N,). value: V after this decision, (G,) or one per state, (G, N);
      None: nothing after it counts, which is the myopic law. errors: of both growth curves, relative, (N, 2).
    """
    own = None if errors is None else errors[:, None, :]
    after = advance(config, state[:, None, :], config.targets(), config.control_min, own)  # (N, A, 3)
    cost = np.square(share(after[..., 0]) - np.asarray(setpoint)[:, None])
    if value is not None:
        assert model is not None
        cost = cost + model.value_at(value, after)
    return np.asarray(cost.argmin(axis=1), dtype=np.intp)
