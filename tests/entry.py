"""Commands beside the tests, `python -m tests.campaigns.NAME`, with all that a command of the program has."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import yaml  # type: ignore[import-untyped]
from hydra.core.config_store import ConfigStore

from conf import presets
from experiments.cli import frame

__all__ = ["command"]

T = TypeVar("T")


def command(module: str, schema: T, body: Callable[[T, Path], float | None], resumes: str = "") -> frame.EntryPoint[T]:
    """The command of a module: `NAME.yaml` beside it has its usage and choices, as conf/NAME.yaml of the program's.

    Args: module: its file. schema, body, resumes: as of `EntryPoint`.
    """
    path = Path(module).with_suffix(".yaml")
    presets.place(path)
    ConfigStore.instance().store(path.stem, yaml.safe_load(path.read_text(encoding="utf-8")))
    return frame.EntryPoint(path.stem, schema, body, resumes=resumes)
