"""Intervals of states: the states at which each action may be chosen, and the image of states after a control period.

The state is one number d per strip of setpoints, and an action shifts it: d' = d + shift(action). If several actions
are possible, the interval around all their images is used.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.certification.polygons import Array, Regions

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
States = Callable[[Array, Array], tuple[Array, Array]]

OUTWARD = 1e-12  # each image is enlarged by this on both sides, more than the rounding error
ENTERED = 1e-9  # a state this close to the limit of the images counts as inside
MAX_IMAGES = 10_000
SAME = 1e-12  # corners closer than this are merged


@dataclass(frozen=True, eq=False)
class Pieces:
    """Intervals of states, P per strip, each with an action that may be chosen there; low > high: empty.

    low, high: ends of the intervals, (N, P). action: index of the action, (N, P).
    """

    low: Array
    high: Array
    action: Index

    @classmethod
    def of(cls, strip: Index, action: Index, low: Array, high: Array, strips: int) -> "Pieces":
        """Build from a flat list of intervals: strip, action and ends of each."""
        order = np.argsort(strip, kind="stable")
        row = strip[order]
        column = np.arange(row.size) - np.searchsorted(row, row)
        shape = (strips, int(column.max()) + 1)
        made = cls(np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros(shape, np.intp))
        for target, source in ((made.low, low), (made.high, high), (made.action, action)):
            target[row, column] = source[order]
        return made

    def lowest(self, action: int) -> Array:
        """Return the lowest state in which `action` or a higher action may be chosen, (N,); inf if there is none."""
        return np.asarray(np.where(self.action >= action, self.low, np.inf).min(axis=1))


@dataclass(frozen=True, eq=False)
class Band:
    """Band that the closed loop enters and never leaves, for each strip, (N,).

    invariant: whether the first image of the start interval lies inside it. low, high: ends of the band, the limit of
    the images; nan if not invariant. path: start interval and images, (K + 1, N, 2). taken: periods from each to the
    next, (K, N); the ends move by equal steps in these periods.
    """

    invariant: Mask
    low: Array
    high: Array
    path: Array
    taken: Index

    def until(self, low: Array, high: Array) -> Array:
        """Return the periods until the state is in [low, high] from every start, (N,); inf if this is not proven."""
        beyond = np.stack([low - self.path[..., 0], self.path[..., 1] - high], axis=2)
        moved = beyond[:-1] - beyond[1:]
        share = np.divide(beyond[:-1], moved, out=np.sign(beyond[:-1]), where=moved > 0.0)
        outside = np.clip(np.ceil(share * self.taken[..., None]), 0, self.taken[..., None]).max(axis=2).sum(axis=0)
        return np.asarray(np.where((beyond[-1] <= 0.0).all(axis=1), outside, np.inf))

    @property
    def entered(self) -> Mask:
        """Whether the images of the start interval reach the band, (N,); False without a band."""
        return np.isfinite(self.until(self.low - ENTERED, self.high + ENTERED))

    @property
    def periods(self) -> Array:
        """Periods until the state is in the last image from every start, (N,)."""
        return self.until(*(self.path[-1] + ENTERED * np.array([-1.0, 1.0])).T)


def images(pieces: Pieces, shift: Array, start: Array) -> Band:
    """Iterate I -> F(I) from the start interval to the limit.

    F(I) is the smallest interval that contains, for every piece, the part of I in this piece shifted by its action. F
    is monotonic: if I is in J, F(I) is in F(J). So if F(start) is in the start interval, the images F^k(start) are
    nested, no state leaves them, and every state is in F^k(start) after k periods. An end of the interval that lies in
    unbounded pieces only moves by the same step each period; many such periods are taken at once.

    Args: shift: [low, high] that an action adds to the state, (N, A, 2). start: [low, high], (N, 2).
    """
    row = np.arange(len(start))[:, None]
    low, high = np.moveaxis(shift[row, pieces.action], -1, 0) + np.array([-OUTWARD, OUTWARD])[:, None, None]
    outer = np.stack([_outer(-pieces.high, -pieces.low, -low), _outer(pieces.low, pieces.high, high)], axis=2)
    reached: list[Array] = [start]
    taken: list[Index] = []
    active = np.arange(len(start))
    invariant = np.ones(len(start), dtype=bool)
    while active.size and len(taken) < MAX_IMAGES:
        now = reached[-1][active]
        first = np.maximum(pieces.low[active], now[:, :1])
        last = np.minimum(pieces.high[active], now[:, 1:])
        met = first <= last
        image = np.stack(
            [
                np.where(met, first + low[active], np.inf).min(axis=1),
                np.where(met, last + high[active], -np.inf).max(axis=1),
            ],
            axis=1,
        )
        inside = (image[:, 0] >= now[:, 0]) & (image[:, 1] <= now[:, 1])
        invariant[active] &= inside  # only the first image can be outside
        moved = np.abs(image - now) > ENTERED
        step, reach = outer[active].transpose(1, 0, 2)
        ahead = image * np.array([-1.0, 1.0]) - reach  # periods in which an end moves by the same step
        further = np.floor(np.divide(ahead, -step, out=np.zeros_like(step), where=(step < 0.0) & (ahead > 0.0)))
        further = np.where(moved, further, np.inf).min(axis=1)
        further = np.where(np.isfinite(further), further, 0.0)
        alike = np.where(moved, further[:, None] * step * np.array([-1.0, 1.0]), 0.0)
        for ends, periods in ((image, np.ones_like(further)), (image + alike, further)):
            following, lasted = reached[-1].copy(), np.zeros(len(start), np.intp)
            following[active[inside]], lasted[active] = ends[inside], periods
            reached.append(following)
            taken.append(lasted)
        active = active[inside & moved.any(axis=1)]
    limit = np.where(invariant[:, None], reached[-1], np.nan)
    return Band(invariant, limit[:, 0], limit[:, 1], np.stack(reached), np.stack(taken))


def _outer(low: Array, high: Array, shift: Array) -> Array:
    """Return, for the upper end in unbounded pieces, [its step per period, the lowest end with this step], (N, 2).

    Args: low, high: ends of the pieces; shift: largest shift of their actions; each (N, P).
    """
    endless = np.isposinf(high) & (low <= high)
    step = np.where(endless.any(axis=1), np.where(endless, shift, -np.inf).max(axis=1), 0.0)
    ended = ~endless & (low <= high)
    least = np.where(endless & np.isfinite(low), low, -np.inf).max(axis=1)
    least = np.maximum(least, np.where(ended, high, -np.inf).max(axis=1))
    others = np.where(ended, high + shift, -np.inf).max(axis=1)
    return np.stack([step, np.maximum(least, others - step) - step], axis=1)


def _spread(first: Index, last: Index) -> tuple[Index, Index]:
    """List every pair (k, j) with first[k] <= j < last[k]."""
    count = np.maximum(last - first, 0)
    k = np.repeat(np.arange(count.size), count)
    return k, np.arange(k.size) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)


@dataclass(frozen=True, eq=False)
class Points:
    """K points of polygons: index of the polygon, index of the strip or line, and coordinates x and y, each (K,)."""

    polygon: Index
    strip: Index
    x: Array
    y: Array

    def pieces(self, action: Index, states: States, strips: int) -> Pieces:
        """Return the interval of states of each polygon in each strip, from the smallest to the largest of its points.

        Args: action: action of each polygon. states: function (x, y) -> (smallest, largest) possible state, each (K,);
        over a convex polygon its extremes are at corners. strips: number of strips.
        """
        key = self.polygon * strips + self.strip
        order = np.argsort(key, kind="stable")
        found, at = np.unique(key[order], return_index=True)
        low, high = states(self.x[order], self.y[order])
        least, largest = np.minimum.reduceat(low, at), np.maximum.reduceat(high, at)
        return Pieces.of(found % strips, action[found // strips], least, largest, strips)


def crossings(regions: Regions, lines: Array) -> Points:
    """Return the points where edges of the polygons meet lines of constant second coordinate; `lines` must rise."""
    (x0, y0), (x1, y1) = np.moveaxis(regions.edges, (1, 2), (0, 1))
    first = np.searchsorted(lines, np.minimum(y0, y1), "left")
    edge, line = _spread(first, np.searchsorted(lines, np.maximum(y0, y1), "right"))
    rise = (y1 - y0)[edge]
    y = lines[line]
    share = np.divide(y - y0[edge], rise, out=np.zeros_like(rise), where=rise != 0.0)
    return Points(regions.owner[edge], line, x0[edge] + share * (x1 - x0)[edge], y)


def points_in_strips(regions: Regions, low: Array, high: Array) -> Points:
    """Cut every polygon to every strip low <= y <= high and return the corners; low, high: rising, (S,)."""
    corner = regions.edges[:, 0]
    first = np.searchsorted(high, corner[:, 1], "left")
    k, strip = _spread(first, np.searchsorted(low, corner[:, 1], "right"))
    parts = [Points(regions.owner[k], strip, corner[k, 0], corner[k, 1])]
    parts += [crossings(regions, lines) for lines in (low, high)]
    return Points(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("polygon", "strip", "x", "y")))


def drops(regions: Regions) -> list[tuple[float, float, int, int]]:
    """List where the action decreases as the first coordinate rises: (first, second coordinate, action, next action).

    The search is exact: between two neighbouring second coordinates of corners, all lines of constant second coordinate
    meet the same polygons in the same order, so one line is enough.
    """
    ordinates = np.unique(regions.edges[:, 0, 1])
    lines = ((ordinates[1:] + ordinates[:-1]) / 2.0)[np.diff(ordinates) > SAME]
    met = crossings(regions, lines)
    order = np.lexsort((met.x, met.polygon, met.strip))  # the two crossings of each polygon
    line, polygon, x = (a[order].reshape(-1, 2) for a in (met.strip, met.polygon, met.x))
    order = np.lexsort((x.sum(axis=1), line[:, 0]))
    line, action, left = line[order, 0], regions.action[polygon[order, 0]], x[order, 0]
    k = np.flatnonzero((line[1:] == line[:-1]) & (action[1:] < action[:-1]))
    pairs = np.stack([polygon[order, 0][k], polygon[order, 0][k + 1]], axis=1)
    k = k[np.unique(pairs, axis=0, return_index=True)[1]]
    return [
        (float(a), float(b), int(c), int(d))
        for a, b, c, d in zip(left[k + 1], lines[line[k]], action[k], action[k + 1], strict=True)
    ]
