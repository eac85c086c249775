"""JSON and CSV as every command writes them: whole or not at all."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hardware.storage import atomic

__all__ = ["plain", "write_csv", "write_json"]


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


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows under the keys of the first one, atomically."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    atomic.write(path, text.getvalue(), fsync=False)
