"""Exact convex polygons on which a policy prefers one action, and an independent check of these polygons.

The Q values of a policy are piecewise linear functions on the plane of its two inputs. They are computed in double
precision; a bound covers the errors of single precision."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dqn.policy import Policy

Array = NDArray[np.float64]

UNIT = 2.0**-24  # relative rounding error of one operation in single precision
SLACK = 1e-9  # tolerance of a Q value; larger than the rounding errors of the geometry in double precision
FLAT = 1e-12  # values this close to zero count as zero; far below `rounding`


@dataclass(frozen=True, eq=False)
class Network:
    """Network q = W_L relu(... relu(W_1 (M z + c) + b_1)) + b_L for points z of the plane.

    weights (in, out) and biases (out,): the first pair is M^T and c, without relu. The values are those of the file,
    but each hidden unit is scaled by a power of two to a size near 1, which is exact: `FLAT` is an absolute limit.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    @classmethod
    def of(cls, policy: Policy) -> "Network":
        weights = (policy.input_matrix.T, *policy.weights)
        biases = (policy.input_offset, *policy.biases)
        w, b = ([np.array(a, dtype=np.float64) for a in arrays] for arrays in (weights, biases))
        for k in range(1, len(w) - 1):
            size = np.maximum(np.abs(w[k]).max(axis=0), np.abs(b[k]))
            factor = np.exp2(-np.floor(np.log2(np.where(size > 0.0, size, 1.0))))
            w[k], b[k], w[k + 1] = w[k] * factor, b[k] * factor, w[k + 1] / factor[:, None]
        return cls(tuple(w), tuple(b))

    @property
    def hidden(self) -> list[tuple[Array, Array]]:
        """Layers with a relu, the first combined with the input map."""
        (m, *inner), (c, *offsets) = self.weights[:-1], self.biases[:-1]
        layers = list(zip(inner, offsets, strict=True))
        if layers:
            w, b = layers[0]
            layers[0] = (m @ w, c @ w + b)
        return layers

    @property
    def output(self) -> tuple[Array, Array]:
        """Last layer, combined with the input map if there is no hidden layer."""
        if len(self.weights) == 2:
            return self.weights[0] @ self.weights[1], self.biases[0] @ self.weights[1] + self.biases[1]
        return self.weights[-1], self.biases[-1]


def rounding(network: Network, points: Array) -> Array:
    """Return a bound on the error of Q in single precision at points (N, 2), shape (N, A).

    The error of a sum of n products, in any order, is at most g (|h| |W| + |b|) with g = (n + 1) u / (1 - (n + 1) u),
    u = 2^-24 (Higham 2002, Accuracy and Stability of Numerical Algorithms, chapter 3). A relu does not increase errors;
    an inactive unit passes only max(0, h + error). On a cell where the network is linear the bound is convex, so the
    largest value at the corners holds in the whole cell.
    """
    h, error = points, UNIT * np.abs(points)
    last = len(network.weights) - 1
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        size, n = np.abs(weight), weight.shape[0] + 1
        gamma = n * UNIT / (1.0 - n * UNIT)
        error = error @ size + gamma * ((np.abs(h) + error) @ size + np.abs(bias))
        h = h @ weight + bias
        if 0 < k < last:
            error = np.where(h > 0.0, error, np.maximum(h + error, 0.0))
            h = np.maximum(h, 0.0)
    return np.asarray(error) + SLACK


@dataclass(frozen=True, eq=False)
class Regions:
    """P convex polygons, each with an action.

    edges: edges of all polygons, shape (E, 2, 2): [edge, end, coordinate]. owner: polygon of each edge, (E,).
    action: action of each polygon, (P,).
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
    """Return the area of each polygon, (P,): half the sum over edges of x0 y1 - x1 y0, relative to the first corner."""
    first = np.unique(regions.owner, return_index=True)[1]
    (x0, y0), (x1, y1) = np.moveaxis(regions.edges - regions.edges[first, :1][regions.owner], (1, 2), (0, 1))
    return np.abs(np.bincount(regions.owner, x0 * y1 - x1 * y0)) / 2.0


def _clip(rows: Array, value: Array) -> Array:
    """Cut a convex polygon to the part where a linear function is >= 0.

    Args: rows: corners in order, each followed by values of other linear functions there, (V, C). value: values of the
    function at the corners, (V,).
    """
    value = np.where(np.abs(value) <= FLAT, 0.0, value)
    after, following = np.roll(value, -1), np.roll(rows, -1, axis=0)
    crossed = value * after < 0.0
    share = np.divide(value, value - after, out=np.zeros_like(value), where=crossed)
    both = np.stack([rows, rows + share[:, None] * (following - rows)], axis=1)
    return np.asarray(both[np.stack([value >= 0.0, crossed], axis=1)])


def _cells(rows: Array, layers: list[tuple[Array, Array]]) -> Iterator[Array]:
    """Split a polygon into cells on which all units keep their sign; yield corners with the last layer's inputs there.

    Args: rows: corners, each followed by the inputs of the first of `layers` there, (V, 2 + n).
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
    """Yield, in a cell with linear Q, the convex polygon on which each action may be best, up to the slack.

    Args: corners: (V, 2); q: Q at the corners, (V, A). slack: possible error of each action's Q, (A,).
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
    """Divide a rectangle of the plane into polygons of equal action, in two ways.

    Returns: the exact polygons of the argmax, which tile the rectangle; and larger polygons, which contain every point
    at which the action may be chosen in single precision.
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


def possible(network: Network, low: Array, high: Array) -> NDArray[np.bool_]:
    """Return which actions may be best anywhere in boxes with corners low, high (N, 2); shape (N, A).

    Each unit is bounded by an affine form, centre + slopes . (offset in the box) +- rest (a zonotope). A relu whose
    input changes sign in [l, u] becomes a line of slope u / (u - l) with an error of up to -l u / (2 (u - l)).
    """
    centre, slopes, rest = (low + high) / 2.0, np.eye(2) * ((high - low) / 2.0)[:, None, :], np.zeros_like(low)
    for weight, bias in network.hidden:
        centre, slopes, rest = centre @ weight + bias, slopes @ weight, rest @ np.abs(weight)
        reach = np.abs(slopes).sum(axis=1) + rest
        l, u = centre - reach, centre + reach  # noqa: E741
        mixed = (l < 0.0) & (u > 0.0)
        slope = np.where(mixed, u / np.where(mixed, u - l, 1.0), (l >= 0.0).astype(np.float64))
        half = np.where(mixed, -slope * l / 2.0, 0.0)
        centre, slopes, rest = slope * centre + half, slope[:, None, :] * slopes, slope * rest + half
    weight, bias = network.output
    margin = weight[:, :, None] - weight[:, None, :]
    off = np.abs(np.einsum("nkh,hab->nkab", slopes, margin)).sum(axis=1)
    off += np.einsum("nh,hab->nab", rest, np.abs(margin))
    lead = np.einsum("nh,hab->nab", centre, margin) + (bias[:, None] - bias[None, :])
    return np.asarray((lead + off >= 0.0).all(axis=2))


def contradictions(network: Network, regions: Regions, grid: tuple[int, int]) -> int:
    """Count the corners of polygons at which `possible` excludes the polygon's action, for boxes of a grid.

    If the polygons do not tile the rectangle exactly, the count is one higher.
    """
    corner = regions.edges[:, 0]
    low, high = corner.min(axis=0), corner.max(axis=0)
    size = (high - low) / np.array(grid)
    cell = np.clip(((corner - low) / size).astype(np.intp), 0, np.array(grid) - 1)
    found, at = np.unique(cell, axis=0, return_inverse=True)
    allowed = np.concatenate(
        [
            possible(network, low + part * size - 1e-9, low + (part + 1) * size + 1e-9)
            for part in np.array_split(found, max(1, len(found) // 64))
        ]
    )
    excluded = int((~allowed[at.reshape(-1), regions.action[regions.owner]]).sum())
    return excluded + int(abs(float(area(regions).sum()) - float(np.prod(high - low))) > 1e-9)
