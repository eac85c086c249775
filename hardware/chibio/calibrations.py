"""Bench calibrations of the reactors as YAML files, one per reactor and part: REACTOR_PART.yaml."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.errors import UnfitError
from hardware.storage import atomic
from hardware.storage.yaml_text import read_text

PARTS = ("feed", "waste", "blank")


def save_calibration(folder: Path, reactor: str, part: str, values: Mapping[str, Any]) -> Path:
    """Write FOLDER/REACTOR_PART.yaml (feed, waste, blank), whole or not at all; return its path. Raises: UnfitError."""
    path = folder / f"{reactor}_{part}.yaml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        atomic.write(path, yaml.safe_dump(dict(values), allow_unicode=True, sort_keys=False), fsync=False)
    except OSError as error:
        raise UnfitError(f"calibration {path}: {error.strerror or error}; give another folder") from None
    return path


def _read(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(read_text(path)) if path.is_file() else None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UnfitError(f"calibration {path}: not readable ({str(error).splitlines()[0]}); measure again") from None
    if content is None:  # no file, or an empty one
        return {}
    if not isinstance(content, dict):
        raise UnfitError(f"calibration {path}: no keys and values; measure again")
    return {str(k): v for k, v in content.items()}


def load_calibrations(folder: Path, reactors: Sequence[str]) -> list[ReactorCalibration]:
    """Load pump calibrations and blanks; without a file a pump is nominal and a blank nan. Raises: UnfitError."""
    calibrations = []
    for name in reactors:
        feed, waste, blank = (_read(folder / f"{name}_{part}.yaml") for part in PARTS)
        try:
            pumps = [PumpCalibration.from_dict(values) for values in (feed, waste)]
            counts = float(blank.get("blank", math.nan))
            if not math.isnan(counts) and not 3000.0 <= counts <= 60000.0:
                raise ValueError(f"blank = {counts}: allowed 3000 to 60000 counts")
        except (TypeError, ValueError) as error:
            raise UnfitError(f"calibration of {name} in {folder}: {error}; measure it again") from None
        calibrations.append(ReactorCalibration(pumps[0], pumps[1], counts))
    return calibrations
