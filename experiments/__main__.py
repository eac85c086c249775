"""The program `python -m experiments` or `turbidostat`: list of commands, and entry to each."""

import importlib
import sys
import textwrap
from collections.abc import Iterator
from difflib import get_close_matches

from conf.presets import commands, sentence
from experiments.cli.start import version

KINDS = {
    "From a recording to a reactor": ("demo", "calibrate", "replay", "train", "certify", "deploy", "report"),
    "At the device": ("calibrate_pump", "blank", "mark", "calibrate_pair"),
    "Side by side": ("benchmark", "score"),
}
DEMO = "The whole way in one command: calibrate, train, deploy, report."
USAGE = """\
usage: turbidostat COMMAND [key=value ...]     the same as  python -m experiments.COMMAND [key=value ...]
"""
END = """\
turbidostat COMMAND --help     what a command takes; --help=all with every value, unit, range and default
turbidostat COMMAND --cfg job  the config it would run with
turbidostat --version          which version this is

An emulated Chi.Bio is started by  python -m hardware.emulator --help

Exit codes
  0    done
  1    refused or failed; one line on standard error says why and what to do
  2    no such command
  130  stopped by Ctrl-C, SIGTERM or SIGHUP; one line says what is kept and how to go on;
       a deployment that was stopped ends with 0, once its pumps are verified off"""


def names() -> list[str]:
    """Return all commands, in listed order."""
    listed = [name for group in KINDS.values() for name in group]
    return [*listed, *(name for name in commands() if name not in listed)]


def _line(name: str, what: str) -> str:
    return textwrap.fill(f"  {name:<15} {what}", 110, subsequent_indent=" " * 18)


def page() -> Iterator[str]:
    """Describe all commands, line by line, for a call without a command."""
    yield USAGE
    others = tuple(name for name in names() if not any(name in group for group in KINDS.values()))
    for kind, group in {**KINDS, **({"Others": others} if others else {})}.items():
        yield kind
        yield from (_line(name, DEMO if name == "demo" else sentence(name)) for name in group)
        yield ""
    yield END


def main() -> None:
    """Entry point of the console script. Exits: as the command does; 2 for an unknown command."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h", "help"):
        print("\n".join(page()))
    elif name == "--version":
        print(version())
    elif name in names():
        sys.argv = [f"turbidostat {name}", *rest]
        importlib.import_module(f"experiments.{name}").main()
    else:
        near = get_close_matches(name, names(), 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(names())}"
        print(f"error: {name}: no such command; {hint}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
