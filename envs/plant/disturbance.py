"""Disturbances of a plant: functions of the user, selected by name and called in every simulated minute."""

from collections.abc import Callable
from typing import Any

from conf.schema import require

Disturbance = Callable[[Any], None]
"""Function of the `Plant`. It sets fault switches of its parts, arrays (N,), e.g. as a function of `plant.age_min`."""

_known: dict[str, Disturbance] = {}


def add(name: str, disturb: Disturbance) -> None:
    """Register a disturbance for `plant.disturbances=[NAME]`. Raises: ValueError for a used or empty name."""
    require(bool(name) and name not in _known, "disturbance", repr(name), "a new name")
    _known[name] = disturb


def named(name: str) -> Disturbance:
    """Return a disturbance by its name. Raises: ValueError with the known names."""
    allowed = f"{', '.join(_known)}" if _known else "none; add some with extend=FILE.py (docs/extending.md)"
    require(name in _known, "plant.disturbances", name, allowed)
    return _known[name]
