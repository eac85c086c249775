"""JSON as every command writes it: whole or not at all, plain values only."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hardware.storage import atomic

__all__ = ["plain", "write_json"]


def plain(value: Any) -> Any:
    """A value as JSON has it: arrays and tuples are lists, keys are text, numbers that are not finite are null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        if all(type(v) is float and math.isfinite(v) for v in value):
            return value
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, content: Mapping[str, Any], fsync: bool = True, indent: int | None = 2) -> None:
    """Write a mapping as JSON, atomically."""
    atomic.write(path, json.dumps(plain(content), indent=indent) + "\n", fsync)
