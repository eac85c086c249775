"""Names of keys and options that changed: whoever uses an old one is told the new one in a line."""

from __future__ import annotations

__all__ = ["REMOVED", "RENAMED"]

RENAMED: dict[str, str] = {  # old dotted key, or group=option, or key=choice -> the new one
    "backend.guard": "backend.overflow_pump",
    "backend.guard.duty": "backend.overflow_pump.duty",
    "backend.guard.flow_ml_s": "backend.overflow_pump.flow_ml_s",
    "backend.guard.pump": "backend.overflow_pump.pump",
    "guard": "overflow_pump",  # of the fault matrix
    "guard.duty": "overflow_pump.duty",
    "guard.flow_ml_s": "overflow_pump.flow_ml_s",
    "guard.pump": "overflow_pump.pump",
    "safety.responses.guard": "safety.responses.overflow_pump",
}
REMOVED: dict[str, str] = {}  # old dotted key -> why, and what to use instead
