"""The window of a calibration, what it is good for, and what rows tell that cannot tell tau."""

import re
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.identification.calibration import Calibration, IdentifyConfig, calibrate
from envs.identification.drift import Drift, Segment, cuts, drift
from envs.identification.model import NotIdentifiable, Parameter
from envs.identification.screening import WEEK_MIN, Series, merged
from envs.identification.validation import Validation, attainable_pct
from envs.identification.verdict import check_estimate, growth_alone, judged
from tests.studies.second_simulator import Conditions, simulate

pytestmark = pytest.mark.numeric

Array = NDArray[np.float64]


def recorded(law: str, seed: int = 5, **conditions: object) -> Series:
    """One recording of the second simulator."""
    r = simulate(Conditions(law=law, **conditions), 1, seed)  # type: ignore[arg-type]
    return Series(r.time, r.od[0], r.pump_rate[0], np.arange(len(r.time)))


def stepped(hours: float, at: float, before: float, after: float) -> Series:
    """On-off control of a culture whose growth steps from one rate to another; 1 % noise, gain of 0.7."""
    rng, od, rate, x = np.random.default_rng(4), [], [], 0.5
    time = np.arange(60.0 * hours + 1.0)
    for t in time:
        od.append(x * (1.0 + 0.01 * rng.standard_normal()))
        rate.append(0.02 if od[-1] > 0.5 else 0.0)
        dose = rate[-1] * 0.7 * 3.0 * (1.0 + 0.1 * rng.standard_normal())
        x *= np.exp((before if t < 60.0 * at else after) - dose)
    return Series(time, np.array(od), np.array(rate), np.arange(len(time)))


@cache
def good() -> Calibration:
    return calibrate(recorded("open_loop"))


def test_a_good_recording_is_to_be_used() -> None:
    result = good()
    assert (result.verdict.word, result.verdict.then, result.warnings) == ("use", "", ())
    assert result.verdict.line().startswith("use: mu is known within +-")
    assert result.tau.low <= 1 / 3 <= result.tau.high


def test_a_doubt_about_the_recording_comes_first() -> None:
    result = calibrate(recorded("open_loop"), doubts=(("pump 3 ran and is not counted", "say pumps=[1,3]"),))
    assert (result.verdict.word, result.verdict.then) == ("use with care", "say pumps=[1,3]")
    assert result.warnings == ("pump 3 ran and is not counted; say pumps=[1,3]",)


def test_a_window_ends_where_growth_steps() -> None:
    """Five hours at 0.03, nine at 0.02: the mean of both would be true of neither."""
    result = calibrate(stepped(14.0, 5.0, 0.03, 0.02))
    first, end = result.window_rows
    assert first >= 240
    assert end == 841
    assert result.mu.low <= 0.02 <= result.mu.high
    assert result.tau.low <= 1.0 / 2.1 <= result.tau.high
    assert result.verdict.word == "use with care"


@pytest.mark.slow
def test_growth_that_wanders_is_no_step() -> None:
    for seed in range(4):
        result = calibrate(recorded("threshold", seed, hours=14.0, wander=0.1))
        assert result.window == (0, 841)


def test_doses_that_spread_and_a_vial_that_mixes_slowly_are_told() -> None:
    uneven = calibrate(recorded("random", dose_spread=0.45, hours=9.0))
    assert any("doses vary by" in w and "calibrate_pump" in w for w in uneven.warnings)
    late = calibrate(recorded("random", late_share=0.9, hours=9.0))
    assert any("is missing from the next reading" in w and "stir faster" in w for w in late.warnings)
    assert late.estimate.quality.late_share.low <= 0.9 <= late.estimate.quality.late_share.high


@pytest.mark.slow
@pytest.mark.parametrize("wander", [0.0, 0.1])
def test_the_report_has_the_spread_of_doses_and_growth(wander: float) -> None:
    """The mean over an hour of growth that forgets in 30 min has the sd of its formula."""
    draws = [calibrate(recorded("random", seed, wander=wander, dose_spread=0.2, hours=24.0)) for seed in (5, 6, 7)]
    q = draws[0].estimate.quality
    found = np.mean([c.estimate.quality.growth_spread.value for c in draws])
    hourly = wander * np.sqrt(2.0 * 0.5 * (1.0 - 0.5 * (1.0 - np.exp(-2.0))))
    assert q.dose_spread.value == pytest.approx(0.2, rel=0.25)
    assert q.growth_spread.low <= hourly + 0.01
    assert q.growth_spread.high >= hourly
    assert found == pytest.approx(hourly, abs=0.012)


def test_feedback_is_the_change_of_the_rate_that_a_reading_brings() -> None:
    """The device's PI answers each reading at once; the open-loop protocol answers none."""
    assert calibrate(recorded("pi")).estimate.quality.feedback > 0.5
    assert abs(good().estimate.quality.feedback) < 0.15


def test_rows_are_named_by_their_numbers_and_settings_reach_their_place() -> None:
    series = recorded("open_loop")
    every_third = Series(series.time, series.od, series.pump_rate, 3 * series.row + 40)
    near = calibrate(every_third, IdentifyConfig(horizon_min=25.0))
    assert near.window_rows == (40, 3 * 360 + 41)
    assert near.validation.holdout_pct is not None
    assert good().validation.holdout_pct is not None
    assert near.validation.holdout_pct < good().validation.holdout_pct


def test_segments_of_a_stretch_that_begins_late_are_equally_long() -> None:
    time = 1000.0 + 2.0 * np.arange(301)
    series = Series(time, np.full(301, 0.5), np.zeros(301), np.arange(301))
    assert cuts(series, 61, 301, 120.0) == [(61, 121), (121, 181), (181, 241), (241, 301)]


def known(value: float, half: float) -> Parameter:
    return Parameter(value, value - half, value + half)


def quality(**changes: object) -> SimpleNamespace:
    """Of a fit against which nothing speaks, with changes."""
    sound = {
        "answers": False, "autocorrelation": 0.1, "late_share": known(0.3, 0.2), "dose_spread": known(0.2, 0.1),
        "growth_spread": known(0.1, 0.05), "hills": 1.0,
    }  # fmt: skip
    return SimpleNamespace(**(sound | changes))


def judgement(minutes: float = 90.0, apart: float = 1.0, **changes: object) -> tuple[str, tuple[str, ...]]:
    """Word of the verdict on a good fit with changes, and all that speaks against it; predictions may miss by 0.5 %."""
    good_one = {
        "mu": known(0.02, 0.001), "tau": known(0.3, 0.02), "estimate": SimpleNamespace(quality=quality()),
        "method": "prediction_error", "sound": True, "pmse_pct": 3.0, "drift_mu": None, "drift_tau": None,
        "inside": SimpleNamespace(time=np.arange(7.0, 7.0 + minutes + apart, apart)),
        "validation": Validation(0.4, 0.1, 50, 0.4, 70),
    }  # fmt: skip
    verdict, against = judged(SimpleNamespace(**(good_one | changes)), 0.5)  # type: ignore[arg-type]
    return verdict.word, against


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ({"mu": known(0.06, 0.001)}, {"mu": known(0.07, 0.001)}, "mu = 0.07 is outside the usual range 0.001 to 0.06"),
        ({"tau": known(0.05, 0.004)}, {"tau": known(2.4, 0.1)}, "tau = 2.4 is outside the usual range 0.05 to 2"),
        ({"apart": 2.0}, {"apart": 3.0}, "rows are 3 min apart"),
        ({"minutes": 60.0}, {"minutes": 59.0}, "the window lasts 59 min"),
        (
            {"validation": Validation(0.9, 0.5, 9, 0.9, 9)},
            {"validation": Validation(0.4, 0.1, 9, 0.6, 9)},
            "the rows outside the window are predicted with a PMSE of 0.6 %, allowed 0.5 %",
        ),
        (
            {"validation": Validation(0.9, 0.5, 9, None, 0)},
            {"validation": Validation(0.9, 0.4, 9, None, 0)},
            "the window's last 30 % are predicted with a PMSE of 0.9 %, allowed 0.8 %",
        ),
        (
            {"drift_tau": Drift(0.3, 0.39, 30.0, known(0.01, 0.011), 5)},
            {"drift_tau": Drift(0.3, 0.24, -20.0, known(-0.01, 0.009), 5)},
            r"tau drifts from 0.3 to 0.24 \(-20 %\) in the recording",
        ),
        (
            {"drift_mu": Drift(0.02, 0.0219, 9.5, known(0.01, 0.001), 5)},
            {"drift_mu": Drift(0.02, 0.022, 10.0, known(0.01, 0.001), 5)},
            r"mu drifts from 0.02 to 0.022 \(\+10 %\)",
        ),
        ({"tau": known(0.3, 0.03)}, {"tau": known(0.3, 0.031)}, r"wider than \+-10 %"),
        (
            {"estimate": SimpleNamespace(quality=quality(growth_spread=known(0.3, 0.15)))},
            {"estimate": SimpleNamespace(quality=quality(growth_spread=known(0.3, 0.1)))},
            "growth rate fluctuates by at least 20 % from hour to hour",
        ),
        (
            {"estimate": SimpleNamespace(quality=quality(late_share=known(0.7, 0.2)))},
            {"estimate": SimpleNamespace(quality=quality(late_share=known(0.7, 0.1)))},
            "at least 60 % of a dose is missing",
        ),
        (
            {"estimate": SimpleNamespace(quality=quality(autocorrelation=-0.2))},
            {"estimate": SimpleNamespace(quality=quality(autocorrelation=-0.31))},
            r"innovations are correlated \(-0.31\)",
        ),
        (
            {"sound": False, "estimate": SimpleNamespace(quality=quality(dose_spread=known(0.5, 0.1)))},
            {"sound": True, "estimate": SimpleNamespace(quality=quality(dose_spread=known(0.5, 0.1)))},
            "doses vary by at least 40 %",
        ),
        (
            {"method": "free_run", "pmse_pct": 0.5},
            {"method": "free_run", "pmse_pct": 0.6},
            "PMSE 0.6 % exceeds 0.5 %",
        ),
        (
            {"method": "free_run", "pmse_pct": 0.1},
            {"method": "free_run", "pmse_pct": 0.1, "sound": False},
            "the pump responds to the readings",
        ),
    ],
)
def test_what_speaks_against_a_pair_is_told_from_its_limit_on(right, wrong, words) -> None:  # type: ignore[no-untyped-def]
    assert judgement(**right) == ("use", ())
    word, (said,) = judgement(**wrong)
    assert word == "use with care"
    assert re.search(words, said), said


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, None),
        ({"inverse_tau": known(3.0, 0.9)}, None),
        ({"inverse_tau": known(3.0, 1.0)}, r"1/tau = 3 with the 95 % interval 2 to 4; allowed \+-30 %"),
        ({"inverse_tau": known(-0.1, 1.1)}, "too little dilution to distinguish it"),
        ({"condition": 2e8}, "the pump rate hardly changes"),
        ({"quality": quality(hills=3.5)}, "it varies 3.5 times as much"),
        ({"quality": quality(hills=3.5), "inverse_tau": known(3.0, 0.2)}, None),
        ({"mu": known(0.07, 0.001)}, None),
        ({"mu": known(0.07, 0.001), "quality": quality(answers=True)}, "mu = 0.07 1/min, allowed 0.001 to 0.06"),
    ],
)
def test_an_estimate_is_refused_from_its_limit_on(changes, words) -> None:  # type: ignore[no-untyped-def]
    found = {"mu": known(0.02, 0.001), "inverse_tau": known(3.0, 0.5), "condition": 1e3, "quality": quality()} | changes
    rows = Series(np.arange(3.0), np.full(3, 0.5), np.zeros(3), np.arange(11, 14))
    if words is None:
        check_estimate(SimpleNamespace(**found), rows)  # type: ignore[arg-type]
        return
    with pytest.raises(NotIdentifiable, match=f"rows 11-13: .*{words}"):
        check_estimate(SimpleNamespace(**found), rows)  # type: ignore[arg-type]


def test_a_line_through_segments_rises_per_hour_and_heeds_how_well_each_is_known() -> None:
    """0.02 + 0.002 an hour at hours 1, 2, 4 and 5; one that is far off and hardly known bends it little."""
    hours, along = (1.0, 2.0, 4.0, 5.0, 6.0), []
    for hour in hours:
        along.append(Segment(0, 1, 60.0 * hour, None, None))
    on_line = [known(0.02 + 0.002 * hour, 0.0196) for hour in hours[:4]]
    line = drift(tuple(along), [*on_line, None])
    assert line is not None
    assert (line.first, line.last, line.segments) == (pytest.approx(0.022), pytest.approx(0.03), 4)
    assert line.change_pct == pytest.approx(100.0 * 8.0 / 22.0)
    assert line.slope_per_h.value == pytest.approx(0.002)
    # sd 0.01 of each; the squares of their distances from the middle sum to 4 + 1 + 1 + 4; t of two degrees is 4.303
    assert line.slope_per_h.half_width == pytest.approx(4.303 * 0.01 / np.sqrt(10.0), rel=1e-3)
    assert not line.significant
    bent = drift(tuple(along), [*on_line, known(0.132, 1.96)])
    assert bent is not None
    assert bent.slope_per_h.value == pytest.approx(0.002, rel=0.01)
    assert drift(tuple(along), [*on_line[:3], None, None]) is None


def test_what_disturbances_make_of_a_prediction_by_hand() -> None:
    """Rows two minutes apart, 10 in the horizon; doses of 0, 0.06 and 0.08 of the OD, off by 30 %, growth by 10 %."""
    found = SimpleNamespace(
        inverse_tau=known(4.0, 0.1), mu=known(0.03, 0.001), quality=quality(dose_spread=known(0.3, 0.0))
    )
    rates = np.array([0.0, 0.0075, 0.01, 0.02])
    part = Series(2.0 * np.arange(4.0), np.full(4, 0.5), rates, np.arange(4))
    doses = 0.5 * 10.0 * (0.06**2 + 0.08**2) / 3.0 * 0.09
    expected = 100.0 * (doses + (0.03 * 0.1 * 20.0) ** 2 / 3.0)
    assert attainable_pct(found, part, 20.0) == pytest.approx(expected)  # type: ignore[arg-type]


# ---------------------------------------------------------------- where tau cannot be told


def batch(pump: float = 0.0) -> Series:
    """Growth at 0.012 under a constant rate."""
    time = np.arange(0.0, 300.0)
    noise = 1.0 + 0.01 * np.random.default_rng(3).standard_normal(300)
    od = 0.1 * np.exp((0.012 - pump / 0.4) * time) * noise
    return Series(time, od, np.full(300, pump), np.arange(300) + 7)


def test_growth_alone_of_a_culture_that_is_not_fed() -> None:
    with pytest.raises(NotIdentifiable, match="the pump never runs") as refused:
        calibrate(batch())
    assert refused.value.remedy == "record while the pump runs and stops"
    alone = growth_alone(batch())
    assert alone is not None
    assert alone.mu is not None
    assert alone.mu_rows == (7, 307)
    assert alone.mu.low <= 0.012 <= alone.mu.high
    assert alone.mu.half_width < 0.0003
    assert alone.words().startswith("mu is 0.01")


def test_net_growth_of_a_culture_under_a_constant_rate() -> None:
    with pytest.raises(NotIdentifiable, match=r"runs at 0.003 mL/s in nearly all rows"):
        calibrate(batch(0.003))
    alone = growth_alone(batch(0.003))
    assert alone is not None
    assert alone.mu is None
    assert alone.net.low <= 0.012 - 0.0075 <= alone.net.high
    assert alone.net.half_width < 0.0001
    assert f"net growth is {alone.net.value:.5f} (95 %" in alone.words()


def test_growth_alone_from_the_rest_before_a_law_that_hides_tau() -> None:
    """An hour and a half of growth, then a rate in proportion to the OD: tau is refused, mu is told from the rest."""
    later = recorded("proportional", hours=6.0)
    time = np.arange(0.0, 90.0)
    before = later.od[0] * np.exp(0.03 * (time - 90.0)) * (1.0 + 0.01 * np.random.default_rng(1).standard_normal(90))
    whole = Series(
        np.concatenate([time, 90.0 + later.time]),
        np.concatenate([before, later.od]),
        np.concatenate([np.zeros(90), later.pump_rate]),
        np.arange(90 + len(later.time)),
    )
    alone = growth_alone(whole)
    assert alone is not None
    assert alone.mu is not None
    assert alone.mu_rows == (0, 90)
    assert alone.mu.low <= 0.03 <= alone.mu.high
    assert "where the pump was off; the culture's net growth is" in alone.words()


def test_growth_alone_waits_until_the_last_dose_is_seen() -> None:
    time = np.arange(0.0, 121.0)
    rate = np.where(time < 30.0, 0.02, 0.0)
    volume = np.concatenate([[0.0], np.cumsum(rate[:-1])])
    od = 0.8 * np.exp(0.03 * time - volume / 0.5) * (1.0 + 0.005 * np.random.default_rng(6).standard_normal(121))
    alone = growth_alone(Series(time, od, rate, np.arange(121)))
    assert alone is not None
    assert alone.mu is not None
    assert alone.mu_rows == (32, 121)
    assert alone.mu.low <= 0.03 <= alone.mu.high


# ---------------------------------------------------------------- fine rows


def test_rows_that_are_few_or_slow_stay_as_they_are() -> None:
    few = recorded("random")
    assert merged(few) is few
    n = 11000
    slow = Series(0.7 * np.arange(n), np.full(n, 0.5), np.zeros(n), np.arange(n))
    assert merged(slow) is slow


def test_seed_of_the_average_is_a_setting() -> None:
    series = recorded("open_loop")
    again, other = calibrate(series), calibrate(series, IdentifyConfig(seed=7))
    assert again.tau == good().tau
    assert other.tau != again.tau
    assert other.tau.value == pytest.approx(again.tau.value, abs=0.25 * again.tau.half_width)


MU, TAU = 0.009, 0.27


def culture(
    rate: np.ndarray, mu: np.ndarray | float = MU, works: np.ndarray | float = 1.0, noise: float = 0.01
) -> Series:
    """A culture by the minute under recorded pump rates, of which the share `works` reaches the vial."""
    rise = mu * np.ones(rate.size) - works * rate / TAU
    log_od = np.log(0.4) + np.concatenate([[0.0], np.cumsum(rise[:-1])])
    od = np.exp(log_od) * (1.0 + noise * np.random.default_rng(5).standard_normal(rate.size))
    return Series(np.arange(float(rate.size)), od, rate, np.arange(rate.size))


def doses(minutes: int, every: int = 50, share: float = 0.2) -> np.ndarray:
    """Pulses that balance growth on average."""
    return np.where(np.arange(minutes) % every < share * every, MU * TAU / share, 0.0)


def test_a_window_ends_where_the_feed_fails() -> None:
    """From row 960 on the pump is recorded at twice its mean, but nothing reaches the vial, and cells die."""
    rate = np.concatenate([doses(960), np.full(360, 2.0 * MU * TAU)])
    minute = np.arange(rate.size)
    mu = np.select([minute < 960, minute < 1100], [MU, 0.0], -0.002)
    raw = culture(rate, mu, np.where(minute < 960, 1.0, 0.0))
    found = calibrate(raw)
    assert found.window[1] <= 960
    assert found.tau.value == pytest.approx(TAU, rel=0.05)
    with pytest.raises(NotIdentifiable):
        calibrate(raw, IdentifyConfig(window="all"))


def test_a_window_holds_doses() -> None:
    """Growth alone lasts longer; an hour's pause parts it from the dosed rows."""
    grown = culture(np.zeros(500), 0.001)
    dosed = culture(doses(330))
    whole = Series(
        np.concatenate([grown.time, 560.0 + dosed.time]),
        np.concatenate([grown.od, dosed.od]),
        np.concatenate([grown.pump_rate, dosed.pump_rate]),
        np.arange(830),
    )
    found = calibrate(whole)
    assert found.window == (500, 830)
    assert found.tau.value == pytest.approx(TAU, rel=0.05)


@pytest.mark.parametrize("odd", [0.9, 0.0])
def test_two_odd_rates_refuse_no_recording_and_tell_no_tau(odd: float) -> None:
    rate = doses(330)
    rate[[7, 209]] = odd
    works = np.ones(330)
    works[[7, 209]] = 0.003 if odd else 1.0
    assert calibrate(culture(rate, works=works)).tau.value == pytest.approx(TAU, rel=0.2)
    level = np.full(330, 0.003)
    level[[7, 209]] = odd
    with pytest.raises(NotIdentifiable):
        calibrate(culture(level))


def test_a_merged_minute_keeps_the_order_of_reading_and_dose() -> None:
    """One reading a minute, at second 6 or 54, and a dose of 3 s at second 30: x is the model's at every row."""
    n = 3 * WEEK_MIN
    time, second = np.arange(n) / 20.0, np.arange(n) % 20 * 3
    rate = np.where(second == 30, 0.05, 0.0)
    log_od = 0.3 * MU * time - np.concatenate([[0.0], np.cumsum(rate[:-1] / 20.0)]) / TAU
    early = (time // 1.0) % 7 < 3
    od = np.where(second == np.where(early, 6, 54), np.exp(log_od), np.nan)
    found = merged(Series(time, od, rate, np.arange(n)))
    volume = np.concatenate([[0.0], np.cumsum(found.pump_rate[:-1] * np.diff(found.time))])
    left = np.log(found.od) - 0.3 * MU * found.time + volume / TAU
    np.testing.assert_allclose(left, left[0], atol=1e-9)
