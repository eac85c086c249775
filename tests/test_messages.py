"""Declared messages: each is on the page of 3 a.m., is said somewhere, and is said with the values it has."""

import ast
import pickle
from typing import Any

import pytest

from conf.messages import Message, names
from experiments.cli.three_am import PAGE, TABLE, declared, page
from hardware.errors import DeviceStateError
from hardware.link.messages import NotComplete
from hardware.messages import Fault
from hardware.safety.config import WORDS
from tests.test_architecture import modules, tree

TEXT = PAGE.read_text(encoding="utf-8")
KINDS = {one.__name__: one for table in TABLE.finditer(TEXT) for one in declared(table[2], table[3])}
NODES = [node for module in modules() for node in ast.walk(tree(module))]


def name_of(node: Any) -> str:
    return getattr(node, "attr", "") or getattr(node, "id", "")


def test_the_page_is_made_of_the_declarations_and_has_all_of_them() -> None:
    assert page(TEXT) == TEXT, "python -m experiments.cli.three_am"
    classes = [node for node in NODES if isinstance(node, ast.ClassDef)]
    words = [node.name for node in classes if any(key.arg == "says" for key in node.keywords)]
    assert sorted(words) == sorted(KINDS), "each once, in the messages.py of a room whose table is on the page"
    assert all(kind.response in WORDS and kind.remedy for kind in KINDS.values() if issubclass(kind, Fault))


def test_every_message_is_said_with_the_values_it_has() -> None:
    for node in NODES:
        match node:
            case ast.Call(ast.Name("Finding"), [ast.Attribute(attr=name), _, ast.Dict(keys=keys), *_]):
                assert {ast.literal_eval(key) for key in keys if key} == names(KINDS[name]), name
            case ast.Call(func=function, keywords=given) if (name := name_of(function)) in KINDS:
                values = {key.arg for key in given}
                assert values == names(KINDS[name]) or None in values, name  # None: of a mapping
    assert sorted(KINDS.keys() - set(map(name_of, NODES))) == [], "nobody says these"


def test_a_message_is_its_sentence_and_its_values_wherever_it_goes() -> None:
    told, text = NotComplete(request="GET /", seconds=2.0), DeviceStateError("a text")
    assert str(told) == str(pickle.loads(pickle.dumps(told))) == f"{told.sentence}; {told.remedy}"
    assert "2.0 s" in told.sentence
    assert told.row == {"name": "NotComplete", "fields": {"request": "GET /", "seconds": 2.0}}
    assert str(told.about("M0")) == f"M0: {told}"
    assert str(text) == str(pickle.loads(pickle.dumps(text))) == "a text"
    for given in ({}, {"request": "GET /"}, {**told.fields, "more": 1}):
        with pytest.raises(TypeError):
            NotComplete(**given)
    with pytest.raises(TypeError):
        Message("a text", value=1)
