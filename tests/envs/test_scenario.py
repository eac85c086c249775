"""Schedules as functions of time."""

import numpy as np
import pytest

from envs.scenario import Scenario

STEPS = Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 30.0), recovery_od=0.8)


def test_phases_change_at_their_edges():
    minute = np.array([np.nan, -1.0, 0.0, 29.99, 30.0, 59.0, 60.0, 90.0, 500.0])
    np.testing.assert_array_equal(STEPS.phase(minute), [-1, -1, 0, 0, 1, 1, 2, 2, 2])
    setpoint, temperature = STEPS.at(minute)
    np.testing.assert_array_equal(setpoint, [0.8, 0.8, 0.8, 0.8, 0.65, 0.65, 0.5, 0.5, 0.5])
    assert temperature[-1] == 30.0
    assert STEPS.total_min == 90.0


@pytest.mark.parametrize(
    ("key", "arguments"),
    [
        ("setpoints, minutes", {"setpoints": (0.5,), "minutes": (1.0, 2.0)}),
        ("setpoints", {"setpoints": (5.0,)}),
        ("minutes", {"minutes": (0.0,)}),
        ("temperatures", {"temperatures": (99.0,)}),
        ("recovery_od", {"recovery_od": -1.0}),
        ("recovery_limit_min", {"recovery_limit_min": 0.0}),
        ("ratios", {"ratios": (0.0,)}),
        ("ratios", {"ratios": (1.0,)}),
        ("ratios", {"ratios": (0.3, 0.5)}),
        ("ratios", {"ratios": (0.3,), "ratio_sine": (0.5, 0.4, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.5, 0.4)}),
        ("ratio_sine", {"ratio_sine": (0.5, 0.5, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.3, -0.3, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.7, 0.3, 1200.0)}),
        ("ratio_sine", {"ratio_sine": (0.5, 0.4, 0.0)}),
        ("announce_min", {"announce_min": 1441.0}),
    ],
)
def test_values_out_of_range_are_named(key, arguments):
    with pytest.raises(ValueError, match=rf"scenario\.{key}.*allowed"):
        Scenario(**arguments)


def test_a_share_may_be_asked_for_in_some_phases_in_all_or_in_none():
    assert not STEPS.composed
    lengths = {"setpoints": (0.5, 0.5), "minutes": (10.0, 10.0), "temperatures": (33.0, 33.0)}
    assert not Scenario(**lengths, ratios=(None, None)).composed
    assert Scenario(**lengths, ratios=(None, 0.3)).composed
    assert Scenario(**lengths, ratio_sine=(0.5, 0.4, 1200.0)).composed
    assert Scenario(**lengths, ratios=(float("nan"), 0.3)).ratios == (None, 0.3)
