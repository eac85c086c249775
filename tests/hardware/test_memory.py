"""Whatever a run remembers is put back to the bit, or refused by the name of what is missing or does not fit."""

import ast
import copy
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dqn import policy as policies
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.cli import files
from experiments.coculture.base import SHARE
from experiments.coculture.estimator import CompositionEstimator
from experiments.coculture.policies import SHIPPED_COMPOSITION
from experiments.coculture.recall import Recall
from experiments.coculture.signal import Share
from experiments.control.policies import load_policy
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop
from hardware.memory import Remembers
from hardware.safety.interlock import Interlock

ROOT = Path(__file__).parents[2]
SCHEDULES = [
    Scenario((0.5, 0.4), (30.0, 40.0), (37.0, 37.0), until=("settled", None), outputs=("pump3 2 mL/h", None)),
    Scenario((0.5, 0.4, 0.3), (30.0, 40.0, 5.0), (37.0, 37.0, 37.0)),
]
LAWS = {
    "pi": "pi", "pi_tuned": "proportional", "mpc": "midpoint", "inverse": "pi", "dqn": "dqn_preview", "threshold": "pi",
    "gain_scheduled": "pi",
}  # fmt: skip
ANEW = {"_fresh_s"}  # of the interlock: begins anew in a resumed run
BOUND = {"edges", "_latched", "_hold_kind", "rngs"}  # more is asked of them than type and shape
STREAM: dict[str, Any] = dict(np.random.default_rng(0).bit_generator.state)
PATH = tuple[Any, ...]
ONCE = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))

NUMBERS = st.one_of(st.integers(), st.just(10**400), st.floats(), st.booleans(), st.none(), st.text(max_size=3))
JSON = st.recursive(
    NUMBERS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
)
NEVER = st.sampled_from(
    [
        "x", {}, {"mean": 1}, [], [[]], ["x"] * 2, ["1"] * 2, [[1.0], [1.0, 2.0]], [1.0], [1.0] * 3, [[[[1.0]]]],
        [10**400] * 2, [float("inf")] * 2, [float("-inf")] * 2, [{}] * 2, [True, 1.0], 10**400, float("nan"), -1, 2.5,
    ]
)  # fmt: skip


@cache
def policy() -> Any:
    return load_policy("shipped", 1.0, 0.02)


@cache
def preview() -> Any:
    return policies.load(SHIPPED_COMPOSITION["dqn_preview"])


def unused(kind: str) -> ClosedLoop:
    """A loop in which everything that can remember does."""
    law = registry.build(registry.config(kind), model=EnvConfig(), policy=policy())
    config = registry.config(LAWS[kind], SHARE)
    ratio = registry.build(config, SHARE, policy=preview())
    share = Share(Recall(CompositionEstimator(config.estimator)), ratio, SCHEDULES)
    reactors: Any = SimpleNamespace(names=("M0", "M1"))
    ahead = 20.0 if kind == "pi_tuned" else None  # an estimator beside it
    schedules = [replace(schedule, announce_min=ahead) for schedule in SCHEDULES]
    return ClosedLoop(reactors, law, Interlock(2), schedules, further=[share])


def written(loop: ClosedLoop) -> dict[str, Any]:
    """The state as the file has it."""
    found: dict[str, Any] = json.loads(json.dumps(files.plain(loop.state())))
    return found


def leaves(state: Any, path: PATH = ()) -> Iterator[PATH]:
    """Every key with values: by which keys and reactors one gets there."""
    for key, value in state.items():
        if key in ("steps", "supply"):
            for n, row in enumerate(value):
                yield from leaves(row, (*path, key, n))
        elif isinstance(value, dict):
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key)


def at(state: Any, path: PATH) -> Any:
    for key in path:
        state = state[key]
    return state


def refused(kind: str, state: Any, *names: str) -> None:
    """Refused in one line with one of these names."""
    with pytest.raises(ValueError, match="|".join(map(re.escape, names))) as caught:
        unused(kind).restore(state)
    assert "\n" not in str(caught.value)


def places() -> st.SearchStrategy[tuple[str, PATH]]:
    return st.sampled_from([(kind, path) for kind in LAWS for path in leaves(written(unused(kind)))])


@given(places(), NEVER)
@ONCE
def test_what_never_fits_is_refused_by_its_name(place: tuple[str, PATH], value: Any) -> None:
    kind, path = place
    state = written(unused(kind))
    one = not isinstance(at(state, path), list)  # not one for each reactor
    at(state, path[:-1])[path[-1]] = [value] if one else value
    refused(kind, state, str(path[-1]), "interlock is for")


@pytest.mark.parametrize("kind", LAWS)
def test_what_is_missing_is_named(kind: str) -> None:
    whole = written(unused(kind))
    for path in leaves(whole):
        if kind != "pi" and path[0] != "controller":
            continue  # all else is the same whoever controls
        state = copy.deepcopy(whole)
        del at(state, path[:-1])[path[-1]]
        refused(kind, state, path[-1])
    for key in whole:
        refused(kind, {k: v for k, v in whole.items() if k != key}, key)


@given(places(), JSON)
@ONCE
def test_any_value_is_put_back_as_it_is_or_refused(place: tuple[str, PATH], value: Any) -> None:
    kind, path = place
    state, loop = written(unused(kind)), unused(kind)
    at(state, path[:-1])[path[-1]] = value
    try:
        loop.restore(state)
    except ValueError:
        return
    expected = state | {"interlock": state["interlock"] | {key: [None, None] for key in ANEW}}
    assert written(loop) == files.plain(expected)


@pytest.mark.slow
@given(st.data())
@ONCE
def test_a_memory_of_any_numbers_comes_back_to_the_bit(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(list(LAWS)))
    state = written(unused(kind))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    scale = data.draw(st.sampled_from([1e-310, 1.0, 1e300]))

    def filled(value: Any) -> Any:
        if isinstance(value, list):
            return [filled(each) for each in value]
        if isinstance(value, bool):
            return bool(rng.integers(2))
        if isinstance(value, int):
            return int(rng.integers(-(2**62), 2**62))
        return None if value is None and rng.random() < 0.3 else float(scale * rng.standard_normal())

    for path in leaves(state):
        if path[-1] not in BOUND:
            at(state, path[:-1])[path[-1]] = filled(at(state, path))
    loop = unused(kind)
    loop.restore(json.loads(json.dumps(state)))
    state["interlock"] |= {key: [None, None] for key in ANEW}
    assert json.dumps(written(loop)) == json.dumps(state)
    assert not np.isnan(loop.interlock.budget._dose_s).any()  # None stands for what an unused one has: never
    again = unused(kind)
    again.restore(loop.state())
    assert json.dumps(written(again)) == json.dumps(state)


@pytest.mark.parametrize(
    "stream",
    [
        {}, None, 5, {"bit_generator": "PCG64"}, STREAM | {"bit_generator": "MT19937"}, STREAM | {"has_uint32": 10**30},
        STREAM | {"uinteger": 2**40}, STREAM | {"state": [1]}, STREAM | {"state": {"state": 10**60, "inc": 1}},
        STREAM | {"state": {"state": -1, "inc": 1}}, STREAM | {"state": {"state": 1.5, "inc": 1}},
        STREAM | {"state": {"state": "1", "inc": None}},
    ],
)  # fmt: skip
def test_a_random_stream_that_is_none_is_refused(stream: Any) -> None:
    state = written(unused("mpc"))
    whole = state["controller"]["rngs"]
    for damaged in ([whole[0], stream], whole[:1]):
        state["controller"]["rngs"] = damaged
        refused("mpc", state, "controller.rngs")


@pytest.mark.parametrize("edges", [[0.0, 5.0, 4.0], [1.0, 5.0, 9.0], [0.0, 5.0, 5.0]])
def test_edges_rise_from_nought_and_are_saved_without_what_pads_them(edges: list[float]) -> None:
    state = written(unused("pi"))
    assert [row["edges"] for row in state["steps"]] == [[0.0, 30.0, 70.0], [0.0, 30.0, 70.0, 75.0]]
    state["steps"][0]["edges"] = edges
    refused("pi", state, "steps: edges")


@pytest.mark.parametrize("key", ["steps", "supply"])
def test_there_is_one_row_for_each_reactor(key: str) -> None:
    state = written(unused("pi"))
    for rows in ([], state[key][:1], [*state[key], state[key][0]], "rows", [None, None]):
        refused("pi", state | {key: rows}, f"{key}: ", f"{key}.")


@pytest.mark.slow
def test_every_class_that_remembers_is_tried_here() -> None:
    seen: set[str] = set()

    def visit(owner: Any) -> None:
        seen.update(base.__name__ for base in type(owner).__mro__)
        for part in vars(owner).values():
            for each in part if isinstance(part, tuple | list) else (part,):
                held = getattr(each, "memory", each)  # of a signal
                if isinstance(held, Remembers):
                    visit(held)

    for kind in LAWS:
        loop = unused(kind)
        for owner in (loop, *(signal.memory for signal in loop.signals)):
            visit(owner)
    declared = set()
    for package in ("hardware", "envs", "experiments"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if (
                    isinstance(node, ast.ClassDef)
                    and path.name != "memory.py"
                    and re.search(r"^\s+(self\.)?remembers\b.* =", ast.unparse(node), re.MULTILINE)
                ):
                    declared.add(node.name)
    assert len(declared) >= 20
    assert declared <= seen
