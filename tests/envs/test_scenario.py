"""Schedules as functions of time."""

import numpy as np
import pytest

from envs.scenario import Conditions, Output, Scenario, outputs_of
from experiments.coculture.program import composed, resting
from experiments.loop.progress import Progress

STEPS = Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 30.0), recovery_od=0.8)


def test_phases_of_unequal_length_end_where_their_own_minutes_do():
    long = Scenario((0.3, 0.6, 0.9), (10.0, 25.0, 5.0), (30.0, 37.0, 33.0), outputs=("pump4 1 mL", None, None))
    minute = np.array([np.nan, -5.0, 0.0, 9.99, 10.0, 34.99, 35.0, 41.0, 500.0])
    phase, setpoint, temperature = Progress([long] * 9).asked(minute)
    assert phase.tolist() == [-1, -1, 0, 0, 1, 1, 2, 2, 2]
    assert setpoint.tolist() == [0.3, 0.3, 0.3, 0.3, 0.6, 0.6, 0.9, 0.9, 0.9]
    assert temperature.tolist() == [30.0, 30.0, 30.0, 30.0, 37.0, 37.0, 33.0, 33.0, 33.0]
    assert (long.edges.tolist(), long.total_min, long.supplied) == ([0.0, 10.0, 35.0, 40.0], 40.0, {4})


@pytest.mark.parametrize(("text", "fits"), [
    ("od >= 2", True), ("od <= 2.01", False), ("od >= 0", False), ("od > 0.5", False), ("od<=.3", True),
    ("od => 0.8", False), ("OD >= 0.8", False), ("od >= high", False), ("setled", False), ("time", False),
    ("od >= 1 x", False),
])  # fmt: skip
def test_a_condition_has_a_level_above_zero_and_up_to_two(text, fits):
    if fits:
        assert Scenario((0.5, 0.6), (9.0, 9.0), (37.0, 37.0), until=(None, text)).until == (None, text)
    else:
        with pytest.raises(ValueError, match=r"scenario.until = .*allowed"):
            Scenario((0.5, 0.6), (9.0, 9.0), (37.0, 37.0), until=(None, text))


@pytest.mark.parametrize(
    ("text", "allowed"),
    [
        ("pump3 20 mL/h", None), ("pump3 20.1 mL/h", "0.1 to 20 mL/h"), ("pump3 0.1 mL/h, pump4 0.5 mL", None),
        ("pump3 0.09 mL/h", "0.1 to 20 mL/h"), ("pump4 0.49 mL", "0.5 to 20 mL$"), ("pump4 21 mL", "0.5 to 20 mL$"),
        ("pump3 1 mL, pump3 2 mL/h", "each pump at most once"), ("pump2 1 mL", "'pump3 2 mL/h', 'pump4 1.5 mL'"),
        *((text, "'pump3 2 mL/h', 'pump4 1.5 mL'") for text in ("pump3 2", "pump3 2 L", "pump3 -1 mL", "pump3 1 mL,")),
    ],
)  # fmt: skip
def test_an_amount_of_a_spare_pump_is_within_what_it_can_give(text, allowed):
    if allowed is None:
        assert sum(output.ml_h + output.ml for output in outputs_of(text)) in (20.0, 0.6)
    else:
        with pytest.raises(ValueError, match=f"scenario.outputs = .*allowed {allowed}"):
            outputs_of(text)


@pytest.mark.parametrize(
    ("key", "arguments"),
    [
        ("ratios", {"ratios": (0.3, 0.5)}),
        ("ratios", {"ratios": (0.3,), "ratio_sine": (0.5, 0.4, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.5, 0.4)}),
        ("ratio_sine", {"ratio_sine": (0.5, 0.5, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.3, -0.3, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.7, 0.3, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.5, 0.4, 0.0)}),
    ],
)
def test_shares_that_do_not_fit_the_phases_or_each_other_are_named(key, arguments):
    with pytest.raises(ValueError, match=rf"scenario\.{key}.*allowed"):
        Scenario(**arguments)


def test_a_phase_has_its_own_temperature_and_the_even_one_only_where_it_gives_none():
    mixed = Scenario((0.5,) * 4, (10.0,) * 4, (None, 31.0, None, 36.0), ratios=(0.3, 0.3, 0.4, None))
    assert resting(mixed, 33.2).temperatures == (33.2, 31.0, 33.2, 36.0)
    assert (resting(STEPS, 33.2).temperatures, resting(mixed, 33.2).ratios) == (STEPS.temperatures, mixed.ratios)


def test_a_list_that_is_too_short_is_told_by_its_length():
    """`scenario.setpoints=[5]` alone, beside three minutes and temperatures of a preset."""
    with pytest.raises(ValueError, match="^scenario.setpoints, minutes, temperatures = lists of 1, 3 and 3: allowed "):
        Scenario((5.0,), (30.0,) * 3, (37.0,) * 3)
    with pytest.raises(ValueError, match="lists of 0, 0 and 0"):
        Scenario((), (), ())


def test_each_reactor_s_step_ends_by_its_own_condition():
    """Two reactors that are both settled at an OD of 0.5, of which each asks for something else in its two steps."""
    conditions = Conditions([["od >= 0.6", "settled"], ["settled", "od <= 0.5"], [None, None]])
    assert conditions.any
    od, settled = np.full(3, 0.5), np.ones(3, dtype=bool)
    for phases, met in (
        ([0, 0, 0], [False, True, False]),
        ([1, 1, 1], [True, True, False]),
        ([0, 1, 0], [False, True, False]),
        ([1, 0, 1], [True, True, False]),
    ):
        assert conditions.met(np.array(phases), od, settled).tolist() == met
    assert conditions.met(np.array([0, 0, 0]), np.array([0.6, 0.9, 0.9]), ~settled).tolist() == [True, False, False]
    assert conditions.met(np.array([1, 1, 1]), np.array([np.nan] * 3), ~settled).tolist() == [False] * 3


@pytest.mark.parametrize("unit", ["mL/h", "ml/h", "ML/H"])
def test_a_rate_is_one_however_it_is_spelt(unit):
    assert outputs_of(f"pump3 2 {unit}") == (Output(3, ml_h=2.0),)
    assert outputs_of(f"pump4 2 {unit[:2]}") == (Output(4, ml=2.0),)


def test_a_share_may_be_asked_for_in_some_phases_in_all_or_in_none():
    assert not composed(STEPS)
    lengths = {"setpoints": (0.5, 0.5), "minutes": (10.0, 10.0), "temperatures": (33.0, 33.0)}
    assert not composed(Scenario(**lengths, ratios=(None, None)))
    assert composed(Scenario(**lengths, ratios=(None, 0.3)))
    assert composed(Scenario(**lengths, ratio_sine=(0.5, 0.4, 1200.0)))
    assert Scenario(**lengths, ratios=(float("nan"), 0.3)).ratios == (None, 0.3)
