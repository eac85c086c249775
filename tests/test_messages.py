"""Declared messages: each is on the page of 3 a.m., is said somewhere, and is said with the values it has."""

import ast
import pickle
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from conf.messages import Message, names
from experiments.cli.three_am import PAGE, TABLE, declared, page
from hardware.errors import DeviceStateError
from hardware.messages import Fault
from hardware.safety.config import WORDS

ROOT = Path(__file__).parents[1]
TEXT = PAGE.read_text(encoding="utf-8")
KINDS = {one.__name__: one for table in TABLE.finditer(TEXT) for one in declared(table[2], table[3])}


@cache
def nodes() -> list[ast.AST]:
    files = [
        path for room in ("conf", "dqn", "envs", "hardware", "experiments") for path in (ROOT / room).rglob("*.py")
    ]
    return [node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]


def name_of(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def said() -> Iterator[tuple[str, set[str | None]]]:
    """Yield the messages that the code makes, with their values; None stands for values given as a mapping."""
    for node in nodes():
        match node:
            case ast.Call(func=function, keywords=given) if name_of(function) in KINDS:
                yield name_of(function), {key.arg for key in given}
            case ast.Call(ast.Name("Finding"), [ast.Attribute(attr=name), _, ast.Dict(keys=keys), *_]):
                yield name, {ast.literal_eval(key) for key in keys if key}


def test_the_page_is_made_of_the_declarations_and_has_all_of_them():
    assert page(TEXT) == TEXT, "python -m experiments.cli.three_am"
    classes = [node for node in nodes() if isinstance(node, ast.ClassDef)]
    words = [node.name for node in classes if any(key.arg == "says" for key in node.keywords)]
    assert sorted(words) == sorted(KINDS), "each once, in the messages.py of a room whose table is on the page"


def test_every_message_is_said_with_the_values_it_has():
    wrong = {name for name, given in said() if None not in given and given != names(KINDS[name])}
    assert not wrong
    used = {name_of(node) for node in nodes() if isinstance(node, ast.Attribute | ast.Name)}
    assert sorted(KINDS.keys() - used) == [], "nobody says these"


def test_every_fault_has_a_response_and_what_helps():
    assert all(kind.response in WORDS and kind.remedy for kind in KINDS.values() if issubclass(kind, Fault))


class Wet(DeviceStateError, says="{what} holds {ml:.1f} mL", remedy="empty {what}"):
    """Of this test."""


def test_a_message_is_its_sentence_and_its_values_wherever_it_goes():
    wet = Wet(what="M0", ml=2.0)
    assert str(wet) == str(pickle.loads(pickle.dumps(wet))) == "M0 holds 2.0 mL; empty M0"
    assert wet.row == {"name": "Wet", "fields": {"what": "M0", "ml": 2.0}}
    assert str(Wet(what="M0", ml=2.0).about("bench")) == "bench: M0 holds 2.0 mL; empty M0"
    for given in ({}, {"what": "M0"}, {"what": "M0", "ml": 1.0, "more": 1}):
        with pytest.raises(TypeError):
            Wet(**given)
    with pytest.raises(TypeError):
        Wet("M0")
    assert str(DeviceStateError("a text")) == str(pickle.loads(pickle.dumps(DeviceStateError("a text")))) == "a text"
    assert isinstance(wet, Message)
