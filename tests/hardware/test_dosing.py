"""Volume to duty and back: by formula, by property, and from weighed doses."""

import math
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.chibio.calibrations import load_calibrations, save_calibration
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration, SupplyConfig, fit_pump, plan_dose
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.errors import UnfitError

FOURTH = SupplyConfig(pump4_ml_s=0.5)


def test_small_doses_are_saved_up_and_the_mean_rate_is_right() -> None:
    rate, carry, given_ml, doses = 0.00125, 0.0, 0.0, 0
    for _ in range(1000):
        plan = plan_dose(rate, carry, doses, ReactorCalibration())
        carry = plan.carry_ml
        given_ml += plan.feed_ml
        doses += plan.feed_duty > 0.0
        assert plan.feed_duty == 0.0 or plan.feed_s >= 0.3 - 1e-4
    assert given_ml + carry == pytest.approx(1000 * rate * 60.0, rel=1e-3)
    assert doses == pytest.approx(250, abs=1)


@pytest.mark.parametrize("rate", [-0.001, np.nan, np.inf])
def test_a_rate_that_is_none_is_an_error(rate: float) -> None:
    with pytest.raises(ValueError, match="pump rate"):
        plan_dose(rate, 0.0, 0, ReactorCalibration())


NOMINAL = PumpCalibration()


@pytest.mark.parametrize(
    ("rate", "carry", "doses", "feed", "waste", "feed_s", "waste_s", "left"),
    [
        (0.01, 0.0, 0, NOMINAL, NOMINAL, 0.6, 4.0 * 0.6 + 4.4, (0.0, 0.0)),
        (0.005, 0.0, 0, NOMINAL, NOMINAL, 0.3, 5.6, (0.0, 0.0)),  # the smallest dose is a dose
        (0.00499, 0.0, 0, NOMINAL, NOMINAL, 0.0, 0.0, (0.2994, 0.0)),
        (0.0053, 0.0, 0, PumpCalibration(0.8, 0.1), NOMINAL, 0.0, 0.0, (0.318, 0.0)),  # of 0.32 mL in 0.3 s
        (0.0055, 0.0, 0, PumpCalibration(0.8, 0.1), NOMINAL, 0.3125, 5.65, (0.0, 0.0)),
        (0.00499, 0.2, 0, NOMINAL, NOMINAL, 0.4994, 6.3976, (0.0, 0.0)),
        (0.0, 0.5, 0, NOMINAL, NOMINAL, 0.0, 0.0, (0.3, 0.0)),  # no more is kept than one smallest dose
        *((0.01, 0.0, k, NOMINAL, NOMINAL, 0.6, 15.75 if k % 5 == 4 else 6.8, (0.0, 0.0)) for k in range(1, 10)),
        (0.02, 0.0, 4, NOMINAL, PumpCalibration(0.1), 1.2, 18.0, (0.0, 0.0)),  # 1.5 times the feed, and a clearing
        (0.02, 0.0, 0, NOMINAL, PumpCalibration(0.1, -0.5), 1.2, 18.5, (0.0, 0.0)),
        (0.02, 0.0, 0, NOMINAL, PumpCalibration(0.05), 1.2, 31.5, (0.0, 0.0)),  # half of the period at most
        (0.02, 0.0, 0, PumpCalibration(0.8, 0.1), NOMINAL, 1.4, 10.0, (0.0, 0.0)),
        (0.02, 2.4, 0, NOMINAL, NOMINAL, 3.15, 17.0, (0.0, 0.45)),
        (0.02, 0.0, 0, PumpCalibration(flow_ml_s=0.2), NOMINAL, 3.15, 17.0, (0.0, 0.57)),
        (0.0, 0.2, 0, NOMINAL, NOMINAL, 0.0, 0.0, (0.2, 0.0)),
        (0.0, 0.0, 0, PumpCalibration(min_on_s=0.0), NOMINAL, 0.0, 0.0, (0.0, 0.0)),
    ],
)
def test_doses_worked_out_by_hand(
    rate: float, carry: float, doses: int, feed: PumpCalibration, waste: PumpCalibration, feed_s: float,
    waste_s: float, left: tuple[float, float],
) -> None:  # fmt: skip
    plan = plan_dose(rate, carry, doses, ReactorCalibration(feed, waste))
    assert (plan.feed_s, plan.waste_s) == pytest.approx((feed_s, waste_s), abs=1e-3)
    assert (plan.carry_ml, plan.shortfall_ml) == pytest.approx(left, abs=1e-9)
    assert plan.feed_s <= feed_s + 1e-9  # the duty is cut to six places
    expected = (feed.flow_ml_s * (feed_s + feed.bias_s), waste.flow_ml_s * (waste_s + waste.bias_s))
    assert feed_s == 0.0 or (plan.feed_ml, plan.waste_ml) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("key", "low", "high"),
    [("flow_ml_s", 0.05, 5.0), ("bias_s", -1.0, 1.0), ("spread", 0.0, 1.0), ("min_on_s", 0.0, 2.0)],
)
def test_ranges_of_a_pump(key: str, low: float, high: float) -> None:
    for value in (low, high):
        PumpCalibration(**{key: value})
    for value in (low - 1e-6, high + 1e-6, np.nan):
        with pytest.raises(ValueError, match=rf"pump calibration.{key} = .*: allowed {low:g} to {high:g}"):
            PumpCalibration(**{key: value})


def test_a_pump_nobody_weighed() -> None:
    assert asdict(NOMINAL) == {
        "flow_ml_s": 1.0, "bias_s": 0.0, "spread": 0.1, "min_on_s": 0.3, "date": "", "device_id": "",
    }  # fmt: skip
    weighed = PumpCalibration(date="2026-02-03")
    pairs = ((NOMINAL, NOMINAL), (weighed, NOMINAL), (NOMINAL, weighed), (weighed, weighed))
    assert [ReactorCalibration(*pair).calibrated for pair in pairs] == [False, False, False, True]
    assert PumpCalibration(0.8, 0.1).volume(0.9) == pytest.approx(0.8)
    assert PumpCalibration(0.8, 0.1).volume(0.0) == 0.0
    assert PumpCalibration(bias_s=-0.5).volume(0.2) == 0.0
    assert PumpCalibration(bias_s=0.5).on_time(0.2) == 0.0
    assert PumpCalibration(bias_s=0.5).volume(-0.1) == 0.0


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 0.05), st.floats(0.0, 0.5), st.integers(0, 100), *2 * [st.floats(0.1, 3.0)], st.floats(-0.2, 0.3))
def test_no_plan_breaks_a_limit(rate: float, carry: float, doses: int, q1: float, q2: float, bias: float) -> None:
    rig = ReactorCalibration(PumpCalibration(q1, bias), PumpCalibration(q2, bias))
    plan = plan_dose(rate, carry, doses, rig)
    assert 0.0 <= plan.feed_duty <= 0.05
    assert 0.0 <= plan.waste_duty <= 0.5
    if plan.feed_duty > 0.0:
        assert plan.waste_s >= min(4.0 * plan.feed_s + 4.0, 31.5) - 1e-3
        assert plan.feed_ml <= rate * 60.0 + carry + 1e-3
        if plan.waste_duty < 0.5:
            assert plan.waste_ml >= 1.4 * plan.feed_ml
    assert plan.feed_ml + plan.carry_ml + plan.shortfall_ml <= rate * 60.0 + carry + 1e-3


def test_the_fit_is_that_of_weighted_least_squares_with_its_covariance() -> None:
    on_s, doses = np.array([0.4, 0.8, 1.6, 2.5]), np.array([40, 20, 10, 5])
    mean = 0.85 * (on_s + 0.08) + np.array([0.02, -0.03, 0.04, -0.02])
    fit = fit_pump(on_s, doses, mean * doses, "2026-02-03", "unit")
    (slope, intercept), cov = np.polyfit(on_s, mean, 1, w=np.sqrt(doses), cov="unscaled")
    residual = mean - slope * on_s - intercept
    sigma = np.sqrt(np.sum(doses * residual**2) / 2.0)  # four series less two parameters
    by_bias = np.array([-intercept / slope**2, 1.0 / slope])  # of bias = intercept / slope, by slope and intercept
    pump = fit.calibration
    assert (pump.flow_ml_s, pump.bias_s) == pytest.approx((slope, intercept / slope))
    assert pump.spread == pytest.approx(sigma / mean.mean())
    assert fit.flow_se == pytest.approx(sigma * np.sqrt(cov[0, 0]))
    assert fit.bias_se == pytest.approx(sigma * np.sqrt(by_bias @ cov @ by_bias))
    assert (pump.min_on_s, pump.date, pump.device_id) == (0.4, "2026-02-03", "unit")


@pytest.mark.parametrize(
    ("on_s", "mean", "smallest"),
    [
        ([0.1, 0.9], [0.1, 0.9], 0.3),  # shorter ones deliver, but none under 0.3 s is believed
        ([0.5, 2.5], [0.5, 2.5], 0.5),
        ([2.2, 2.9], [2.2, 2.9], 2.0),
        ([0.1, 0.4, 0.8, 1.6], [0.001, 0.4, 0.8, 1.6], 0.4),  # a dead band
        ([0.4, 0.6, 1.0, 2.0, 4.0], [0.15, 0.34, 1.0, 2.0, 4.0], 0.6),  # 0.68 and 0.78 of the fitted line
        ([0.4, 0.6, 1.0, 2.0, 4.0], [0.15, 0.30, 1.0, 2.0, 4.0], 0.4),  # 0.72 and 0.71
    ],
)
def test_the_smallest_useful_time(on_s: list[float], mean: list[float], smallest: float) -> None:
    fit = fit_pump(np.array(on_s), np.ones(len(on_s)), np.array(mean))
    assert fit.calibration.min_on_s == pytest.approx(smallest)
    if len(on_s) == 2:  # two series fit exactly: nothing is known of the scatter
        assert fit.calibration.spread == 0.1
        assert np.isnan([fit.flow_se, fit.bias_se]).all()


@pytest.mark.parametrize(
    ("on_s", "grams", "words"),
    [
        ([1.0], [20.0], "at least 2 series"),
        ([1.0, 1.0], [20.0, 21.0], "range"),
        ([0.5, 1.0], [20.0, 10.0], "weighed less"),
        ([0.5, 1.0], [20.0, np.nan], "finite"),
        ([0.5, 1.0], [20.0, np.inf], "finite"),
        ([0.5, 1.0], [1000.0, 3000.0], "allowed"),
        ([0.5, 1.0], [20.0, 20.0], "weighed less"),
        ([0.0, 1.0], [1.0, 20.0], "must be > 0 s"),
        ([0.5, 1.0], [-0.1, 20.0], "grams >= 0"),
        ([0.5, 0.65], [10.0, 13.0], "0.50 to 0.65 s: allowed a range"),
        ([0.5, 1.0], [20.0], "2, 2, 1"),
    ],
)
def test_weighings_that_make_no_line_are_refused(on_s: list[float], grams: list[float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fit_pump(np.array(on_s), np.full(len(on_s), 20), np.array(grams))
    sound = np.array([0.5, 0.75]), np.array([20, 1]), np.array([10.0, 0.75])
    fit_pump(*sound)
    with pytest.raises(ValueError, match="doses >= 1"):
        fit_pump(sound[0], np.array([20, 0]), sound[2])


def test_a_stored_calibration_reads_back() -> None:
    pump = PumpCalibration(0.9, 0.05, 0.08, 0.4, "2026-02-03", "1000200030004000")
    assert PumpCalibration.from_dict({**asdict(pump), "weighings": []}) == pump
    for wrong in (70.0, None, "fast"):
        with pytest.raises(ValueError, match="pump calibration.flow_ml_s"):
            PumpCalibration.from_dict({"flow_ml_s": wrong})


def test_spare_pumps_have_each_their_own_flow_and_both_the_same_bias() -> None:
    """63 s of a duty of 0.05 are 3.15 s; the motor runs 0.1 s longer."""
    supply = SupplyConfig(pump3_ml_s=0.9, pump4_ml_s=0.4, bias_s=0.1)
    flows = [supply.flow_ml_s(pump) for pump in ("Pump1", "Pump2", "Pump3", "Pump4")]
    assert flows == [0.0, 0.0, 0.9, 0.4]
    assert [supply.most_ml(pump) for pump in ("Pump3", "Pump4")] == pytest.approx([0.9 * 3.25, 0.4 * 3.25])
    assert supply.calibration("Pump4").volume(1.0) == pytest.approx(0.44)
    assert (supply.pumps, SupplyConfig(pump4_ml_s=0.3).pumps) == (("Pump3", "Pump4"), ("Pump4",))


def test_each_reactor_s_pumps_and_blank_are_those_of_its_own_files(tmp_path: Path) -> None:
    feeds = {"M0": PumpCalibration(0.8, 0.02, date="2026-01-01"), "M3": PumpCalibration(0.6, date="2026-01-02")}
    waste = PumpCalibration(1.3, -0.05, 0.2, 0.5, "2026-01-03", "77")
    for name, feed in feeds.items():
        assert save_calibration(tmp_path / "new", name, "feed", asdict(feed)).name == f"{name}_feed.yaml"
    save_calibration(tmp_path / "new", "M3", "waste", asdict(waste))
    save_calibration(tmp_path / "new", "M3", "blank", {"blank": 14250.5, "sd": 30.0})
    first, third, seventh = load_calibrations(tmp_path / "new", ("M0", "M3", "M7"))
    assert (first.feed, first.waste) == (feeds["M0"], PumpCalibration())
    assert (third.feed, third.waste, third.blank) == (feeds["M3"], waste, 14250.5)
    assert [math.isnan(c.blank) for c in (first, third, seventh)] == [True, False, True]
    assert [c.calibrated for c in (first, third, seventh)] == [False, True, False]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("blank: 60001", r"calibration of M3 in .*: blank = 60001.0: allowed 3000 to 60000 counts"),
        ("blank: 2999", "blank = 2999.0"),
        ("blank: dark", "calibration of M3"),
        ("- 1", "M3_blank.yaml: no keys and values"),
        ("blank: {", "M3_blank.yaml: not readable"),
        ("blank: 60000", None),
        ("", None),
    ],
)
def test_a_blank_that_is_none_names_its_reactor(tmp_path: Path, content: str, words: str | None) -> None:
    save_calibration(tmp_path, "M0", "blank", {"blank": 12000.0})
    (tmp_path / "M3_blank.yaml").write_text(content)
    with pytest.raises(UnfitError, match=words) if words else nullcontext():
        assert load_calibrations(tmp_path, ("M0", "M3"))[0].blank == 12000.0


@pytest.mark.parametrize(
    ("config", "values", "words"),
    [
        (SupplyConfig, {"pump4_ml_s": 0.19}, "backend.supply.pump4_ml_s = 0.19: allowed 0 or 0.2 to 1.5 mL/s"),
        (SupplyConfig, {"pump3_ml_s": 1.5, "bias_s": 0.1}, "pump3_ml_s = 1.5: allowed .* at most 0.5 mL"),
        (SupplyConfig, {"pump3_ml_s": 1.5, "bias_s": 0.03}, None),
        (SupplyConfig, {"pump4_ml_s": 0.2}, None),
        (ChiBioConfig, {"stale_s": 180.0}, "backend.lost_s = 180.0 s: allowed more than stale_s = 180.0 s"),
        (ChiBioConfig, {"stale_s": 179.0}, None),
        (ChiBioConfig, {"overflow_pump": OverflowPumpConfig("Pump4", 0.5), "supply": FOURTH}, "supply = Pump4: "),
        (ChiBioConfig, {"overflow_pump": OverflowPumpConfig("Pump3", 0.5), "supply": FOURTH}, None),
    ],
)
def test_settings_that_forbid_one_another_are_named(config: Any, values: dict[str, Any], words: str | None) -> None:
    with pytest.raises(ValueError, match=words) if words else nullcontext():
        config(**values)
