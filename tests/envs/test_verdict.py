"""What a calibration is good for, in its first line; what rows tell that cannot tell tau; long and fine recordings."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.identification.calibration import Calibration, IdentifyConfig, calibrate
from envs.identification.drift import cuts
from envs.identification.model import NotIdentifiable
from envs.identification.open_loop import OpenLoop
from envs.identification.refusal import growth_alone
from envs.identification.screening import Series, merged
from experiments.calibration.study import against_truth
from tests.studies.second_simulator import Conditions, simulate

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


def test_a_wide_interval_asks_for_rests_of_the_pump() -> None:
    verdict = calibrate(recorded("pi")).verdict
    assert verdict.word == "use with care"
    assert "wider than +-10 %" in verdict.why
    assert "stopped for 10 min every hour" in verdict.then


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


def test_growth_that_wanders_is_no_step() -> None:
    for seed in range(4):
        result = calibrate(recorded("threshold", seed, hours=14.0, wander=0.1))
        assert result.window == (0, 841)


def test_doses_that_spread_and_a_vial_that_mixes_slowly_are_told() -> None:
    uneven = calibrate(recorded("random", dose_spread=0.45, hours=9.0))
    assert any("doses spread by" in w and "calibrate_pump" in w for w in uneven.warnings)
    late = calibrate(recorded("random", late_share=0.9, hours=9.0))
    assert any("the next reading does not see" in w and "stir faster" in w for w in late.warnings)
    assert late.estimate.quality.late_share.low <= 0.9 <= late.estimate.quality.late_share.high


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
    assert refused.value.remedy == "record with a pump that runs and rests"
    alone = growth_alone(batch())
    assert alone is not None
    assert alone.mu is not None
    assert alone.mu_rows == (7, 307)
    assert alone.mu.low <= 0.012 <= alone.mu.high
    assert alone.mu.half_width < 0.0003
    assert alone.words().startswith("mu alone is 0.01")


def test_net_growth_of_a_culture_under_a_constant_rate() -> None:
    with pytest.raises(NotIdentifiable, match=r"never stops nor changes its rate \(always 0.003 mL/s\)"):
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
    assert "where the pump rested; the culture's net growth is" in alone.words()


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


def test_rows_of_a_second_are_merged_to_minutes_that_keep_the_volume() -> None:
    rng = np.random.default_rng(2)
    n = 4 * 3600
    time = np.arange(n) / 60.0
    rate = np.where(rng.random(n // 30).repeat(30) < 0.4, 0.02, 0.0)
    volume = np.concatenate([[0.0], np.cumsum(rate[:-1] / 60.0)])
    od = 0.4 * np.exp(0.02 * time - volume / 0.4) * (1.0 + 0.02 * rng.standard_normal(n))
    od[::97] = np.nan
    fine = Series(time, od, rate, np.arange(n))
    coarse = merged(fine)
    assert len(coarse.time) == 240
    assert np.diff(coarse.time) == pytest.approx(1.0)
    assert coarse.row[:3].tolist() == [0, 60, 120]
    moved = np.sum(coarse.pump_rate[:-1] * np.diff(coarse.time))
    first, last = (round(60.0 * float(t)) for t in coarse.time[[0, -1]])
    assert moved == pytest.approx(volume[last] - volume[first], rel=1e-9)
    truth = 0.4 * np.exp(0.02 * coarse.time - np.interp(coarse.time, time, volume) / 0.4)
    assert np.median(np.abs(coarse.od / truth - 1.0)) < 0.004
    found = calibrate(coarse)
    assert found.mu.low <= 0.02 <= found.mu.high
    assert found.tau.low <= 0.4 <= found.tau.high


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


def test_protocol_of_the_first_simulator_is_the_second_ones() -> None:
    """Two simulators of one law that share no code: the same estimate on average."""
    from experiments.calibration.config import CalibrateConfig
    from experiments.calibration.study import simulated

    config = CalibrateConfig(protocol=OpenLoop(mu=0.03, tau=1 / 3, dose_cv=0.1, growth_cv=0.05, seed=2))
    time, od, rate, _ = simulated(config, 8)
    first = [calibrate(Series(time, od[i], rate[i], np.arange(len(time)))) for i in range(8)]
    r = simulate(Conditions(law="open_loop"), 8, 2)
    second = [calibrate(Series(r.time, r.od[i], r.pump_rate[i], np.arange(len(r.time)))) for i in range(8)]
    for found in (first, second):
        assert np.mean([c.tau.value for c in found]) == pytest.approx(1 / 3, rel=0.03)
    widths = [float(np.median([c.tau.half_width for c in found])) for found in (first, second)]
    assert widths[0] == pytest.approx(widths[1], rel=0.35)


def test_a_refused_recording_shifts_no_truth() -> None:
    found = ["no tau", good()]
    growth = np.array([0.5, good().mu.value])
    numbers = against_truth(found, growth, np.array([0.1, good().tau.value]))
    assert (numbers["refused"], numbers["wrong_pct"]) == (1, 0.0)
    assert numbers["coverage_pct"] == {"mu": 100.0, "tau": 100.0}
    assert numbers["median_bias_pct"] == pytest.approx({"mu": 0.0, "tau": 0.0})
    far = against_truth(found, 1.5 * growth, np.array([0.1, good().tau.value]))
    assert far["wrong_pct"] == 50.0
