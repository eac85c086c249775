"""How a value changes with age: straight lines between knots."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["allowed", "along", "rises"]

Array = NDArray[np.float64]


def along(knots_min: Sequence[float], knots: Sequence[float], mean: float, age_min: Array) -> Array:
    """The value at each age over `mean`, shape (N,): linear between knots, the nearest knot's beyond them.

    Args: knots_min, knots: ages in min and values; none of them means a constant, 1. mean: > 0 where there are knots.
      age_min: min, shape (N,).
    """
    return np.interp(age_min, knots_min, knots) / mean if len(knots) else np.ones_like(age_min)


def rises(knots_min: Sequence[float]) -> bool:
    """Whether each age is greater than the one before."""
    return all(a < b for a, b in pairwise(knots_min))


def allowed(knots_min: Sequence[float]) -> str:
    """The rule in words, for a value beside these ages."""
    return f"one value for each of knots_min = {list(knots_min)}, which must rise"
