"""Optimal composition controllers for any known sequence of setpoints, by dynamic programming.

State: logit x of the share, temperature T, lagged growth rate m. The cost-to-go V is stored on a grid of these three
and is linear within each cell. The effect of an action on the whole grid is one sparse matrix. Backward induction
(Bellman 1957) over the remaining decisions:

  V_k = min_a [(r'_a - s_k)^2 + V_{k+1}(x'_a, T'_a, m'_a)],     V_K = 0

with s_k the setpoint during decision k. The greedy action uses the exact model for one decision and V after it.
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
    """Numbers of grid points in logit share x, temperature and lagged rate. logit_span: largest |x|."""

    logits: int = 161
    temperatures: int = 15
    rates: int = 9
    logit_span: float = 6.0

    def axes(self, config: CocultureConfig) -> tuple[Array, Array, Array]:
        """Return the grid points of T, m and x, in the order of the axes of V."""
        rate = config.scale_p * config.pair.rates(np.linspace(*config.span, 71))[:, 1]
        return (
            np.linspace(config.span[0], config.pair.temperatures[1], self.temperatures),
            np.linspace(rate.min(), rate.max(), self.rates),
            np.linspace(-self.logit_span, self.logit_span, self.logits),
        )


@dataclass(frozen=True, eq=False)
class Transitions:
    """Effect of every action at every grid point; G grid points, A actions.

    axes: points of T, m, x. share: r' after the decision, (A, G). matrix: V on the grid -> V after actions, (A G, G).
    """

    axes: tuple[Array, Array, Array]
    share: Array
    matrix: "csr_array"

    def value_at(self, value: Array, state: Array) -> Array:
        """Interpolate V at states (N, A, 3); value: V of one program, (G,), or of one program per state, (G, N)."""
        index, weight = _corners(self.axes, state)
        if value.ndim == 1:
            return np.asarray((value[index] * weight).sum(axis=-1))
        own = np.arange(value.shape[1])[:, None, None]
        return np.asarray((value[index, own] * weight).sum(axis=-1))


def _corners(axes: tuple[Array, Array, Array], state: Array) -> tuple[NDArray[np.int32], Array]:
    """Return the eight grid points around each state (..., 3), and their weights, (..., 8) each."""
    cells = [_cell(state[..., k], axis) for k, axis in zip((1, 2, 0), axes, strict=True)]
    index, weight = np.empty((*state.shape[:-1], 8), dtype=np.int32), np.empty((*state.shape[:-1], 8))
    for corner in range(8):
        bits = [(corner >> k) & 1 for k in range(3)]
        points = [c[0] + b for c, b in zip(cells, bits, strict=True)]
        index[..., corner] = np.ravel_multi_index(points, [axis.size for axis in axes])
        weight[..., corner] = np.prod([c[1] if b else 1.0 - c[1] for c, b in zip(cells, bits, strict=True)], axis=0)
    return index, weight


def _cell(at: Array, axis: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the index of the point below and the weight of the point above; values are clipped to the axis."""
    position = np.clip((at - axis[0]) / (axis[1] - axis[0]), 0.0, axis.size - 1.0)
    left = np.minimum(position.astype(np.intp), axis.size - 2)
    return left, position - left


@lru_cache(maxsize=4)
def transitions(config: CocultureConfig, grid: Grid = Grid()) -> Transitions:
    """Tabulate the model on a grid; the tables of the last four configs are cached."""
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
    """Compute V_k from V_{k+1}, both (G, B), for B programs with the setpoints s_k = `setpoint`, shares, (B,)."""
    actions, points = model.share.shape
    ahead = (model.matrix @ value).reshape(actions, points, -1)
    best = np.full(value.shape, np.inf)
    for reached, then in zip(model.share, ahead, strict=True):
        np.minimum(best, (reached[:, None] - setpoint) ** 2 + then, out=best)
    return best


def cost_to_go(model: Transitions, setpoints: Array) -> Array:
    """Compute V_0 to V_K of B programs, (K + 1, G, B). Args: setpoints: share during each decision, (K, B)."""
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
    """Return the index of the action with the smallest cost: squared error after this decision plus `value`, (N,).

    Args: state: (N, 3). setpoint: present setpoint, a share, (N,). value: V after this decision, (G,), or one per
      state, (G, N); None: 0, the myopic controller. errors: relative errors of both growth curves, (N, 2).
    """
    own = None if errors is None else errors[:, None, :]
    after = advance(config, state[:, None, :], config.targets(), config.control_min, own)  # (N, A, 3)
    cost = np.square(share(after[..., 0]) - np.asarray(setpoint)[:, None])
    if value is not None:
        assert model is not None
        cost = cost + model.value_at(value, after)
    return np.asarray(cost.argmin(axis=1), dtype=np.intp)
