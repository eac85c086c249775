"""A plant from a file, as `calibrate` writes one."""

from omegaconf import DictConfig

from envs.plant.plant import PlantConfig
from experiments.cli import files, frame

__all__ = ["read_plant_file"]


def read_plant_file(path: str) -> PlantConfig:
    """The plant of a twin.yaml; what the file does not say is at its default.

    Raises: UserError naming the file and what is wrong with it.
    """
    remedy = "give the twin.yaml of a calibration run"
    try:
        content = files.load_yaml(path)
    except (OSError, ValueError) as error:
        raise frame.UserError(f"plant_file={path}: {getattr(error, 'strerror', error)}; {remedy}") from None
    if not isinstance(content, DictConfig) or not content:
        raise frame.UserError(f"plant_file={path}: holds no key: value pairs; {remedy}")
    try:
        return frame.load(content, PlantConfig(), "plant")
    except frame.UserError as error:
        raise frame.UserError(f"plant_file={path}: {error}; {remedy}") from None
