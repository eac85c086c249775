"""Text of `--help`: usage, presets, and values with meaning and range.

The usage is the opening comment of conf/NAME.yaml. The values come from the fields of the command's config.
"""

import textwrap
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any

from conf.messages import NotAllowed
from conf.presets import chosen, opening, options, sentence
from conf.schema import entries

WIDTH = 118
LEFT = 44  # columns of `key = value`


def shown(value: Any) -> str:
    """Return a value as typed on a command line."""
    if isinstance(value, list | tuple):
        return "[" + ",".join(shown(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {shown(v)}" for k, v in value.items()) + "}"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    return "''" if value == "" else str(value)


def _line(left: str, right: str, at: int) -> list[str]:
    lines = textwrap.wrap(right, WIDTH - at) or [""]
    head = [left] if len(left) > at - 2 else []
    lines[0] = (" " * at if head else left.ljust(at)) + lines[0]
    return [line.rstrip() for line in (*head, lines[0], *(" " * at + line for line in lines[1:]))]


def _values(config: Any, prefix: str, deep: bool = True) -> Iterator[str]:
    """Yield lines for the plain values of a config, then for the values of its parts; not `deep`: one line per part."""
    parts: list[tuple[str, str, Any]] = []
    default = type(config)()
    for entry in entries(config):
        key = f"{prefix}{entry.name}"
        if is_dataclass(entry.value):
            parts.append((key, entry.said.what, entry.value))
        elif isinstance(entry.value, dict) and entry.value:
            yield from _line(f"  {key}.NAME", f"{entry.said.what}: {', '.join(entry.value)}", LEFT)
            name, first = next(iter(entry.value.items()))
            if is_dataclass(first):
                parts.append((f"{key}.NAME", f"the values of {name}, as an example", first))
        else:
            usual = getattr(default, entry.name)
            notes = [f"allowed: {entry.allowed}"] if entry.allowed else []
            notes += [f"default: {shown(usual)}"] if entry.value != usual else []
            words = (
                entry.said.unit and f"{entry.said.unit}:",
                entry.said.what,
                f"({'; '.join(notes)})" if notes else "",
            )
            yield from _line(f"  {key} = {shown(entry.value)}", " ".join(filter(None, words)), LEFT)
    if not deep:
        yield from (line for key, what, _ in parts for line in _line(f"  {key}.…", what, LEFT))
        return
    for key, what, inner in parts:
        yield ""
        yield f"{key}: {what}"
        yield from _values(inner, f"{key}.")


def _group(name: str, group: str, start: str | None) -> list[str]:
    lines = [f"  {group}=" + (f"    (default {start})" if start else "")]
    return lines + [
        x for option in options(name, group) for x in _line(f"    {option}", sentence(f"{group}/{option}"), 26)
    ]


def _short(name: str, config: Any) -> list[str]:
    choices = [
        line
        for group, start in chosen(name).items()
        for line in _line(
            f"  {group}=",
            " | ".join(options(name, group)) + (f"    (default {start})" if start else ""),
            26,
        )
    ]
    head = ["Choices (group=option)", "", *choices, ""] if choices else []
    words = _parts(name, config)
    number = sum(1 for _ in _leaves(config))
    more = ["", f"--help=all    every choice and every value, with unit, range and default ({number})"]
    more += textwrap.wrap(f"--help=NAME   the same for one of {', '.join(words)}", WIDTH, subsequent_indent=" " * 14)
    own = ["Values (key=value)", "", *_values(config, "", deep=False)]
    return [*opening(name), "", *head, *own, *(more if words else ())]


def _leaves(config: Any) -> Iterator[str]:
    for entry in entries(config):
        if is_dataclass(entry.value):
            yield from _leaves(entry.value)
        else:
            yield entry.name


def _parts(name: str, config: Any) -> dict[str, Any]:
    """Return name -> part of the config for every group and part of a command; None for a group without a part."""
    return dict.fromkeys(chosen(name)) | {e.name: e.value for e in entries(config) if is_dataclass(e.value)}


def text(name: str, config: Any, about: str = "") -> str:
    """Return the text of `--help`, with the values that the rest of the command line gives.

    Args: name: name of the command. config: its config. about: "all" or a group or part of the config, whose values
      are listed; "" for the short page.
    Raises: ValueError for an unknown `about`.
    """
    if not about:
        return "\n".join(_short(name, config))
    groups = {group: _group(name, group, start) for group, start in chosen(name).items()}
    if about == "all":
        choices = [line for lines in groups.values() for line in (*lines, "")]
        head = ["Choices (group=option)", ""] if choices else []
        return "\n".join([*opening(name), "", *head, *choices, "Values (key=value)", "", *_values(config, "")])
    parts = _parts(name, config)
    if about not in parts:
        raise NotAllowed(key="--help", given=about, allowed=f"all, {', '.join(parts)}")
    inner = parts[about]
    values = _values(inner, f"{about}.") if inner is not None else ()
    return "\n".join([*groups.get(about, []), *([""] if about in groups and inner is not None else []), *values])
