"""The composition's estimator against a dense reference, the plant's truth, and what may not move it."""

from dataclasses import replace

import numpy as np
import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from experiments.coculture.comparison import ShareCell
from experiments.coculture.estimator import (
    BIAS_E,
    BIAS_P,
    FACTOR,
    GAIN,
    LOG_F,
    LOG_OD,
    LOG_Q,
    LOGIT,
    OFFSET,
    THERMOMETER,
    CompositionEstimator,
    CompositionEstimatorConfig,
)
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.trials import run_cell
from tests.two_species import e_coli_rate, p_putida_rate, steady_production

pytestmark = pytest.mark.numeric

NAN = float("nan")
SURE = ("growth_sd", "pigment_sd", "bias_walk", "dose_cv", "gain_sd", "factor_sd", "offset_sd", "factor_walk")
QUIET = CompositionEstimatorConfig(**dict.fromkeys((*SURE, "thermometer_sd", "production_first_sd"), 0.0), starts=1)
SMALL = replace(
    QUIET, share_sd=0.02, bias_sd=0.01, pigment_first_sd=0.02, production_first_sd=0.01, thermometer_sd=0.01
)
WARM = 35.0  # degC, where the two grow by very different rates
DOSE_ML = 0.3


def readings(theta, minutes):
    """OD and light by minute, in the species' own densities.

    theta: logit, ln OD, ln pigment over balance, biases, ln production over its balance, error of the thermometer.
    """
    logit, log_od, more, bias_e, bias_p, faster, warmer = (*theta, 0.0, 0.0)[:7]
    true = WARM + warmer
    share = 1.0 / (1.0 + np.exp(-logit))
    e, p = np.exp(log_od) * (1.0 - share), np.exp(log_od) * share
    grow_e = (1.0 + bias_e) * float(e_coli_rate(true)) / 60.0
    grow_p = (1.0 + bias_p) * float(p_putida_rate(true)) / 60.0
    per_minute = float(steady_production(true)) / 60.0
    f = np.exp(more) * float(steady_production(WARM)) * 0.5 * 0.5 / float(p_putida_rate(WARM))
    seen = [(e + p, QUIET.factor * (f + 150.0 * (e + p)) + QUIET.offset)]
    for k in range(minutes):
        kept = np.exp(-DOSE_ML / 20.0)
        f = (f + per_minute * np.exp(faster * np.exp(-k / 63.0)) * p * np.exp(0.5 * grow_p)) * kept
        e, p = e * np.exp(grow_e) * kept, p * np.exp(grow_p) * kept
        seen.append((e + p, QUIET.factor * (f + 150.0 * (e + p)) + QUIET.offset))
    return np.array(seen)


def follow(estimator, seen, warm=WARM):
    for k, (od, light) in enumerate(seen):
        estimator.watch(*(np.array([v]) for v in (od, light, warm, float(k))), rows=np.array([True]))
        estimator.dosed(np.array([DOSE_ML]))


def test_it_is_the_dense_solution_where_everything_is_nearly_linear():
    """Unknown are seven numbers of the beginning; all readings at once, by normal equations with numerical slopes."""
    minutes, prior = 240, np.array([0.0, np.log(0.5), 0.0, 0.0, 0.0, 0.0, 0.0])
    truth = prior + np.array([0.02, 0.0, -0.015, 0.008, -0.006, 0.007, -0.008])
    seen = readings(truth, minutes)
    slope = np.stack(
        [(readings(prior + h, minutes) - readings(prior - h, minutes)) / 2e-5 for h in 1e-5 * np.eye(7)], axis=-1
    )
    noise = np.array([SMALL.od_sd, SMALL.fluorescence_sd])
    # The first guess of the pigment goes with that of the share and of the OD: ln f = ln p + ln(g / mu) + 'more'.
    joint = np.eye(7)
    joint[2, 0], joint[2, 1] = 0.5, 1.0
    sds = [SMALL.share_sd, SMALL.od_sd / 0.5, SMALL.pigment_first_sd, SMALL.bias_sd, SMALL.bias_sd]
    spread = np.diag(np.square([*sds, SMALL.production_first_sd, SMALL.thermometer_sd]))
    first = joint @ spread @ joint.T
    weighted = slope / noise[:, None]
    weighted[0, 0] = 0.0  # the first OD is the prior's
    flat = weighted.reshape(-1, 7)
    cov = np.linalg.inv(np.linalg.inv(first) + flat.T @ flat)
    surprise = ((seen - readings(prior, minutes)) / noise).reshape(-1)
    mean = prior + cov @ (flat.T @ surprise)

    estimator = CompositionEstimator(SMALL)
    follow(estimator, seen)
    hours = minutes / 60.0
    steeper = (p_putida_rate(WARM + 1e-4) - p_putida_rate(WARM - 1e-4)) / 2e-4 - 0.07727
    grown = hours * np.array([-float(e_coli_rate(WARM)), float(p_putida_rate(WARM))])
    last = np.array([1.0, 0.0, 0.0, *grown, 0.0, hours * float(steeper)])
    drift = hours * (float(p_putida_rate(WARM)) - float(e_coli_rate(WARM)))
    sd = np.sqrt(last @ cov @ last)
    assert estimator.mean[0, 0, LOGIT] == pytest.approx(last @ mean + drift, abs=0.05 * sd)
    assert np.sqrt(estimator.cov[0, 0, LOGIT, LOGIT]) == pytest.approx(sd, rel=0.02)
    ours, dense = [BIAS_E, BIAS_P, THERMOMETER], [3, 4, 6]
    np.testing.assert_allclose(estimator.mean[0, 0, ours], mean[dense], atol=0.15 * np.sqrt(cov[3, 3]))
    found, exact = estimator.cov[0, 0][np.ix_(ours, ours)], cov[np.ix_(dense, dense)]
    np.testing.assert_allclose(found, exact, rtol=0.15, atol=0.02 * np.diag(exact).max())


def closed_loop(plant, calibrated):
    schedule = Scenario((0.5,) * 4, (60.0, 360.0, 600.0, 600.0), (33.2,) * 4, ratios=(None, 0.3, 0.7, 0.3))
    scenarios = {"steps": schedule}
    benchmark = frame.load(frame.compose("benchmark", ["replicates=32"]), BenchmarkConfig())
    config = replace(benchmark, scenarios=scenarios)
    return run_cell(config, ShareCell("proportional", plant, "steps", "share", "inverse", False, calibrated), None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "calibrated", "most", "rms"),
    [
        ("coculture", True, 0.99, 0.015),
        ("coculture_uncalibrated", False, 1.0, 0.04),
        ("coculture_mixed", False, 1.0, 0.05),
    ],
)
def test_its_band_covers_the_truth_as_often_as_it_says(plant, calibrated, most, rms):
    """Where the sensor is not calibrated its constants are drawn from a range that ends within two sds: more often."""
    found = closed_loop(plant, calibrated)
    after = slice(60, None)  # the first guess is the plant's own start here, which is no merit
    inside = (found.low <= found.share) & (found.share <= found.high)
    assert 0.9 <= inside[:, after].mean() <= most
    assert np.sqrt(np.square(found.estimate - found.share)[:, after].mean()) < rms


def test_what_is_considered_never_moves_and_always_counts():
    seen = readings([0.4, np.log(0.5), 0.0, 0.0, 0.0], 300)
    sure, unsure = CompositionEstimator(QUIET), CompositionEstimator(replace(QUIET, factor_sd=0.13, offset_sd=45.0))
    for estimator in (sure, unsure):
        follow(estimator, seen)
        assert estimator.mean[0, 0, FACTOR] == QUIET.factor
        assert estimator.mean[0, 0, OFFSET] == QUIET.offset
    assert unsure.cov[0, 0, FACTOR, FACTOR] == pytest.approx(0.13**2, rel=1e-9)
    assert unsure.cov[0, 0, OFFSET, OFFSET] == pytest.approx(45.0**2, rel=1e-9)
    assert unsure.estimate().sd[0] > 1.5 * sure.estimate().sd[0]


def test_a_gap_is_as_many_minutes_without_readings():
    seen = readings([0.4, np.log(0.5), 0.0, 0.0, 0.0], 60)
    gap, nothing = (CompositionEstimator(CompositionEstimatorConfig()) for _ in range(2))
    yes = np.array([True])
    for estimator in (gap, nothing):
        follow(estimator, seen[:30])
        estimator.dosed(-np.array([DOSE_ML]))  # the last dose was not given after all
    for k in range(30, 60):
        nothing.watch(*(np.array([v]) for v in (NAN, NAN, WARM, float(k))), rows=yes)
    for estimator in (gap, nothing):
        estimator.watch(*(np.array([v]) for v in (0.5, NAN, WARM, 60.0)), rows=yes)
    np.testing.assert_allclose(gap.mean, nothing.mean, rtol=1e-9)
    np.testing.assert_allclose(gap.cov, nothing.cov, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("which", [0, 1])
def test_one_wild_reading_is_as_good_as_none(which):
    seen = readings([0.4, np.log(0.5), 0.0, 0.0, 0.0], 200)
    wild, none = (CompositionEstimator(CompositionEstimatorConfig()) for _ in range(2))
    bad, gone = seen.copy(), seen.copy()
    bad[100, which], gone[100, which:] = 4.0 * seen[100, which], NAN  # with a density the light beside it is left out
    follow(wild, bad)
    follow(none, gone)
    np.testing.assert_array_equal(wild.mean, none.mean)


@pytest.mark.parametrize("kept", [0.5, 0.85, None])
def test_a_jump_that_stays_is_followed_but_the_share_learns_nothing_from_it(kept):
    """A part was replaced and nobody said so, or the light is another one."""
    seen = readings([0.4, np.log(0.5), 0.0, 0.0, 0.0], 120)
    jumped, before = seen.copy(), CompositionEstimator(CompositionEstimatorConfig())
    if kept is not None:
        jumped[100:, 0] *= kept
        jumped[100:, 1] = QUIET.offset + kept * (seen[100:, 1] - QUIET.offset)
    else:
        jumped[100:, 1] *= 2.5
    estimator = CompositionEstimator(CompositionEstimatorConfig())
    follow(estimator, jumped[:107])
    follow(before, seen[:107])
    assert estimator.estimate().logit[0] == pytest.approx(before.estimate().logit[0], abs=0.03)
    told = estimator.explain()
    assert told["composition_od"][0] == pytest.approx(jumped[106, 0], rel=0.02)
    light = told["pigment"][0] + 150.0 * told["composition_od"][0]
    assert QUIET.factor * light + QUIET.offset == pytest.approx(jumped[106, 1], abs=90.0)  # two of its sds


def test_nothing_is_believed_before_the_first_density():
    estimator = CompositionEstimator(CompositionEstimatorConfig(share=0.3, share_sd=0.5))
    estimator.watch(*(np.array([v]) for v in (NAN, 900.0, 33.0, 0.0)), rows=np.array([True]))
    assert not estimator.begun.any()
    estimator.watch(*(np.array([v]) for v in (0.4, NAN, 33.0, 1.0)), rows=np.array([True]))
    assert estimator.begun.all()
    told = estimator.explain()
    assert told["ratio"][0] == pytest.approx(0.3)
    assert told["composition_od"][0] == pytest.approx(0.4)
    spread = 1.96 * 0.5
    assert told["ratio_high"][0] == pytest.approx(1.0 / (1.0 + np.exp(-np.log(0.3 / 0.7) - spread)))
    assert estimator.estimate().rate[0] == pytest.approx(float(p_putida_rate(33.0)))


def alone(columns, volume_ml, config, start=0.0):
    """One culture by itself, on its own clock."""
    estimator = CompositionEstimator(config, volume_ml)
    for minute, od, light, warm, dose in columns:
        estimator.watch(*(np.array([v]) for v in (od, light, warm, minute - start)), rows=np.array([True]))
        estimator.dosed(np.array([dose]))
    return estimator


def test_cultures_of_other_clocks_volumes_and_beginnings_are_as_if_alone():
    """One every minute, one every other minute, and one of 12 mL that is inoculated behind the others' `gain_h`."""
    config = replace(CompositionEstimatorConfig(), gain_h=0.5)
    rng, seen, warm = np.random.default_rng(5), readings([0.4, np.log(0.5), 0.0, 0.0, 0.0], 120), [31.0, 33.0, 36.0]
    volumes, begins, periods = np.array([20.0, 20.0, 12.0]), np.array([0, 1, 50]), np.array([1, 2, 1])
    together, each = CompositionEstimator(config, volumes), [[], [], []]
    together.reset(3)
    for k in range(120):
        rows = (k >= begins) & ((k - begins) % periods == 0)
        shown = seen[k] * (1.0 + 0.01 * rng.normal(size=(3, 2)))
        dose = np.where(rows, rng.uniform(0.1, 0.6, 3), 0.0)
        together.watch(shown[:, 0], shown[:, 1], np.array(warm), np.full(3, float(k)), rows)
        together.dosed(dose)
        for n in np.flatnonzero(rows):
            each[n].append((float(k), *shown[n], warm[n], dose[n]))
    for n in range(3):
        single = alone(each[n], volumes[n], config, float(begins[n]))
        np.testing.assert_allclose(together.mean[n], single.mean[0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(together.cov[n], single.cov[0], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("period", [0.5, 1.0, 2.0, 7.0])
def test_what_passes_without_readings_is_closed_form_at_any_period(period):
    """ln S = ln S0 + growth - g v/V for one dose; the factor's doubt k^2 w^2 per day; production forgets in 63 min."""
    config, minutes, dose = replace(QUIET, factor_walk=0.03), 42.0, 1.7
    estimator, yes = CompositionEstimator(config, 15.0), np.array([True])
    estimator.watch(*(np.array([v]) for v in (0.5, NAN, WARM, 0.0)), rows=yes)
    estimator.mean[0, 0, LOGIT], estimator.mean[0, 0, LOG_Q] = 50.0, 0.3  # all of it is P. putida
    estimator.dosed(np.array([dose]))
    for k in range(1, round(minutes / period) + 1):
        estimator.watch(*(np.array([v]) for v in (NAN, NAN, WARM, k * period)), rows=yes)
    grown = float(p_putida_rate(WARM)) * minutes / 60.0
    assert estimator.mean[0, 0, LOG_OD] == pytest.approx(np.log(0.5) + grown - dose / 15.0, abs=1e-9)
    assert estimator.mean[0, 0, LOG_Q] == pytest.approx(0.3 * np.exp(-minutes / 63.0), rel=1e-9)
    walked = (0.99 * 0.03) ** 2 * minutes / 1440.0
    assert estimator.cov[0, 0, FACTOR, FACTOR] == pytest.approx(walked, rel=1e-9)


def test_what_is_told_of_two_cultures_is_the_mixture_of_their_own_starts():
    """The first culture believes its starts by 1 to 3, the second only in the one at which the first has a share of 1.

    Of two starts 0.1 and 0.2 with variance 0.01 each that is 0.175, with 0.01 + 0.1^2 * 3 / 16 of variance.
    """
    estimator = CompositionEstimator(replace(CompositionEstimatorConfig(), starts=2))
    estimator.reset(2)
    starts = {
        BIAS_E: (0.1, 0.2), BIAS_P: (-0.1, -0.3), GAIN: (0.8, 1.0), THERMOMETER: (0.2, 0.4),
        LOG_OD: (np.log(0.4), np.log(0.6)), LOG_F: (np.log(100.0), np.log(300.0)), LOGIT: (-1.0, 1.0),
    }  # fmt: skip
    for state, values in starts.items():
        estimator.mean[..., state] = values
    for state, variance in ((BIAS_E, 0.01), (BIAS_P, 0.04), (LOGIT, 0.25)):
        estimator.cov[..., state, state] = variance
    estimator.log_weight[:] = np.log([[1.0, 3.0], [1.0, 1e-30]])
    estimator._temperature[:] = 31.0, 34.0
    told, now = estimator.explain(), estimator.estimate()
    expected = {
        "bias_e": (0.175, 0.1), "bias_p": (-0.25, -0.1), "thermometer_error": (0.35, 0.2), "dose_gain": (0.95, 0.8),
        "composition_od": (0.55, 0.4), "pigment": (250.0, 100.0), "dose_spread": (0.1, 0.1),
        "bias_e_sd": (np.sqrt(0.01 + 0.01 * 3 / 16), 0.1), "bias_p_sd": (np.sqrt(0.04 + 0.04 * 3 / 16), 0.2),
    }  # fmt: skip
    for key, values in expected.items():
        np.testing.assert_allclose(told[key], values, err_msg=key)
    x, sd = np.array([0.5, -1.0]), np.array([np.sqrt(0.25 + 4.0 * 3 / 16), 0.5])
    for key, side in (("ratio", 0.0), ("ratio_low", -1.96), ("ratio_high", 1.96)):
        np.testing.assert_allclose(told[key], 1.0 / (1.0 + np.exp(-x - side * sd)), err_msg=key)
    np.testing.assert_allclose(now.sd, sd)
    np.testing.assert_allclose(now.temperature, [31.35, 34.2])  # the true ones


@pytest.mark.parametrize("period", [0.5, 3.0])
def test_what_walks_walks_as_far_as_its_minutes_say_at_any_period(period):
    """Both growth curves' errors by w^2 a minute; the share's logit by twice the spread of either species' growth."""
    walking, still = replace(QUIET, bias_sd=0.1, bias_walk=0.01), replace(QUIET, bias_sd=0.0, growth_sd=0.02)
    for config, state, expected in (
        (walking, BIAS_E, 0.1**2 + 12.0 * 0.01**2), (walking, BIAS_P, 0.1**2 + 12.0 * 0.01**2),
        (still, LOGIT, 1.8**2 + 2.0 * 12.0 * 0.02**2),
    ):  # fmt: skip
        estimator = CompositionEstimator(config)
        for k in range(round(12.0 / period) + 1):
            od = 0.5 if k == 0 else NAN
            estimator.watch(*(np.array([v]) for v in (od, NAN, WARM, k * period)), rows=np.array([True]))
        assert estimator.cov[0, 0, state, state] == pytest.approx(expected, rel=1e-9)


def test_rates_follow_a_temperature_that_changes_along_a_line_between_two_readings():
    """Two cultures in ten minutes, one from 31 to 35 degC and one back, and then at rest: m' = (mu_p(T) - m) / 1 h."""
    estimator = CompositionEstimator(QUIET)
    estimator.reset(2)
    both, first, last = np.ones(2, dtype=bool), np.array([31.0, 35.0]), np.array([35.0, 31.0])
    estimator.watch(np.full(2, 0.5), np.full(2, NAN), first, np.zeros(2), both)
    rate, per_min = p_putida_rate(first), 100
    for minutes, begins, ends in ((10, first, last), (20, last, last)):
        for k in range(minutes * per_min):
            warm = begins + (ends - begins) * (k + 0.5) / (minutes * per_min)
            rate = rate + (p_putida_rate(warm) - rate) / (60.0 * per_min)
        estimator.watch(np.full(2, NAN), np.full(2, NAN), ends, np.full(2, 10.0 + 20.0 * (minutes == 20)), both)
        np.testing.assert_allclose(estimator.estimate().rate, rate, rtol=1e-3)
        np.testing.assert_array_equal(estimator.estimate().temperature, ends)


def test_an_od_that_a_dose_does_not_explain_widens_the_spread_of_doses_of_its_own_culture():
    """A dose of 0.4 in 20 mL at OD 0.5, whose spread s moves the OD by 0.01 s: 0.003 off where 0.002 was expected.

    That says s^2 = 0.1^2 + (9e-6 - 4e-6) / 1e-4 with precision (1e-4 / 4e-6)^2 / 2, beside 0.1^2 with 1 / 0.1^4. The
    second culture got no dose, the third is further off than is believed, the fourth was off by less than expected.
    """
    estimator = CompositionEstimator(replace(QUIET, dose_cv=0.1), np.array([20.0, 20.0, 20.0, 10.0]))
    estimator.reset(4)
    estimator._dose[:] = 0.02, 0.0, 0.02, 0.02
    off, expected, od = np.array([[9e-6], [9e-6], [9e-6], [1e-6]]), np.full((4, 1), 4e-6), np.full((4, 1), 0.5)
    estimator._judge_dose(np.arange(4), off, expected, od, np.array([[True], [True], [False], [True]]))
    wider = (1e4 * 0.01 + 312.5 * 0.06) / (1e4 + 312.5)
    np.testing.assert_allclose(estimator.explain()["dose_spread"], np.sqrt([wider, 0.01, 0.01, 0.01]))


def test_the_flow_of_a_pump_is_learned_for_so_many_hours_of_each_culture_s_own_clock():
    """Half an hour: that of minute 100 learns at 129 and no more at 131, that of minute 110 goes on."""
    estimator = CompositionEstimator(replace(QUIET, gain_sd=0.05, gain_h=0.5, od_sd=0.05))
    estimator.reset(2)
    shown = {100: [True, False], 110: [False, True], 129: [True, True], 131: [True, True]}
    gains = []
    for minute, rows in shown.items():
        od = np.full(2, 0.5 if minute < 120 else 0.7)
        estimator.watch(od, np.full(2, NAN), np.full(2, 33.2), np.full(2, float(minute)), np.array(rows))
        estimator.dosed(np.full(2, 1.0))
        gains.append(estimator.mean[:, 0, GAIN].copy())
    assert (gains[1] == 1.0).all()
    assert (gains[2] != 1.0).all()
    assert (gains[3] == gains[2]).tolist() == [True, False]
