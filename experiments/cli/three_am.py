"""The tables of docs/three_am.md, from the declared messages: `python -m experiments.cli.three_am` writes them anew."""

import re
from collections.abc import Iterator
from importlib import import_module
from string import Formatter

from conf.messages import Message
from conf.presets import ROOT
from experiments.reporting.tables import markdown
from hardware.messages import Fault

PAGE = ROOT.parent / "docs" / "three_am.md"
TABLE = re.compile(r"(<!-- (alarms|notes|errors) of (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """Fill the marked tables of a page."""
    return TABLE.sub(lambda m: f"{m[1]}{_table(m[2], m[3])}\n{m[4]}", text)


def declared(what: str, room: str) -> list[type[Message]]:
    """Messages of one sort that a room declares, in their order there."""
    module = import_module(f"{room.replace('/', '.')}.messages")
    own = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    return [one for one in own if issubclass(one, Message) and one.says and _sort(one) == what]


def _sort(kind: type[Message]) -> str:
    return "alarms" if issubclass(kind, Fault) else "errors" if issubclass(kind, Exception) else "notes"


def _table(what: str, room: str) -> str:
    alarms = what == "alarms"
    heads = ("the screen says", "it means", *(["the program did"] if alarms else []), "do now")
    worded = [one for one in declared(what, room) if alarms or re.search(r"\w", _shown(one.says))]
    return markdown(heads, [list(_cells(one)) for one in worded])


def _cells(kind: type[Message]) -> Iterator[str]:
    """Yield the sentence of a message, its meaning, its response if it is a fault, its remedy; … is what varies."""
    name = f"{kind.kind}: " if issubclass(kind, Fault) else ""
    yield f"`{name}{_shown(kind.says)}`"
    own = (one.__doc__ for one in kind.__mro__ if one is kind or vars(one).get("response"))
    yield next(filter(None, own), "").removesuffix(".")
    if issubclass(kind, Fault):
        yield f"`{kind.response}`"
    yield _shown(kind.remedy)


def _shown(words: str) -> str:
    return "".join(text + "…" * (name is not None) for text, name, _, _ in Formatter().parse(words)).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
