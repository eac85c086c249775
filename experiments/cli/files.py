"""Atomic writer of JSON files, safe reader of YAML files, and reader of a run's command line."""

import io
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, ListConfig, OmegaConf

from hardware.storage import atomic
from hardware.storage.journal import plain as plain
from hardware.storage.yaml_text import problem, read_text


def load_yaml(path: Path | str) -> DictConfig | ListConfig:
    """Load a YAML file; refuse aliases and interpolations, because a few lines of them can expand to gigabytes.

    Raises: OSError; ValueError with a message of one line, also for a file that is too large or nested too deeply.
    """
    text = read_text(path)
    try:
        return OmegaConf.load(io.StringIO(text))
    except ValueError:
        raise
    except Exception as error:  # various errors of PyYAML and OmegaConf
        raise ValueError(f"not YAML ({problem(error)})") from None


def write_json(path: Path, content: Mapping[str, Any], fsync: bool = True, indent: int | None = 2) -> None:
    """Write a mapping as JSON, atomically."""
    atomic.write(path, json.dumps(plain(content), indent=indent) + "\n", fsync)


BLOCK = re.compile(r"^    choices:\n((?:      .*\n)+)", re.MULTILINE)


def given(folder: Path) -> list[str]:
    """List the `key=value` arguments of the command line that made a run folder; [] if unknown."""
    with suppress(OSError, ValueError, yaml.YAMLError):
        words = yaml.safe_load((folder / ".hydra" / "overrides.yaml").read_text(encoding="utf-8"))
        return [str(word).lstrip("+") for word in words] if isinstance(words, list) else []
    return []


def choices(folder: Path) -> dict[str, str]:
    """Return the preset of each group that a run folder's run had chosen, group -> preset; {} if unknown."""
    path = folder / ".hydra" / "hydra.yaml"
    block = BLOCK.search(path.read_text(encoding="utf-8")) if path.is_file() else None
    pairs = (line.strip().partition(": ") for line in (block[1].splitlines() if block else ()))
    return {key: value for key, _, value in pairs if value and value != "null" and not key.startswith("hydra/")}
