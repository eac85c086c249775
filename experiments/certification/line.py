"""A policy along a line of constant second coordinate.

    The same intervals as from polygons, by another way, in a
millisecond."""

import numpy as np

from experiments.certification.intervals import Index, Points
from experiments.certification.network import Array, Network, q_values, rounding

__all__ = ["on_lines"]


def _knots(network: Network, low: float, high: float, second: float) -> tuple[Array, Array]:
    """Points of the line between which the network is linear, (K, 2), and Q at them, (K, A)."""
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
    """Intervals of the first coordinate in which single precision may choose an action: [low, high], (P, 2); which."""
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

    Returns: the two ends of every interval, whose number stands as their `polygon`; each interval's action.
    """
    found = [_along(network, *first, float(second)) for second in seconds]
    ends, action = (np.concatenate(parts) for parts in zip(*found, strict=True))
    strip = np.repeat(np.arange(len(found)), [2 * len(a) for _, a in found])
    return Points(np.repeat(np.arange(len(action)), 2), strip, ends.ravel(), seconds[strip]), action
