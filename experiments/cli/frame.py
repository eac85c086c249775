"""The frame of every entry point: command line -> Hydra -> checked dataclass -> run folder.

Hydra composes plain YAML; the dataclass of the entry point is the schema. Whatever does not fit it (unknown key,
wrong type, value out of range, misspelt option) ends as one line on standard error, before a run folder exists.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

from hardware.storage import atomic

__all__ = ["UserError", "compose", "load", "normalise", "run", "save_config", "write_json"]

T = TypeVar("T")
log = logging.getLogger(__name__)
logging.getLogger("httpx").setLevel(logging.WARNING)  # it tells of every request; journal and summary do that better

OmegaConf.register_new_resolver("pid", os.getpid)  # makes run folders of processes started in one second differ


class UserError(Exception):
    """Something the user can mend; the message is one line and is all that is shown."""


def groups() -> dict[str, list[str]]:
    """Config groups and their options, read from the package `conf`: {"env": ["sim", ...], ...}."""
    found: dict[str, list[str]] = {}
    root = Path(str(resources.files("conf")))
    for path in sorted(root.rglob("*.yaml")):
        group = path.parent.relative_to(root).as_posix()
        if group != ".":
            found.setdefault(group, []).append(path.stem)
    return found


def normalise(argv: Sequence[str]) -> list[str]:
    """Make `+group=option` mean `group=option` for the known groups, and let `resume=RUN` write into RUN.

    Hydra takes only one of the two forms, depending on whether the group has a default; here both work.
    Raises: UserError for an option that does not exist, naming those that do.
    """
    known = groups()
    out: list[str] = []
    for arg in argv:
        match = re.match(r"^\+?([\w/]+)=(.*)$", arg)
        if match and match[1] in known:
            arg = f"{match[1]}={match[2]}"
            for option in match[2].split(","):
                if re.fullmatch(r"[\w./-]+", option) and option != "null" and option not in known[match[1]]:
                    raise UserError(f"{match[1]}={option}: no such option; allowed: {', '.join(known[match[1]])}")
        out.append(arg)
    resumed = [a.removeprefix("resume=") for a in out if a.startswith("resume=") and a != "resume=null"]
    if resumed:
        if not (Path(resumed[-1]) / "config.yaml").is_file():
            raise UserError(f"resume={resumed[-1]}: no run folder (it holds no config.yaml); give the folder of a run")
        out += [f"hydra.run.dir={resumed[-1]}", "hydra.output_subdir=null"]
    return out


TYPES = {"Float": "a number", "Integer": "a whole number", "bool": "true or false"}


def _one_line(error: Exception) -> str:
    """A Hydra or OmegaConf message as one line; a wrong type as `key = value: allowed ...`."""
    wrong = re.match(r"Value '(.*)' (?:of type '\w+' could not be converted to|is not a valid) (\w+)", str(error))
    if wrong and isinstance(error, OmegaConfBaseException):
        return f"{error.full_key} = {wrong[1]}: allowed {TYPES.get(wrong[2], wrong[2])}"
    lines = [line.strip() for line in str(error).splitlines()]
    kept = [s for s in lines if s and not s.startswith(("object_type", "reference_type", "Config search path"))]
    return " ".join(kept[:6])


def _unlock(node: DictConfig) -> None:
    """Frozen dataclasses become read-only nodes; the schema must take the composed values first."""
    OmegaConf.set_readonly(node, False)
    for key in node:
        if not OmegaConf.is_missing(node, key) and isinstance(node[key], DictConfig):
            _unlock(node[key])


def _unknown(values: Any, schema: Any, prefix: str = "") -> str | None:
    """The message for the first key of a plain dict that the dataclass does not have, with the keys it has."""
    if not (isinstance(values, dict) and is_dataclass(schema)):
        return None
    allowed = [f.name for f in fields(schema)]
    for key, value in values.items():
        if key not in allowed:
            where = f"under {prefix.rstrip('.')}" if prefix else "here"
            return f"{prefix}{key}: no such key; allowed {where}: {', '.join(allowed)}"
        message = _unknown(value, getattr(schema, key, None), f"{prefix}{key}.")
        if message:
            return message
    return None


def load(cfg: DictConfig, schema: T) -> T:
    """Turn a composed config into the checked dataclass.

    Args:
      cfg: composed values, no interpolation left unresolved.
      schema: an instance with the defaults; a nested dataclass checks its ranges in `__post_init__`.
    Raises: UserError naming key, value and what is allowed.
    """
    message = _unknown(OmegaConf.to_container(cfg, resolve=False), schema)
    if message:
        raise UserError(message)
    try:
        node = OmegaConf.structured(schema)
        _unlock(node)
        loaded: T = OmegaConf.to_object(OmegaConf.merge(node, cfg))  # type: ignore[assignment]
    except (OmegaConfBaseException, ValueError) as error:
        raise UserError(_one_line(error)) from None
    return loaded


def compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose `conf/<name>.yaml` with command-line overrides, as the entry point would.

    Raises: UserError with Hydra's message on one line.
    """
    try:
        GlobalHydra.instance().clear()
        with hydra.initialize_config_module("conf", version_base="1.3"):
            plain = [a for a in normalise(overrides) if not a.startswith("hydra.")]
            known = groups()  # any other key is forced in, so that an unknown one is named by the schema, not by Hydra
            forced = [a if re.split("[@=]", a)[0] in known else re.sub(r"^\+*(?=\w)", "++", a) for a in plain]
            return hydra.compose(name, overrides=forced)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # Hydra's own checks of a group's name
        raise UserError(_one_line(error)) from None


def _needs_check(argv: Sequence[str]) -> bool:
    """A sweep or a Hydra flag (--help, --cfg job, -m) is Hydra's to read; a plain run is checked beforehand."""
    return not any(a.startswith("-") for a in argv)


def save_config(config: Any, folder: Path) -> None:
    """Write the checked config as `config.yaml`: what `resume=` and `--config-name` read back."""
    OmegaConf.save(OmegaConf.create(asdict(config)), folder / "config.yaml")


def write_json(path: Path, content: Mapping[str, Any], fsync: bool = True, indent: int | None = 2) -> None:
    """Write JSON atomically: nobody ever reads half a file. Non-finite numbers become null."""

    def clean(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(k): clean(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            if all(type(v) is float and v - v == 0.0 for v in value):
                return value
            return [clean(v) for v in value]
        if hasattr(value, "tolist"):
            return clean(value.tolist())
        if isinstance(value, float) and not (value == value and abs(value) != float("inf")):
            return None
        return value

    atomic.write(path, json.dumps(clean(content), indent=indent) + "\n", fsync)


def _stored(path: Path, resume: str, fitting: Callable[[DictConfig], T]) -> T:
    """The config a run was started with. Raises: UserError naming the file and what is wrong with it."""
    try:
        stored = OmegaConf.load(path)
        if not isinstance(stored, DictConfig):
            raise UserError("it holds no keys and values")
        stored.resume = resume
        return load(stored, fitting(stored))
    except (UserError, OSError, ValueError, AttributeError, YAMLError, OmegaConfBaseException) as error:
        why = _one_line(error) or type(error).__name__
        remedy = "put it back as the run wrote it, or start a new run"
        raise UserError(f"{path}: not the config of this run ({why}); {remedy}") from None


def run(
    name: str,
    schema: T,
    body: Callable[[T, Path], float | None],
    choose: Callable[[DictConfig], T] | None = None,
) -> None:
    """Run an entry point; its resolved config is in `config.yaml` of its run folder before `body` starts.

    Args:
      name: of `conf/<name>.yaml` and of the job.
      schema: default instance of the entry point's config dataclass; a field `resume` makes it resumable.
      choose: gives the schema that fits a composed config, where it depends on one (a backend has fields of its own).
      body: called with the checked config and the run folder; a float it returns is the sweep's objective.
    Exits: 0, or 1 after one line on standard error; 130 on Ctrl-C.
    """

    def fitting(cfg: DictConfig) -> T:
        return schema if choose is None else choose(cfg)

    def task(cfg: DictConfig) -> float | None:
        try:
            folder = Path(os.path.relpath(HydraConfig.get().runtime.output_dir))
            if cfg.get("resume"):
                config = _stored(folder / "config.yaml", str(cfg.resume), fitting)
            else:
                config = load(cfg, fitting(cfg))
                save_config(config, folder)
            return body(config, folder)
        except UserError as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # the launcher finishes the other jobs first
            print(f"error: {error}", file=sys.stderr)
            sys.exit(1)

    try:
        sys.argv[1:] = normalise(sys.argv[1:])
        if _needs_check(sys.argv[1:]):
            composed = compose(name, sys.argv[1:])
            load(composed, fitting(composed))
            resumed = [a for a in sys.argv[1:] if a.startswith("resume=") and a != "resume=null"]
            others = [a for a in sys.argv[1:] if not a.startswith(("resume=", "hydra."))]
            if resumed and others:
                raise UserError(
                    f"{others[0]}: a resumed run takes every value from {resumed[-1][7:]}/config.yaml; drop it"
                )
        GlobalHydra.instance().clear()
        hydra.main(version_base="1.3", config_path="pkg://conf", config_name=name)(task)()
    except (UserError, ValueError) as error:  # a ValueError is the schema's own word on a value
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("stopped by Ctrl-C", file=sys.stderr)
        sys.exit(130)
