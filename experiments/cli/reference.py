"""Generator of docs/configuration.md from the fields of every config and the presets of conf/.

python -m experiments.cli.reference > docs/configuration.md
"""

import importlib
import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any, cast, get_args, get_type_hints

import yaml  # type: ignore[import-untyped]

from conf.presets import ROOT, chosen, commands, groups, owners, sentence
from conf.schema import Entry, entries
from experiments.cli import extensions
from experiments.cli.frame import EntryPoint
from experiments.cli.help_page import shown
from experiments.reporting.page import flat

ELSEWHERE = ("env", "agent")  # kinds that docs/extending.md describes
SHORT = 3  # most values of a preset on the page; for a longer preset the page names the file
SINGULAR = {"studies": "study"}  # for other names remove the s
HEAD = """# Configuration

This page is generated from the fields of the config dataclasses and the presets of `conf/`, and a test compares it with
them. After a change:

    python -m experiments.cli.reference > docs/configuration.md

A value is set by `key=value` and a preset is chosen by `group=preset`, in any order, after
`python -m experiments.NAME`. `--help` prints a command's keys with the values that the other arguments set.
`--cfg job` prints the resolved config, which every run keeps as `config.yaml` in its folder. Write a key of a part with
the part's name in front: `bench.max_rate=0.01`. Each line below has a key with its default, the unit, the allowed
values in brackets, and the meaning.
"""


def page() -> str:
    """Return the text of the whole page."""
    extensions.load_all()
    known: dict[str, EntryPoint[Any]] = {n: importlib.import_module(f"experiments.{n}").main for n in commands()}
    parts: dict[type[Any], str] = {}
    for command in known.values():
        for config in _variants(command):
            _collect(config, "", parts)
    lines = [HEAD, "## Commands", ""]
    for name, command in known.items():
        taken = ", ".join(f"[`{group}`](#{_anchor(f'presets of {group}')})" for group in chosen(name))
        lines += [f"### {name}", "", sentence(name), "", *((f"Groups: {taken}.", "") if taken else ())]
        lines += [*_settings(command.schema, parts), ""]
    lines += ["## Parts", ""]
    for kind, name in parts.items():
        said = (kind.__doc__ or "").split("\n\n")[0].split("Raises:")[0].strip().replace("\n    ", " ")
        base = next((of for of in kind.__mro__[1:] if of in parts), None)
        start = [f"As [{parts[base]}](#{_anchor(parts[base])}), except:", ""] if base else []
        own = [line for line in _settings(kind(), parts) if not base or line not in _settings(base(), parts)]
        lines += [f"### {name}", "", said, "", *start, *own, ""]
    lines += [
        "## Presets",
        "",
        "Each line has the values that differ from the defaults (or from the preset in brackets), or their file.",
        "",
    ]
    for group, options in groups().items():
        lines += [f"### Presets of {group}", "", *(_preset(group, option) for option in options), ""]
    return "\n".join(lines).rstrip() + "\n"


def _anchor(heading: str) -> str:
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _variants(command: EntryPoint[Any]) -> Iterator[Any]:
    """Yield the command's config, once for every kind of part that the config may have."""
    yield command.config()
    several = [entry.name for entry in entries(command.schema) if entry.said.kinds and entry.name not in ELSEWHERE]
    for group in (name for name in several if name in chosen(command.name)):
        for option in groups()[group]:
            yield command.config([f"{group}={option}"])


def _collect(config: Any, prefix: str, parts: dict[type[Any], str]) -> None:
    """Add the class of every part below a config to `parts`, with the first name of this class."""
    for entry in entries(config):
        values, name = [entry.value], entry.name
        if isinstance(entry.value, dict):
            of = _part(config, entry)
            values, name = [*entry.value.values(), *([of()] if of else [])], SINGULAR.get(name, name[:-1])
        for value in filter(is_dataclass, values):
            kind = getattr(value, "kind", "")
            parts.setdefault(cast(type[Any], type(value)), f"{prefix}{name} ({kind})" if kind else f"{prefix}{name}")
            _collect(value, f"{prefix}{name}.", parts)


def _part(config: Any, entry: Entry) -> type[Any] | None:
    """Return the dataclass of a field's part, or of the parts in a field's dict; None for a plain value."""
    of: Any = type(entry.value)
    if of is dict:
        of = get_args(get_type_hints(type(config))[entry.name])[1]
    return cast(type[Any], of) if is_dataclass(of) else None


def _settings(config: Any, parts: dict[type[Any], str]) -> list[str]:
    """Return a line for each field; a part is a link to its own section."""
    lines = []
    for entry in entries(config):
        of = _part(config, entry)
        name = f"[`{entry.name}`](#{_anchor(parts[of])})" if of else f"`{entry.name}={shown(entry.value)}`"
        allowed = entry.allowed and f"({entry.allowed})"
        lines.append(f"- {' '.join(filter(None, (name, entry.said.unit, allowed)))}: {entry.said.what}")
    return lines


def _preset(group: str, option: str) -> str:
    """Return the line of a preset: name, preset that it starts from, meaning, and the values of its own file."""
    own = yaml.safe_load((ROOT / f"{group}/{option}.yaml").read_text(encoding="utf-8")) or {}
    start = ", ".join(f"`{entry}`" for entry in own.pop("defaults", []) if isinstance(entry, str) and entry != "_self_")
    values = [f"{key}={shown(value)}" for key, value in flat(own) if (key, value) != ("kind", option)]
    changed = " ".join(values) if len(values) <= SHORT else f"conf/{group}/{option}.yaml"
    said = ": ".join([*owners(f"{group}/{option}")[:1], sentence(f"{group}/{option}")])
    return f"- `{option}`{start and f' (as {start})'}: {said}{changed and f' `{changed}`'}"


if __name__ == "__main__":
    print(page(), end="")
