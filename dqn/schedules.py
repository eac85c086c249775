"""Schedules as pure functions of the step."""

from __future__ import annotations

__all__ = ["decayed", "linear"]


def linear(start: float, end: float, duration: int, step: int) -> float:
    """Falls (or rises) linearly from `start` at step 0 to `end` at step `duration` and stays there."""
    if step >= duration:
        return end
    return start + (end - start) * step / duration


def decayed(start: float, fraction: float, total: int, step: int) -> float:
    """`start`, falling linearly to zero over the last `fraction` of `total` steps."""
    decay = fraction * total
    remaining = total - step
    return start if decay <= 0.0 or remaining >= decay else start * max(0.0, remaining) / decay
