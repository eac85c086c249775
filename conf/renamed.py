"""Names of keys and options that changed: whoever uses an old one is told the new one in a line."""

from __future__ import annotations

__all__ = ["REMOVED", "RENAMED"]

RENAMED: dict[str, str] = {}  # old dotted key, or group=option, or key=choice -> the new one
REMOVED: dict[str, str] = {}  # old dotted key -> why, and what to use instead
