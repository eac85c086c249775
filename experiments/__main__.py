"""Program `turbidostat`, or `python -m experiments`: list the commands, or run one of them."""

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
    "Comparisons": ("benchmark", "score"),
}
DEMO = "All steps in one command: calibrate, train, certify, deploy, report."
USAGE = """\
usage: turbidostat COMMAND [key=value ...]     the same as  python -m experiments.COMMAND [key=value ...]
"""
END = """\
turbidostat COMMAND --help     arguments of a command; --help=all lists every value with unit, range and default
turbidostat COMMAND --cfg job  the config that the command would use; nothing runs
turbidostat --version          version of this program

How to start an emulated Chi.Bio:  python -m hardware.emulator --help

Exit codes
  0    done
  1    refused or failed; one line on standard error gives the reason and the remedy
  2    no such command
  130  stopped by Ctrl-C, SIGTERM or SIGHUP; one line lists the files kept and how to continue;
       a stopped deployment exits with 0 after its pumps are verified off"""


def names() -> list[str]:
    """Return the names of all commands, first those in `KINDS`."""
    listed = [name for group in KINDS.values() for name in group]
    return [*listed, *(name for name in commands() if name not in listed)]


def _line(name: str, what: str) -> str:
    return textwrap.fill(f"  {name:<15} {what}", 110, subsequent_indent=" " * 18)


def page() -> Iterator[str]:
    """Yield the lines that describe all commands, for a call without a command."""
    yield USAGE
    others = tuple(name for name in names() if not any(name in group for group in KINDS.values()))
    for kind, group in {**KINDS, **({"Others": others} if others else {})}.items():
        yield kind
        yield from (_line(name, DEMO if name == "demo" else sentence(name)) for name in group)
        yield ""
    yield END


def main() -> None:
    """Run the command of the console script. Exits: with the command's status; 2 for an unknown command."""
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
        hint = f"did you mean {near[0]}?" if near else f"the commands are {', '.join(names())}"
        print(f"error: {name}: no such command; {hint}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
