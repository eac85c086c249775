"""The presets of conf/ as plain values, for readers that do without Hydra."""

import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

__all__ = ["chosen", "commands", "groups", "load", "options", "owner"]

ROOT = Path(str(resources.files("conf")))


def groups() -> dict[str, list[str]]:
    """Config groups and their presets: {"env": ["sim"], ...}. Hydra's own groups are not among them."""
    found: dict[str, list[str]] = {}
    for path in sorted(ROOT.rglob("*.yaml")):
        group = path.parent.relative_to(ROOT).as_posix()
        if group != "." and not group.startswith("hydra"):
            found.setdefault(group, []).append(path.stem)
    return found


def commands() -> list[str]:
    """Every command that is told by a file of conf/."""
    return [path.stem for path in sorted(ROOT.glob("*.yaml")) if path.stem != "base"]


def chosen(command: str) -> dict[str, str | None]:
    """The groups that a command composes, in the place they have by themselves, and the option each starts with."""
    root = yaml.safe_load((ROOT / f"{command}.yaml").read_text(encoding="utf-8")) or {}
    entries = [entry for entry in root.get("defaults", []) if isinstance(entry, dict)]
    found = {group: option for entry in entries for group, option in entry.items() if "@" not in group}
    return found | {inner: None for group in found for inner in groups() if inner.startswith(f"{group}/")}


def owner(name: str) -> str | None:
    """The command that a recipe is for, which a line `# @command NAME` says; None for a preset that serves any.

    Args: name: group and option, "experiment/paper".
    """
    found = re.search(r"^# @command (\w+)$", (ROOT / f"{name}.yaml").read_text(encoding="utf-8"), re.MULTILINE)
    return found[1] if found else None


def options(command: str, group: str) -> list[str]:
    """The presets of a group that a command accepts."""
    return [option for option in groups()[group] if owner(f"{group}/{option}") in (None, command)]


def load(name: str) -> dict[str, Any]:
    """What a preset changes, together with the presets of its group that it starts from.

    Args: name: group and option, "plant/bench".
    Raises: ValueError naming the presets of the group.
    """
    group, _, option = name.rpartition("/")
    known = groups().get(group, [])
    if option not in known:
        raise ValueError(f"{group} = {option}: allowed {', '.join(known)}")
    own = yaml.safe_load((ROOT / f"{name}.yaml").read_text(encoding="utf-8")) or {}
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
