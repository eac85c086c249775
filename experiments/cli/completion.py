"""Completion in the shell: commands, groups with their presets, keys part by part, and the values of a choice."""

import importlib
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any

from conf.presets import chosen, options
from conf.schema import entries
from experiments.cli.frame import EntryPoint, UserError

__all__ = ["SHELLS", "candidates"]

FLAGS = ("--help", "--help=all", "--cfg", "--multirun")
SHELLS = {
    "bash": """\
_turbidostat() {
    local IFS=$'\\n'
    COMPREPLY=($(turbidostat complete "${COMP_LINE:0:COMP_POINT}" 2>/dev/null))
    local broken="${COMP_WORDBREAKS//[^=]}" word="${COMP_LINE:0:COMP_POINT}"
    word="${word##* }"
    if [[ -n "$broken" && "$word" == *=* ]]; then  # bash begins a new word behind each =
        COMPREPLY=("${COMPREPLY[@]#"${word%=*}="}")
    fi
}
complete -o nospace -o default -F _turbidostat turbidostat
""",
    "zsh": """\
_turbidostat() {
    local -a found
    found=(${(f)"$(turbidostat complete "${BUFFER[1,CURSOR]}" 2>/dev/null)"})
    if (( $#found )); then compadd -Q -S '' -- $found; else compset -P '*='; _files; fi
}
compdef _turbidostat turbidostat
""",
    "fish": """\
complete -c turbidostat -a '(turbidostat complete (commandline -cp | string collect) 2>/dev/null | string trim)'
""",
}
"""Shell -> what `eval "$(turbidostat completion SHELL)"` makes it know."""


def candidates(line: str, commands: list[str]) -> list[str]:
    """List the possible last words of a command line.

    Args: line: up to the cursor, the program's name first. commands: names of all commands.
    """
    words = line.split()[1:] + ([""] if line[-1:].isspace() else [])
    *before, last = words or [""]
    if not before:
        found = [f"{name} " for name in (*commands, "completion")]
    elif before[0] == "completion":
        found = list(SHELLS)
    elif before[0] in commands:
        found = list(_of_command(before[0], before[1:], last))
    else:
        found = []
    return [word for word in found if word.startswith(last)]


def _of_command(name: str, before: list[str], last: str) -> Iterator[str]:
    command = getattr(importlib.import_module(f"experiments.{name}"), "main", None)
    if not isinstance(command, EntryPoint):
        yield "--help"
        return
    key, given, _ = last.partition("=")
    plus = "+" if key.startswith("+") else ""
    for group in chosen(name):
        yield from (f"{plus}{group}={option} " for option in options(name, group)) if given else (f"{plus}{group}=",)
    yield from FLAGS
    groups = set(chosen(name))
    own = _keys(_config(command, before), key.split(".")[:-1], bool(given))
    yield from (word for word in own if word.partition("=")[0] not in groups)


def _config(command: EntryPoint[Any], words: list[str]) -> Any:
    """Compose the config of the rest of the line; the default if the line is not valid yet."""
    try:
        return command.config([w for w in words if not w.startswith("-")])
    except (UserError, ValueError):
        return command.schema


def _keys(config: Any, parts: list[str], values: bool) -> Iterator[str]:
    """List the keys of the part at `parts`, or with `values` their possible values."""
    prefix = "".join(f"{part}." for part in parts)
    for part in parts:
        config = config.get(part) if isinstance(config, dict) else getattr(config, part, None)
    if isinstance(config, dict):
        yield from (f"{prefix}{key}." for key in config)
    if not is_dataclass(config):
        return
    for entry in entries(config):
        key = f"{prefix}{entry.name}"
        if is_dataclass(entry.value) or (isinstance(entry.value, dict) and entry.value):
            yield f"{key}."
        elif not values:
            yield f"{key}="
        elif isinstance(entry.value, bool):
            yield from (f"{key}=true ", f"{key}=false ")
        else:
            yield from (f"{key}={choice} " for choice in entry.said.choices)
