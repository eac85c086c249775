"""Which actions a policy may choose anywhere in a small rectangle, by bounds that know nothing of polygons."""

import numpy as np
from numpy.typing import NDArray

from experiments.certification.network import Array, Network
from experiments.certification.polygons import Regions, area

__all__ = ["contradictions", "possible"]


def possible(network: Network, low: Array, high: Array) -> NDArray[np.bool_]:
    """Actions that may be best in boxes with corners low, high (N, 2); shape (N, A).

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
    """Corners of polygons whose action the bound of their box excludes, over a grid of boxes that covers all polygons.

    Also counted: polygons that leave a part of the rectangle out, or overlap, as one.
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
