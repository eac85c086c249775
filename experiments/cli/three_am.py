"""Generator of the lists in docs/three_am.md from the declared messages: `python -m experiments.cli.three_am`."""

import re
from importlib import import_module
from string import Formatter

from conf.messages import Message
from conf.presets import ROOT
from hardware.messages import Fault

PAGE = ROOT.parent / "docs" / "three_am.md"
TABLE = re.compile(r"(<!-- (alarms|notes|errors) of (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """Return the page with its marked lists filled."""
    return TABLE.sub(lambda m: f"{m[1]}{_lines(m[2], m[3])}\n{m[4]}", text)


def declared(what: str, room: str) -> list[type[Message]]:
    """List the messages of one sort (alarms, errors, notes) that a package declares, in order of declaration."""
    module = import_module(f"{room.replace('/', '.')}.messages")
    own = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    return [one for one in own if issubclass(one, Message) and one.says and _sort(one) == what]


def _sort(kind: type[Message]) -> str:
    return "alarms" if issubclass(kind, Fault) else "errors" if issubclass(kind, Exception) else "notes"


def _lines(what: str, room: str) -> str:
    """Return a line for each message, except an error or note that has neither a docstring nor a remedy."""
    told = [one for one in declared(what, room) if what == "alarms" or _meaning(one) or one.remedy]
    return "\n" + "\n".join(_line(one) for one in told if what == "alarms" or re.search(r"\w", _shown(one.says))) + "\n"


def _line(kind: type[Message]) -> str:
    """Return a message's sentence, the response to a fault, the meaning, and the remedy after an arrow."""
    said = f"- `{_shown(kind.says)}`"
    if issubclass(kind, Fault):
        said = f"- `{kind.kind}: {_shown(kind.says)}` ({kind.response})"
    return said + (_meaning(kind) and f": {_meaning(kind)}") + (kind.remedy and f" → {_shown(kind.remedy)}")


def _meaning(kind: type[Message]) -> str:
    own = (one.__doc__ for one in kind.__mro__ if one is kind or vars(one).get("response"))
    return next(filter(None, own), "").removesuffix(".")


def _shown(words: str) -> str:
    return "".join(text + "…" * (name is not None) for text, name, _, _ in Formatter().parse(words))


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
