"""What happens to a plant beside its own terms: functions of one's own, called by name in every minute of its time."""

from collections.abc import Callable
from typing import Any

from conf.schema import require

__all__ = ["Disturbance", "add", "named"]

Disturbance = Callable[[Any], None]
"""Called with the `Plant`; sets fault switches of its parts, arrays of shape (N,), by `plant.age_min` or any state."""

_known: dict[str, Disturbance] = {}


def add(name: str, disturb: Disturbance) -> None:
    """Make a disturbance known as `plant.disturbances=[NAME]`. Raises: ValueError for a name that is taken or empty."""
    require(bool(name) and name not in _known, "disturbance", repr(name), "a name that is not taken")
    _known[name] = disturb


def named(name: str) -> Disturbance:
    """Find a disturbance by its name. Raises: ValueError naming those there are."""
    allowed = f"{', '.join(_known)}" if _known else "none; extend=FILE.py brings them (docs/extending.md)"
    require(name in _known, "plant.disturbances", name, allowed)
    return _known[name]
