"""What a calibration leaves for other commands, from its files: growth model, plant behind a recording, two species."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from omegaconf import DictConfig

from envs.coculture.pair import FILE, PairConfig, named_pair
from envs.coculture.task import SCALES, CocultureConfig
from envs.plant.plant import PlantConfig
from envs.task import EnvConfig
from experiments.cli import files, frame
from hardware.errors import RecordingError
from hardware.storage.journal import read_journal

__all__ = ["read_curves", "read_env_file", "read_pair", "read_plant_file"]

log = logging.getLogger(__name__)

T = TypeVar("T")


def read_env_file(path: str) -> EnvConfig:
    """Read the model of a calibrated.yaml. Raises: UserError naming the file and what is wrong with it."""
    return _read("env_file", path, "calibrated.yaml", EnvConfig(), "env")


def read_curves(run: str, env: CocultureConfig) -> CocultureConfig:
    """Build a task of two species on the growth curves that a run has found, and with its pair.

    Args: run: folder of a deployment with one reactor that holds a share, or RUN/recordings/NAME.csv of one of several.
    Raises: UserError naming what is missing.
    """
    path, wanted = Path(run), None
    if path.suffix == ".csv":
        path, wanted = path.resolve().parents[1], path.stem
    remedy = "give the folder of a deployment that held a share, or RUN/recordings/NAME.csv of one of its reactors"
    try:
        rows, _ = read_journal(path / "journal.jsonl")
        stored = files.load_yaml(path / "config.yaml")
    except (RecordingError, OSError, ValueError) as error:
        raise frame.UserError(f"env_file={run}: {error}; {remedy}") from None
    newest = {
        row["reactor"]: row["why"]
        for row in rows
        if row["kind"] == "decision" and row.get("why", {}).get("bias_e") is not None
    }
    if wanted is None and len(newest) > 1:
        each = ", ".join(str(path / "recordings" / f"{name}.csv") for name in newest)
        raise frame.UserError(f"env_file={run}: several reactors, each with curves of its own; give one of {each}")
    if not newest or wanted not in (None, *newest):
        raise frame.UserError(f"env_file={run}: it estimated no growth curves of two species; {remedy}")
    name, why = (wanted, newest[wanted]) if wanted else next(iter(newest.items()))
    scales = [float(np.clip(1.0 + why[key], *SCALES)) for key in ("bias_e", "bias_p")]
    known = [f"{scale:.3f} of the pair's" for scale in scales]
    log.info("growth curves of %s, %s: %s and %s", path, name, *known)
    own = stored.get("pair") if isinstance(stored, DictConfig) else None
    pair = read_pair(str(path) if (path / FILE).is_file() else str(own or "ecoli_pputida"))
    with frame.refusing(ValueError):
        return replace(env, pair=pair, scale_e=scales[0], scale_p=scales[1])


def read_plant_file(path: str) -> PlantConfig:
    """Read the plant of a twin.yaml. Raises: UserError naming the file and what is wrong with it."""
    return _read("plant_file", path, "twin.yaml", PlantConfig(), "plant")


def read_pair(name: str) -> PairConfig:
    """Read a pair of species: a preset of conf/strains, or the pair.yaml of a calibration.

    Raises: UserError naming the presets, or the file and what is wrong with it.
    """
    with frame.refusing(ValueError):
        return named_pair(name)


def _read(key: str, path: str, usual: str, default: T, prefix: str) -> T:
    """`default` with what the file says. Raises: UserError."""
    remedy = f"give the {usual} of a calibration run"
    try:
        content = files.load_yaml(path)
    except (OSError, ValueError) as error:
        raise frame.UserError(f"{key}={path}: {getattr(error, 'strerror', error)}; {remedy}") from None
    if not isinstance(content, DictConfig) or not content:
        raise frame.UserError(f"{key}={path}: holds no key: value pairs; {remedy}")
    try:
        return frame.load(content, default, prefix)
    except frame.UserError as error:
        raise frame.UserError(f"{key}={path}: {error}; {remedy}") from None
