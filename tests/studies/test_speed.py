"""Timing in pairs: what is measured, in which unit, and against whom."""

import time
from itertools import count

import pytest

from experiments.cli import frame
from tests.studies.measurement import Measurement, measure
from tests.studies.speed import GROUPS, SpeedConfig, table

pytestmark = pytest.mark.numeric


def test_the_ratio_is_the_rivals_time_over_ours():
    m = Measurement(
        "sleep", "work", "slower", lambda: time.sleep(0.004), lambda: time.sleep(0.02), "ms per item", 1e3, 2, 500.0
    )  # fmt: skip
    found = measure(m, 5)
    assert 1.9 < found["ours"] < 50.0  # a busy machine sleeps longer
    assert 1.2 < found["ratio"] < 6.0
    assert found["ratio_range"][0] <= found["ratio"] <= found["ratio_range"][1]
    assert found["within_limit"] is True
    assert measure(Measurement("s", "w", "r", lambda: None, lambda: None), 5)["within_limit"] is None


def test_pairs_alternate_and_the_first_is_thrown_away():
    calls: list[str] = []
    tick = count()

    def ours() -> None:
        calls.append("ours")
        time.sleep(0.05 if next(tick) == 0 else 0.0)

    found = measure(Measurement("a", "w", "r", ours, lambda: calls.append("theirs")), 5)
    assert calls == ["theirs", "ours", "ours", "theirs"] * 3
    assert found["ours"] < 0.04


def test_every_measurement_names_its_rival_and_does_its_work():
    measurements = [m for name in ("controllers", "mpc") for m in GROUPS[name]()]
    assert {m.name for m in measurements} >= {"closed loop, pi", "closed loop, dqn", "closed loop, inverse",
                                              "closed loop, mpc", "mpc solve, single"}  # fmt: skip
    assert all(m.rival for m in measurements)
    limits = {m.name: m.limit for m in measurements if m.name.startswith("closed loop")}
    assert limits == {
        "closed loop, pi": 1.0,
        "closed loop, dqn": 1.0,
        "closed loop, inverse": 1.0,
        "closed loop, mpc": 20.0,
    }
    found = [measure(m, 5) for m in measurements if m.name == "mpc solve, single"]
    assert found[0]["ours"] > 0.0
    assert "mpc solve, single" in table(found, 5, "here").csv()


@pytest.mark.parametrize(
    ("override", "parts"),
    [("groups=[nothing]", ["groups = nothing", "controllers"]), ("runs=2", ["runs = 2", "5 to 1000"])],
)
def test_a_wrong_override_is_one_line(override, parts):
    with pytest.raises(frame.UserError) as caught:
        frame.load(frame.compose("speed", [override]), SpeedConfig())
    assert all(part in str(caught.value) for part in parts)
    assert "\n" not in str(caught.value)
