"""Readers of two output files of `calibrate`: the growth model, and the plant that resembles a recording."""

from typing import TypeVar

from omegaconf import DictConfig

from envs.plant.plant import PlantConfig
from envs.task import EnvConfig
from experiments.cli import files, frame

T = TypeVar("T")


def read_env_file(path: str) -> EnvConfig:
    """Read the model of a calibrated.yaml. Raises: UserError with file and reason."""
    return _read("env_file", path, "calibrated.yaml", EnvConfig(), "env")


def read_plant_file(path: str) -> PlantConfig:
    """Read the plant of a twin.yaml. Raises: UserError with file and reason."""
    return _read("plant_file", path, "twin.yaml", PlantConfig(), "plant")


def _read(key: str, path: str, usual: str, default: T, prefix: str) -> T:
    """Return `default` with its values replaced by those of the file. Raises: UserError."""
    remedy = f"give the {usual} of a calibration run"
    try:
        content = files.load_yaml(path)
    except (OSError, ValueError) as error:
        raise frame.UserError(f"{key}={path}: {getattr(error, 'strerror', error)}; {remedy}") from None
    if not isinstance(content, DictConfig) or not content:
        raise frame.UserError(f"{key}={path}: the file has no key: value pairs; {remedy}")
    try:
        return frame.load(content, default, prefix)
    except frame.UserError as error:
        raise frame.UserError(f"{key}={path}: {error}; {remedy}") from None
