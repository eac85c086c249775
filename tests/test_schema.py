"""A config states default, meaning, unit and range in one place, and a message its fields and its remedy."""

import ast
import pickle
from dataclasses import dataclass
from typing import Any

import pytest
from omegaconf import OmegaConf

from conf import presets
from conf.messages import Message, names
from conf.schema import build, check, part, setting
from envs.plant.plant import PlantConfig
from experiments.cli import frame
from experiments.cli.three_am import PAGE, TABLE, declared, page
from hardware.errors import DeviceStateError
from hardware.link.messages import NotComplete
from hardware.messages import Fault
from hardware.safety.config import WORDS
from tests.test_architecture import modules, tree

PRESETS = [f"{group}/{option}" for group, found in presets.groups().items() for option in found]
RECIPES = ("experiment/", "hparams_search/")  # for the command line
PRESETS = [name for name in PRESETS if not name.startswith(RECIPES)]


@dataclass(frozen=True)
class Inner:
    rate: float = setting(0.5, "a rate", "mL/s", above=0.0, at_most=1.0)
    law: str = setting("none", "a law", choices=("none", "cubic"))
    span: tuple[float, float] = setting((0.1, 1.1), "a range", "OD", above=0.0, at_most=4.0, interval=True)

    def __post_init__(self) -> None:
        check(self, "outer.inner")


@dataclass(frozen=True)
class Outer:
    inner: Inner = part(Inner, "a part")
    share: float = setting(0.5, "a share", within=(0, 1))
    goals: tuple[float, ...] = setting((0.5,), "goals", "OD", above=0.0, at_most=1.5, some=True)
    count: int | None = setting(None, "how many", at_least=1)
    on: bool = setting(True, "a switch")
    named: dict[str, Inner] = setting({}, "parts by name")
    free: dict[str, Any] = setting({}, "anything")
    whatever: Any = part(Inner, "a part of any kind")

    def __post_init__(self) -> None:
        check(self)


def test_fields_keep_their_defaults_and_mutable_ones_are_not_shared():
    assert Outer() == Outer(inner=Inner(), goals=(0.5,), count=None)
    assert Outer().named is not Outer().named


INNER, OUTER = "rate, law, span", "inner, share, goals, count, on, named, free, whatever"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": {"rate": "fast"}}, "inner.rate = fast: allowed a number, 0 < rate <= 1"),
        ({"inner": {"rate": True}}, "inner.rate = True: allowed a number, 0 < rate <= 1"),
        ({"inner": {"span": [2]}}, "outer.inner.span = [2.0]: allowed [low, high] with 0 < low <= high <= 4"),
        ({"inner": {"law": None}}, "inner.law = None: allowed text"),
        ({"inner": 3}, "inner = 3: allowed keys and values, as inner.NAME=VALUE"),
        ({"inner": {"ratte": 1}}, "inner.ratte: no such key; did you mean inner.rate?; allowed under inner: " + INNER),
        ({"inner": {"span": [0.1, "x"]}}, "inner.span[1] = x: allowed a number"),
        ({"law": "cubic"}, "law: no such key; did you mean inner.law?; allowed here: " + OUTER),
        ({"lhh": 3}, "lhh: no such key; allowed here: " + OUTER),
        ({"goals": [0.5, 2]}, "goals = [0.5, 2.0]: allowed one or more, each 0 < OD <= 1.5"),
        ({"goals": 0.5}, "goals = 0.5: allowed a list, as [1,2]"),
        ({"goals": [0.5, "x"]}, "goals[1] = x: allowed a number, 0 < OD <= 1.5"),
        ({"count": 1.5}, "count = 1.5: allowed a whole number, at least 1"),
        ({"on": "perhaps"}, "on = perhaps: allowed true or false"),
        ({"named": {"a": {"rate": 2}}}, "outer.inner.rate = 2.0 mL/s: allowed 0 < rate <= 1"),
    ],
)
def test_what_is_wrong_is_one_line_with_key_value_and_range(values, message):
    with pytest.raises(ValueError, match=r".") as caught:
        build(Outer(), values)
    assert str(caught.value) == message


def test_plain_values_become_the_types_of_their_fields():
    given = {
        "inner": {"rate": "1e-3", "span": [1, 2]},
        "goals": [1],
        "count": "3",
        "on": "no",
        "named": {"a": {"law": "cubic"}},
        "free": {"M0": {"minutes": [90]}},
        "whatever": {"rate": 1},
    }
    assert build(Outer(), given) == Outer(
        inner=Inner(rate=0.001, span=(1.0, 2.0)),
        goals=(1.0,),
        count=3,
        on=False,
        named={"a": Inner(law="cubic")},
        free={"M0": {"minutes": [90]}},
        whatever=Inner(rate=1.0),
    )
    assert build(Outer(count=3), {"count": None}).count is None
    assert build(Outer(named={"a": Inner(rate=0.1)}), {"named": {"a": {"law": "cubic"}, "b": {}}}).named == {
        "a": Inner(rate=0.1, law="cubic"),
        "b": Inner(),
    }


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_read_without_hydra_is_what_hydra_composes(name):
    composed = OmegaConf.to_container(frame.compose(name, []), resolve=True)
    for key in name.split("/")[:-1]:
        composed = composed.get(key, {})
    assert presets.load(name) == composed


def test_a_plant_is_built_from_its_preset():
    bench = build(PlantConfig(), presets.load("plant/bench"))
    assert (bench.growth.mu, bench.pump.dosing, bench.sensor.noise_factor_sd) == (0.025, "pulse", 0.6)
    with pytest.raises(ValueError, match=r"plant = sick: allowed bad_optics, bench"):
        presets.load("plant/sick")


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
