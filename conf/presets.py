"""Presets of conf/ as plain values, read without Hydra."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from conf.messages import NameTaken, NotAllowed

ROOT = Path(str(resources.files("conf")))


@dataclass(frozen=True)
class Added:
    """Preset without a file in conf/. values: its changes to the config; what: a sentence that describes the preset."""

    values: dict[str, Any]
    what: str


_added: dict[str, Added] = {}
_placed: dict[str, Path] = {}  # command -> its YAML file, if this file is not in conf/


def add(name: str, values: Mapping[str, Any], what: str) -> None:
    """Add a preset for this process; replace an added preset of the same name.

    Args: name: group and option, "controller/mine"; values, what: as in `Added`.
    Raises: ValueError if the group is unknown or conf/ has a preset of this name.
    """
    group, _, option = name.rpartition("/")
    known = _files()
    if group not in known:
        raise ValueError(f"{group} = {option}: no such group; allowed {', '.join(known)}")
    if option in known[group]:
        raise NameTaken(what=f"preset {group} =", name=option)
    _added[name] = Added(dict(values), what)


def added() -> dict[str, Added]:
    """Return all added presets by group and option."""
    return dict(_added)


def groups() -> dict[str, list[str]]:
    """Return the config groups and their presets, {"env": ["sim"], ...}, without Hydra's own groups."""
    found = _files()
    for name in _added:
        group, _, option = name.rpartition("/")
        found[group].append(option)
    return found


def _files() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for path in sorted(ROOT.rglob("*.yaml")):
        group = path.parent.relative_to(ROOT).as_posix()
        if group != "." and not group.startswith("hydra"):
            found.setdefault(group, []).append(path.stem)
    return found


def opening(name: str) -> list[str]:
    """Return the lines of the comment at the top of a file of conf/, without its `# @` lines."""
    lines = _file(name).read_text(encoding="utf-8").splitlines()
    first = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return [line[1:].removeprefix(" ") for line in lines[:first] if not line.startswith("# @")]


def sentence(name: str) -> str:
    """Return the first sentence of the comment at the top of a command's or preset's file, without its name."""
    if name in _added:
        return _added[name].what
    first = " ".join(takewhile(str.strip, opening(name))).removeprefix(f"{name.rpartition('/')[2]}: ")
    return re.split(r"(?<=\.)\s(?=[A-Z`])", first)[0]


def place(path: Path) -> None:
    """Register a command whose config file NAME.yaml is beside its module, at `path`, and not in conf/."""
    _placed[path.stem] = path


def _file(name: str) -> Path:
    return _placed.get(name, ROOT / f"{name}.yaml")


def program(command: str) -> str:
    """Return the module that runs a command, for `python -m`."""
    path = _placed.get(command)
    parts = ("experiments", command) if path is None else path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts)


def commands() -> list[str]:
    """List the commands that have a file in conf/."""
    return [path.stem for path in sorted(ROOT.glob("*.yaml")) if path.stem != "base"]


def chosen(command: str) -> dict[str, str | None]:
    """Map each config group of a command to its default preset, and each group inside such a group to None."""
    root = yaml.safe_load(_file(command).read_text(encoding="utf-8")) or {}
    entries = [entry for entry in root.get("defaults", []) if isinstance(entry, dict)]
    found = {group: option for entry in entries for group, option in entry.items() if "@" not in group}
    return found | {inner: None for group in found for inner in groups() if inner.startswith(f"{group}/")}


def owners(name: str) -> tuple[str, ...]:
    """Return the commands that accept a preset (its line `# @command NAME,NAME`); () means every command.

    Args: name: group and option, "experiment/paper".
    """
    found = _directive(name, "command")
    return tuple(found.split(",")) if found else ()


def companion(name: str) -> str | None:
    """Return the preset of another group to use with this preset, `agent=relative` (its line `# @with ...`)."""
    return _directive(name, "with")


def _directive(name: str, word: str) -> str | None:
    path = ROOT / f"{name}.yaml"  # does not exist for null, an added preset or a user's file
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    found = re.search(rf"^# @{word} (\S+)$", text, re.MULTILINE)
    return found[1] if found else None


def options(command: str, group: str) -> list[str]:
    """List the presets of a group that a command accepts."""
    return [option for option in groups()[group] if command in (owners(f"{group}/{option}") or (command,))]


def load(name: str) -> dict[str, Any]:
    """Load the changes of a preset, including those of the presets in its `defaults`.

    Args: name: group and option, "plant/bench".
    Raises: ValueError that lists the presets of the group if the option is unknown.
    """
    group, _, option = name.rpartition("/")
    known = groups().get(group, [])
    if option not in known:
        raise NotAllowed(key=group, given=option, allowed=", ".join(known))
    text = None if name in _added else (ROOT / f"{name}.yaml").read_text(encoding="utf-8")
    own = dict(_added[name].values) if text is None else yaml.safe_load(text) or {}
    found: dict[str, Any] = {}
    for entry in own.pop("defaults", []):
        if isinstance(entry, Mapping):  # a group inside this one
            for inner, chosen in entry.items():
                _merge(found, {inner: load(f"{group}/{inner}/{chosen}")})
        elif entry != "_self_":
            _merge(found, load(f"{group}/{entry}"))
    _merge(found, own)
    return found


def _merge(into: dict[str, Any], values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value
