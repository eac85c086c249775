"""Batched pure rewards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["tracking_reward"]


def tracking_reward(od: NDArray[np.float64], setpoint: NDArray[np.float64]) -> NDArray[np.float64]:
    """r = -(x - setpoint)^2 (paper, equation 4), of the OD reached by the step.

    Args:
      od: x, shape (N,) or any; setpoint: same shape or broadcastable.
    Returns: shape of the broadcast. Raises: nothing.
    """
    error = od - setpoint
    return -error * error
