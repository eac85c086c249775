"""Extensions by a user: Python files by `extend=FILE.py`, presets by `group=FILE.yaml`.

A Python file registers its extensions (docs/extending.md) when it is loaded. The environment variable
`TURBIDOSTAT_EXTEND` lists the files for all processes. The run folder keeps copies, which `resume=RUN` loads.
"""

import importlib.util
import os
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from traceback import walk_tb

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from conf import guests, presets
from experiments.cli import files

VARIABLE, FOLDER = "TURBIDOSTAT_EXTEND", "extensions"
RECIPES = ("experiment", "hparams_search")  # groups whose presets are at the root of the config
_loaded: dict[Path, str] = {}  # file -> name of its module


def taken(argv: Sequence[str]) -> list[str]:
    """Load the files of `extend=FILE.py[,FILE.py]`, also in later processes; return the other arguments.

    Raises: ValueError with the file and its error.
    """
    given = [arg.removeprefix("extend=").split(",") for arg in argv if arg.startswith("extend=")]
    paths = [str(Path(name).expanduser().resolve()) for names in given for name in names if name]
    _remember(paths)
    load_all()
    return [arg for arg in argv if not arg.startswith("extend=")]


def _remember(paths: Sequence[str]) -> None:
    known = [p for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p]
    os.environ[VARIABLE] = os.pathsep.join(dict.fromkeys([*known, *paths]))


def load_all() -> None:
    """Load the guest packages, and the files in `TURBIDOSTAT_EXTEND` that are not loaded yet.

    Raises: ValueError with the file and its error.
    """
    guests.load("experiments")
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        _load(Path(name))


def _load(path: Path) -> None:
    if path in _loaded:
        return
    module = path.stem
    if path.suffix != ".py" or not path.is_file():
        raise ValueError(f"extend={path}: no such Python file; give the file that registers your extension")
    if not module.isidentifier() or module in sys.modules:
        raise ValueError(f"extend={path}: the module name {module} is invalid or in use; rename the file")
    spec = importlib.util.spec_from_file_location(module, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"extend={path}: not a Python file")
    sys.modules[module] = importlib.util.module_from_spec(spec)  # so that worker processes can unpickle its classes
    try:
        spec.loader.exec_module(sys.modules[module])
    except Exception as error:
        del sys.modules[module]
        line = _line_in(path, error)
        raise ValueError(f"extend={path}{line}: {type(error).__name__}: {error}; correct this file") from None
    _loaded[path] = module


def _line_in(path: Path, error: Exception) -> str:
    """Return the line number of an error in the file with a colon, ":12"; "" if unknown."""
    numbers = [error.lineno or 0] if isinstance(error, SyntaxError) else []
    numbers += [line for stack, line in walk_tb(error.__traceback__) if stack.f_code.co_filename == str(path)]
    return f":{numbers[-1]}" if numbers else ""


def preset_file(group: str, option: str) -> str:
    """Register `group=FILE.yaml` as a preset and return its name; return any other option as it is.

    Raises: ValueError with the file and its error.
    """
    if not option.endswith(".yaml"):
        return option
    path, name = Path(option).expanduser(), re.sub(r"\W", "_", Path(option).stem)
    try:
        content = files.load_yaml(path)
        if not isinstance(content, DictConfig):
            raise ValueError("the file has no keys and values")
        values = OmegaConf.to_container(content)
        assert isinstance(values, dict)
        known, what = presets.added().get(f"{group}/{name}"), f"The file {path.resolve()}."
        if known is not None and known.what != what:
            raise ValueError("two files have this name; rename one")
        presets.add(f"{group}/{name}", {str(k): v for k, v in values.items()}, what)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"{group}={option}: {why}; give a YAML file with values of {group}") from None
    return name


def offer() -> None:
    """Register the added presets with Hydra."""
    for name, preset in presets.added().items():
        group, _, option = name.rpartition("/")
        package = "_global_" if group in RECIPES else None
        ConfigStore.instance().store(name=option, group=group, node=preset.values, package=package)


def keep(folder: Path) -> None:
    """Copy the loaded files into a run folder."""
    for path in _loaded:
        target = folder / FOLDER / path.name
        target.parent.mkdir(exist_ok=True)
        if target.resolve() != path:
            shutil.copyfile(path, target)


def kept(folder: Path) -> None:
    """Load the extension files of a run folder, if any. Raises: ValueError with the file and its error."""
    names = set(_loaded.values())
    _remember([str(path.resolve()) for path in sorted((folder / FOLDER).glob("*.py")) if path.stem not in names])
    load_all()
