"""Names of keys and options that changed: whoever uses an old one is told the new one in a line."""

from __future__ import annotations

__all__ = ["REMOVED", "RENAMED"]

RENAMED: dict[str, str] = {  # old dotted key, or group=option, or key=choice -> the new one
    "plant.pump.guard_ml_s": "plant.pump.overflow_ml_s",
    "plant.vessel.guard_above_ml": "plant.vessel.overflow_above_ml",
}
REMOVED: dict[str, str] = {}  # old dotted key -> why, and what to use instead
