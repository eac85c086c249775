"""Exact convex polygons of the plane on which one action is best."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.certification.network import Array, Network, rounding

__all__ = ["Regions", "area", "partition"]

FLAT = 1e-12  # a value this close to zero is on the line; far below `rounding`


@dataclass(frozen=True, eq=False)
class Regions:
    """Convex polygons with the action of each.

    edges: from corner to corner, shape (E, 2, 2): [edge, end, coordinate]. owner: polygon of each edge, (E,).
    action: of each polygon, (P,).
    """

    edges: Array
    owner: NDArray[np.intp]
    action: NDArray[np.intp]

    @classmethod
    def of(cls, polygons: list[tuple[Array, int]]) -> "Regions":
        """Build from the corners (V, 2), in order, and the action of each polygon."""
        edges = [np.stack([corners, np.roll(corners, -1, axis=0)], axis=1) for corners, _ in polygons]
        sizes = [len(e) for e in edges]
        return cls(
            np.concatenate(edges), np.repeat(np.arange(len(sizes)), sizes), np.array([a for _, a in polygons], np.intp)
        )


def area(regions: Regions) -> Array:
    """Area of each polygon, (P,): half the sum over its edges of x0 y1 - x1 y0, from its first corner."""
    first = np.unique(regions.owner, return_index=True)[1]
    (x0, y0), (x1, y1) = np.moveaxis(regions.edges - regions.edges[first, :1][regions.owner], (1, 2), (0, 1))
    return np.abs(np.bincount(regions.owner, x0 * y1 - x1 * y0)) / 2.0


def _clip(rows: Array, value: Array) -> Array:
    """Cut a convex polygon to the part where a linear function is >= 0.

    Args: rows: corners in order, with other linear values beside them, (V, C). value: of the function at them, (V,).
    """
    value = np.where(np.abs(value) <= FLAT, 0.0, value)
    after, following = np.roll(value, -1), np.roll(rows, -1, axis=0)
    crossed = value * after < 0.0
    share = np.divide(value, value - after, out=np.zeros_like(value), where=crossed)
    both = np.stack([rows, rows + share[:, None] * (following - rows)], axis=1)
    return np.asarray(both[np.stack([value >= 0.0, crossed], axis=1)])


def _cells(rows: Array, layers: list[tuple[Array, Array]]) -> Iterator[Array]:
    """Split a polygon into cells on which all units keep their sign, with the last layer's inputs at their corners.

    Args: rows: corners, followed by the inputs of the first of `layers` there, (V, 2 + n).
    """
    if not layers:
        yield rows
        return
    weight, bias = layers[0]
    pending = [np.concatenate([rows[:, :2], rows[:, 2:] @ weight + bias], axis=1)]
    while pending:
        piece = pending.pop()
        units = piece[:, 2:]
        cut = np.flatnonzero((units.min(axis=0) < -FLAT) & (units.max(axis=0) > FLAT))
        if cut.size:
            value = units[:, cut[0]]
            pending += [half for half in (_clip(piece, value), _clip(piece, -value)) if len(half) > 2]
        else:
            yield from _cells(np.concatenate([piece[:, :2], np.maximum(units, 0.0)], axis=1), layers[1:])


def _best(corners: Array, q: Array, slack: Array) -> Iterator[tuple[Array, int]]:
    """Find where each action's Q is within the slack of every other's; a cell of linear Q splits into convex polygons.

    Args: corners (V, 2); q: at them, (V, A). slack: of each action's Q, (A,).
    """
    lead = q[:, :, None] - q[:, None, :] + (slack[:, None] + slack[None, :])
    low, high = lead.min(axis=0), lead.max(axis=0)
    for action in np.flatnonzero((high >= 0.0).all(axis=1)):
        rivals = np.flatnonzero(low[action] < 0.0)
        rows = np.concatenate([corners, lead[:, action, rivals]], axis=1)
        for k in range(rivals.size):
            rows = _clip(rows, rows[:, 2 + k])
            if len(rows) < 3:
                break
        else:
            yield rows[:, :2], int(action)


def partition(network: Network, box: tuple[tuple[float, float], tuple[float, float]]) -> tuple[Regions, Regions]:
    """Partition a rectangle of the plane by a policy, twice.

    Returns: the exact polygons of the argmax, which tile the rectangle; and wider ones that contain every point at
    which single precision may choose the action.
    Args: box: ((low, high) of the first coordinate, (low, high) of the second).
    """
    (x0, x1), (y0, y1) = box
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    weight, bias = network.output
    exact: list[tuple[Array, int]] = []
    wider: list[tuple[Array, int]] = []
    for rows in _cells(np.concatenate([corners, corners], axis=1), network.hidden):
        q = rows[:, 2:] @ weight + bias
        exact += _best(rows[:, :2], q, np.zeros(q.shape[1]))
        wider += _best(rows[:, :2], q, rounding(network, rows[:, :2]).max(axis=0))
    return Regions.of(exact), Regions.of(wider)
