"""Batched pure rewards."""

from __future__ import annotations

from typing import Any, TypeVar

__all__ = ["tracking_reward"]

T = TypeVar("T", bound=Any)


def tracking_reward(od: T, setpoint: T) -> T:
    """r = -(x - setpoint)^2 (paper, equation 4), of the OD reached by the step.

    Args:
      od: x, shape (N,) or any; a NumPy array or a tensor. setpoint: same type, same or broadcastable shape.
    Returns: shape of the broadcast. Raises: nothing.
    """
    error: T = od - setpoint
    reward: T = -error * error
    return reward
