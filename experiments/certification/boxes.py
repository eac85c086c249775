"""Independent checks of the polygons of a policy: bounds over small rectangles, and intervals along lines."""

import numpy as np
from numpy.typing import NDArray

from experiments.certification.intervals import Index, Points
from experiments.certification.network import Array, Network, q_values, rounding
from experiments.certification.polygons import Regions, area

__all__ = ["contradictions", "on_lines", "possible"]


def possible(network: Network, low: Array, high: Array) -> NDArray[np.bool_]:
    """Find the actions that may be best in boxes with corners low, high (N, 2); shape (N, A).

    Each unit is an affine form, centre + slopes . (offset in the box) +- rest: a zonotope of two generators and a box.
    A relu that changes its sign on [l, u] becomes its chord's slope u / (u - l) with a rest of -l u / (2 (u - l)).
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
    """Count corners of polygons whose action the bound of their box excludes, over a grid of boxes on all polygons.

    Gaps or overlaps of the polygons count as one more.
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


def _knots(network: Network, low: float, high: float, second: float) -> tuple[Array, Array]:
    """Find the points of a line between which the network is linear, (K, 2), and Q at them, (K, A)."""
    points = np.array([[low, second], [high, second]])
    layers = network.hidden
    for depth in range(len(layers)):
        value = points
        for weight, bias in layers[:depth]:
            value = np.maximum(value @ weight + bias, 0.0)
        value = value @ layers[depth][0] + layers[depth][1]
        k, unit = np.nonzero(value[:-1] * value[1:] < 0.0)
        share = value[k, unit] / (value[k, unit] - value[k + 1, unit])
        x = np.unique(np.concatenate([points[:, 0], points[k, 0] + share * (points[k + 1, 0] - points[k, 0])]))
        points = np.stack([x, np.full_like(x, second)], axis=1)
    return points, q_values(network, points)


def _along(network: Network, low: float, high: float, second: float) -> tuple[Array, Index]:
    """Find intervals of the first coordinate, (P, 2), in which float32 may choose an action, and the action."""
    points, q = _knots(network, low, high, second)
    slack = rounding(network, points)
    slack = np.maximum(slack[:-1], slack[1:])
    lead = q[:, :, None] - q[:, None, :]
    wide = slack[:, :, None] + slack[:, None, :]
    start, end = lead[:-1] + wide, lead[1:] + wide  # (K - 1, A, A), linear in between
    cross = np.divide(start, start - end, out=np.zeros_like(start), where=start * end < 0.0)
    begins = np.where(start >= 0.0, 0.0, np.where(end >= 0.0, cross, 2.0)).max(axis=2)
    ends = np.where(end >= 0.0, 1.0, np.where(start >= 0.0, cross, -1.0)).min(axis=2)
    k, action = np.nonzero(begins <= ends)
    x, length = points[k, 0], np.diff(points[:, 0])[k]
    return np.stack([x + begins[k, action] * length, x + ends[k, action] * length], axis=1), action


def on_lines(network: Network, first: tuple[float, float], seconds: Array) -> tuple[Points, Index]:
    """Replace `partition` and `points_in_strips` for strips without width: lines of constant second coordinate (S,).

    Returns: the two ends of every interval, with its number as `polygon`; each interval's action.
    """
    found = [_along(network, *first, float(second)) for second in seconds]
    ends, action = (np.concatenate(parts) for parts in zip(*found, strict=True))
    strip = np.repeat(np.arange(len(found)), [2 * len(a) for _, a in found])
    return Points(np.repeat(np.arange(len(action)), 2), strip, ends.ravel(), seconds[strip]), action
