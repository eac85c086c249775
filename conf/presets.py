"""The presets of conf/ as plain values, without Hydra."""

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
    """A preset that is not a file of conf/: its changes and a sentence that describes it."""

    values: dict[str, Any]
    what: str


_added: dict[str, Added] = {}
_placed: dict[str, Path] = {}  # command -> its file, if that is not in conf/


def add(name: str, values: Mapping[str, Any], what: str) -> None:
    """Add a preset for this process; replace an added preset of the same name.

    Args: name: group and option, "controller/mine"; values, what: as of `Added`.
    Raises: ValueError for an unknown group, or a preset that exists in conf/.
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
    """Config groups and their presets: {"env": ["sim"], ...}. Without Hydra's own groups."""
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
    """Return the comment at the top of a file of conf/, line by line."""
    lines = _file(name).read_text(encoding="utf-8").splitlines()
    first = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return [line[1:].removeprefix(" ") for line in lines[:first] if not line.startswith("# @")]


def sentence(name: str) -> str:
    """Describe a command or preset: the first sentence of the comment at the top of its file, without its name."""
    if name in _added:
        return _added[name].what
    first = " ".join(takewhile(str.strip, opening(name))).removeprefix(f"{name.rpartition('/')[2]}: ")
    return re.split(r"(?<=\.)\s(?=[A-Z`])", first)[0]


def place(path: Path) -> None:
    """Register the command of a file that is beside its module. Args: path: NAME.yaml of this source tree."""
    _placed[path.stem] = path


def _file(name: str) -> Path:
    return _placed.get(name, ROOT / f"{name}.yaml")


def program(command: str) -> str:
    """Return the module that `python -m` runs."""
    path = _placed.get(command)
    parts = ("experiments", command) if path is None else path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts)


def commands() -> list[str]:
    """List the commands that have a file in conf/."""
    return [path.stem for path in sorted(ROOT.glob("*.yaml")) if path.stem != "base"]


def chosen(command: str) -> dict[str, str | None]:
    """Map each group that a command composes under its own name to its initial option."""
    root = yaml.safe_load(_file(command).read_text(encoding="utf-8")) or {}
    entries = [entry for entry in root.get("defaults", []) if isinstance(entry, dict)]
    found = {group: option for entry in entries for group, option in entry.items() if "@" not in group}
    return found | {inner: None for group in found for inner in groups() if inner.startswith(f"{group}/")}


def owners(name: str) -> tuple[str, ...]:
    """Return the commands of a recipe (line `# @command NAME,NAME`), or () for a preset of any command.

    Args: name: group and option, "experiment/paper".
    """
    found = _directive(name, "command")
    return tuple(found.split(",")) if found else ()


def companion(name: str) -> str | None:
    """Return the preset of another group that belongs to this one, `agent=relative` (line `# @with ...`)."""
    return _directive(name, "with")


def _directive(name: str, word: str) -> str | None:
    path = ROOT / f"{name}.yaml"  # none of null, of an added preset, or of a file of the user's own
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    found = re.search(rf"^# @{word} (\S+)$", text, re.MULTILINE)
    return found[1] if found else None


def options(command: str, group: str) -> list[str]:
    """List the presets of a group that a command accepts."""
    return [option for option in groups()[group] if command in (owners(f"{group}/{option}") or (command,))]


def load(name: str) -> dict[str, Any]:
    """Load the changes of a preset, including those of the presets that it starts from.

    Args: name: group and option, "plant/bench".
    Raises: ValueError with the presets of the group.
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
