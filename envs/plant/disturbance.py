"""Disturbances of a plant: your own functions, selected by name and called in every simulated minute."""

from collections.abc import Callable
from typing import Any

from conf.schema import require

Disturbance = Callable[[Any], None]
"""Called with the `Plant`; sets fault switches of its parts, arrays of shape (N,), by `plant.age_min` or any state."""

_known: dict[str, Disturbance] = {}


def add(name: str, disturb: Disturbance) -> None:
    """Register a disturbance as `plant.disturbances=[NAME]`. Raises: ValueError for a used or empty name."""
    require(bool(name) and name not in _known, "disturbance", repr(name), "a name that is not taken")
    _known[name] = disturb


def named(name: str) -> Disturbance:
    """Return a disturbance by its name. Raises: ValueError with the known names."""
    allowed = f"{', '.join(_known)}" if _known else "none; extend=FILE.py brings them (docs/extending.md)"
    require(name in _known, "plant.disturbances", name, allowed)
    return _known[name]
