"""The file in which a calibration leaves a growth model: read by training and by control."""

from __future__ import annotations

from omegaconf import DictConfig, OmegaConf

from envs.task import EnvConfig
from experiments.cli import frame

__all__ = ["read_env_file"]


def read_env_file(path: str) -> EnvConfig:
    """The model a calibration wrote. Raises: UserError naming the file and what is wrong with it."""
    remedy = "give the calibrated.yaml of a calibration run"
    try:
        content = OmegaConf.load(path)
    except OSError as error:
        raise frame.UserError(f"env_file={path}: {error.strerror}; {remedy}") from None
    except Exception as error:  # whatever PyYAML's parser meets, and text that is no UTF-8
        raise frame.UserError(f"env_file={path}: not YAML ({str(error).splitlines()[0]}); {remedy}") from None
    if not isinstance(content, DictConfig):
        raise frame.UserError(f"env_file={path}: holds no key: value pairs; {remedy}")
    try:
        return frame.load(content, EnvConfig())
    except frame.UserError as error:
        raise frame.UserError(f"env_file={path}: {error}") from None
