"""The calibration folder: one YAML file per reactor and pump, and one per reactor's blank."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

from experiments.cli import frame
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.storage import atomic

__all__ = ["load_calibrations", "save"]

PARTS = ("feed", "waste", "blank")


def save(folder: Path, reactor: str, part: str, values: Mapping[str, Any]) -> Path:
    """Write FOLDER/REACTOR_PART.yaml, whole or not at all; returns its path.

    Args: part: feed, waste or blank. Raises: UserError if the folder cannot be written.
    """
    path = folder / f"{reactor}_{part}.yaml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        atomic.write(path, OmegaConf.to_yaml(OmegaConf.create(dict(values))), fsync=False)
    except OSError as error:
        raise frame.UserError(f"calibration {path}: {error.strerror or error}; give another folder") from None
    return path


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        raise frame.UserError(
            f"calibration {path}: not readable ({str(error).splitlines()[0]}); measure again"
        ) from None
    if not isinstance(content, dict):
        raise frame.UserError(f"calibration {path}: no keys and values; measure again")
    return {str(k): v for k, v in content.items()}


def load_calibrations(folder: Path, reactors: Sequence[str]) -> list[ReactorCalibration]:
    """Pumps and blanks of `reactors`; what was never measured is nominal, and its blank is nan (the device's own).

    Raises: UserError naming the file and what is wrong with it.
    """
    calibrations = []
    for name in reactors:
        feed, waste, blank = (_read(folder / f"{name}_{part}.yaml") for part in PARTS)
        try:
            pumps = [PumpCalibration.from_dict(values) for values in (feed, waste)]
            counts = float(blank.get("blank", math.nan))
            if not math.isnan(counts) and not 3000.0 <= counts <= 60000.0:
                raise ValueError(f"blank = {counts}: allowed 3000 to 60000 counts")
        except (TypeError, ValueError) as error:
            raise frame.UserError(f"calibration of {name} in {folder}: {error}") from None
        calibrations.append(ReactorCalibration(pumps[0], pumps[1], counts))
    return calibrations
