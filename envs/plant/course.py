"""Value that changes with age: linear interpolation between knots."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from conf.schema import require

Array = NDArray[np.float64]


def along(knots_min: Sequence[float], knots: Sequence[float], mean: float, age_min: Array) -> Array:
    """Return value / mean at each age, shape (N,): linear between knots, constant beyond them.

    Args: knots_min, knots: ages in min and values there; without knots the result is 1. mean: > 0 if there are knots.
      age_min: ages, min, shape (N,).
    """
    return np.interp(age_min, knots_min, knots) / mean if len(knots) else np.ones_like(age_min)


def check_knots(key: str, knots_min: Sequence[float], knots: Sequence[float]) -> None:
    """Check that ages rise and each age has a value. Args: key: config key of the values. Raises: ValueError."""
    fits = len(knots) == len(knots_min) and all(a < b for a, b in pairwise(knots_min))
    require(fits, key, knots, f"one value for each of knots_min = {list(knots_min)}, which must rise")
