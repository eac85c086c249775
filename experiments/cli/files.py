"""JSON and CSV as every command writes them, whole or not at all, and YAML as every command reads it."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from hardware.storage import atomic
from hardware.storage.yaml_text import read_text

__all__ = ["load_yaml", "plain", "write_csv", "write_json"]


def load_yaml(path: Path | str) -> DictConfig | ListConfig:
    """Load a YAML file without aliases and interpolations: a few lines of those can stand for gigabytes.

    Raises: OSError; ValueError, in one line, also for a file that is too large or too deep.
    """
    text = read_text(path)
    try:
        return OmegaConf.load(io.StringIO(text))
    except ValueError:
        raise
    except Exception as error:  # whatever PyYAML and OmegaConf meet
        raise ValueError(f"not YAML ({str(error).splitlines()[0]})") from None


def plain(value: Any) -> Any:
    """Convert a value to JSON's types: arrays and tuples to lists, keys to text, non-finite numbers to null."""
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
