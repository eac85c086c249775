"""Keys of earlier versions: what they are called now, or why they are gone."""

from __future__ import annotations

__all__ = ["REMOVED", "RENAMED"]

RENAMED: dict[str, str] = {
    "controller=inverse": "controller=adaptive_inverse",
    "controller_kind=inverse": "controller_kind=adaptive_inverse",
    "controllers.inverse": "controllers.adaptive_inverse",
}
"""Old key or choice -> new one."""

REMOVED: dict[str, str] = {}
"""Old key -> why, and what instead."""
