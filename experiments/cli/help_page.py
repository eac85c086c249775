"""What `--help` prints: how a command is used, what can be chosen, and every value with its meaning and range.

Usage is the comment that opens conf/NAME.yaml; all else comes from the fields of the command's config.
"""

import textwrap
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any

from conf.presets import chosen, opening, options, sentence
from conf.schema import entries

__all__ = ["shown", "text"]

WIDTH = 118
LEFT = 44  # columns of `key = value`


def shown(value: Any) -> str:
    """A value as it is written on a command line."""
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
    """Two columns; the right one is wrapped."""
    lines = textwrap.wrap(right, WIDTH - at) or [""]
    head = [left] if len(left) > at - 2 else []
    lines[0] = (" " * at if head else left.ljust(at)) + lines[0]
    return [line.rstrip() for line in (*head, lines[0], *(" " * at + line for line in lines[1:]))]


def _values(config: Any, prefix: str) -> Iterator[str]:
    """The plain values of a config, then its parts, each below a line of its own."""
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
                parts.append((f"{key}.NAME", f"here the values of {name}", first))
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
    for key, what, inner in parts:
        yield ""
        yield f"{key}: {what}"
        yield from _values(inner, f"{key}.")


def text(name: str, config: Any) -> str:
    """The whole page, with the values that the rest of the command line gives.

    Args: name: of the command; config: what it would run with.
    """
    choices = []
    for group, start in chosen(name).items():
        choices.append(f"  {group}=" + (f"    (by itself {start})" if start else ""))
        for option in options(name, group):
            choices += _line(f"    {option}", sentence(f"{group}/{option}"), 26)
        choices.append("")
    head = ["Choices (group=option)", ""] if choices else []
    return "\n".join([*opening(name), "", *head, *choices, "Values (key=value)", "", *_values(config, "")])
