"""The composition's estimator against a dense reference and the plant's truth; counted shares and calibrations."""

import json
from dataclasses import replace

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.coculture import recall
from experiments.coculture.base import SHARE
from experiments.coculture.calibration import calibrate_sensor
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
from experiments.coculture.recall import Recall
from experiments.coculture.signal import Share
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.trials import run_cell
from experiments.laws import registry
from hardware import memory
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


CONFIG = CompositionEstimatorConfig(starts=1)


def shown(estimator, minutes, seed=0, start=0, n=2):
    """Readings of cultures that grow and are diluted, with doses that differ; minute by minute."""
    rng = np.random.default_rng(seed)
    for k in range(minutes):
        od = 0.5 + 0.02 * np.sin(k / 7.0 + np.arange(n)) + 0.005 * rng.standard_normal(n)
        light = 900.0 + 200.0 * np.sin(k / 200.0) + 30.0 * rng.standard_normal(n)
        dose = 0.3 + 0.1 * rng.random(n)
        if k >= start:
            warm = np.full(n, 33.0 + np.sin(k / 60.0))
            estimator.watch(od, light, warm, np.full(n, float(k)), np.ones(n, dtype=bool))
            estimator.dosed(dose)


def test_a_sample_moves_the_estimate_as_the_variances_say():
    """r = 1/(1 + exp(-x)) with slope r (1 - r): the posterior of a Gaussian x, and what is tied to it by regression."""
    estimator = CompositionEstimator(CONFIG)
    estimator.reset(2)
    shown(estimator, 90)
    mean, cov = estimator.mean[0, 0].copy(), estimator.cov[0, 0].copy()
    other = estimator.mean[1].copy()
    estimator.sample(np.array([0.31, np.nan]), np.array([0.03, 0.03]), np.array([True, True]))
    x, p, noise = mean[LOGIT], cov[LOGIT, LOGIT], 0.03**2
    posterior = np.linspace(x - 4.0, x + 4.0, 800001)
    r = 1.0 / (1.0 + np.exp(-posterior))
    best = posterior[np.argmin((posterior - x) ** 2 / p + (0.31 - r) ** 2 / noise)]
    assert estimator.mean[0, 0, LOGIT] == pytest.approx(best, abs=2e-3)
    slope = (r := 1.0 / (1.0 + np.exp(-best))) * (1.0 - r)
    after = 1.0 / (1.0 / p + slope**2 / noise)
    assert estimator.cov[0, 0, LOGIT, LOGIT] == pytest.approx(after, rel=0.02)
    for state in (FACTOR, OFFSET, GAIN):  # what it is tied to moves with it
        moved = estimator.mean[0, 0, state] - mean[state]
        assert moved == pytest.approx(cov[state, LOGIT] / p * (best - x), rel=0.02)
        assert moved != 0.0
    np.testing.assert_array_equal(estimator.mean[1], other)  # a culture nobody sampled


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_a_sample_chooses_among_the_starts(share):
    estimator = CompositionEstimator(CompositionEstimatorConfig(starts=5))
    estimator.reset(2)
    shown(estimator, 2)
    estimator.sample(np.full(2, share), np.full(2, 0.02), np.ones(2, dtype=bool))
    np.testing.assert_allclose(estimator.estimate().share, share, atol=0.02)


@pytest.mark.parametrize("minute", [59.0, 60.0, 61.0, 179.0, 200.0])
def test_what_is_told_late_is_as_if_it_had_been_told_at_once(minute):
    """Two samples that come in the wrong order, hours after they were drawn."""
    at_once, late = (Recall(CompositionEstimator(CONFIG)) for _ in range(2))
    told = {minute: 0.3, 100.0: 0.45}
    for each in (at_once, late):
        each.reset(2)
    rng = np.random.default_rng(1)
    for k in range(201):
        od, light = 0.5 + 0.005 * rng.standard_normal(2), 900.0 + 30.0 * rng.standard_normal(2)
        for each in (at_once, late):
            each.watch(od, light, np.full(2, 34.0), np.full(2, float(k)), np.ones(2, dtype=bool))
            if each is at_once and k in told:
                assert each.sample(np.array([told[k], np.nan]), np.full(2, 0.03), float(k), np.array([True, False]))
            each.dosed(np.array([0.3, 0.2]))
    for when in (100.0, minute):
        assert late.sample(np.array([told[when], np.nan]), np.full(2, 0.03), when, np.array([True, False]))
    for k in range(201, 220):  # what is left of the past comes with these
        more = (np.full(2, 0.51), np.full(2, 950.0), np.full(2, 34.0), np.full(2, float(k)), np.ones(2, dtype=bool))
        for each in (at_once, late):
            each.watch(*more)
            each.dosed(np.array([0.3, 0.2]))
    assert not late.behind
    np.testing.assert_allclose(late.estimator.mean, at_once.estimator.mean, rtol=1e-12)
    np.testing.assert_allclose(late.estimator.cov, at_once.estimator.cov, rtol=1e-9, atol=1e-18)


def long_run(hours, seed=2, n=2):
    """What a run is shown: (minute, method, arguments); the second culture every other minute only."""
    rng = np.random.default_rng(seed)
    for k in range(round(60 * hours)):
        rows = np.array([True, k % 2 == 0])
        od, light = 0.5 + 0.005 * rng.standard_normal(n), 900.0 + 30.0 * rng.standard_normal(n)
        yield float(k), "watch", (od, light, np.full(n, 33.0 + np.sin(k / 60.0)), np.full(n, float(k)), rows)
        yield float(k), "dosed", (np.where(rows, 0.3 + 0.1 * rng.random(n), 0.0),)


def test_many_samples_of_long_ago_never_hold_up_the_loop(monkeypatch):
    """Five of a morning, told at once: with each reading a bounded part of the past is taken again, to the same end."""
    at_most, calls = 60, 0
    monkeypatch.setattr(recall, "AT_ONCE", at_most)
    told = {float(minute): 0.3 + 0.001 * minute for minute in range(100, 280, 40)}
    watch = CompositionEstimator.watch

    def counting(self, *arguments):
        nonlocal calls
        calls += 1
        watch(self, *arguments)

    at_once, late = (Recall(CompositionEstimator(CONFIG)) for _ in range(2))
    for each in (at_once, late):
        each.reset(2)
    events = list(long_run(5.0))
    for minute, method, arguments in events:
        for each in (at_once, late):
            getattr(each, method)(*arguments)
        if method == "watch" and minute in told:
            at_once.sample(np.array([told[minute], np.nan]), np.full(2, 0.03), minute, np.array([True, False]))
    monkeypatch.setattr(CompositionEstimator, "watch", counting)
    for minute, share in told.items():
        calls = 0
        assert late.sample(np.array([share, np.nan]), np.full(2, 0.03), minute, np.array([True, False]))
        assert calls <= at_most
    assert late.behind
    k, last = 0, events[-1][0]
    while late.behind:
        k, calls = k + 1, 0
        late.watch(*(np.full(2, v) for v in (0.5, 900.0, 33.0, last + k)), np.ones(2, dtype=bool))
        assert calls <= at_most + 1
        at_once.watch(*(np.full(2, v) for v in (0.5, 900.0, 33.0, last + k)), np.ones(2, dtype=bool))
    np.testing.assert_allclose(late.estimator.mean, at_once.estimator.mean, rtol=1e-12)


@pytest.mark.parametrize("hours", [0.7, 5.3, pytest.param(51.0, marks=pytest.mark.slow)])
def test_a_resumed_run_that_is_told_its_past_is_one_that_was_not_interrupted(hours):
    """Samples before the stop, in it, and late ones after it; a dose that came while the program was dead."""
    whole, events = Recall(CompositionEstimator(CONFIG)), list(long_run(hours))
    whole.reset(2)
    cut = len(events) - 21
    minutes = {events[cut - 200 if hours > 2.0 else 10][0]: 0.4, events[cut + 3][0]: 0.45, 0.0: 0.5}
    samples = {m: (np.array([r, np.nan]), np.full(2, 0.03), np.array([True, False])) for m, r in minutes.items()}
    stopped = Recall(CompositionEstimator(CONFIG))
    stopped.reset(2)
    for minute, method, arguments in events:
        getattr(whole, method)(*arguments)
        if method == "watch" and minute in samples and minute > 0.0:
            whole.sample(samples[minute][0], samples[minute][1], minute, samples[minute][2])
    for _, method, arguments in events[:cut]:
        getattr(stopped, method)(*arguments)
    again = Recall(CompositionEstimator(CONFIG))
    again.reset(2)
    memory.restore(again, json.loads(json.dumps(memory.save(stopped))), "composition")
    keys = ("time_min", "od", "fluorescence", "temperature_degc", "believed", "volume_ml")
    rows: list[dict[str, list[float]]] = [{key: [] for key in keys} for _ in range(2)]
    for minute, method, arguments in events[:cut]:
        for n in range(2):
            if method == "dosed" and arguments[0][n] > 0.0:
                rows[n]["volume_ml"][-1] = arguments[0][n]
            elif method == "watch" and arguments[-1][n]:
                cells = (minute, *(float(a[n]) for a in arguments[:3]), 1.0, NAN)
                for key, value in zip(keys, cells, strict=True):
                    rows[n][key].append(value)
    law = registry.build(registry.config("proportional", SHARE), SHARE)
    scenario = Scenario((0.5,), (100.0,), (33.2,), ratios=(0.4,))
    share = Share(Recall(CompositionEstimator(CONFIG)), law, [scenario, scenario])
    share.estimator = again
    counted = [(0, r, 0.03, m) for m, r in minutes.items() if 0.0 < m <= events[cut][0]]
    share.retell(rows, counted, (1.0, 65535.0))
    assert again.behind
    for minute, method, arguments in events[cut:]:
        getattr(again, method)(*arguments)
        if method == "watch" and minute in samples:
            again.sample(samples[minute][0], samples[minute][1], minute, samples[minute][2])
    k, last = 0, events[-1][0]
    while again.behind or k == 0:
        k += 1
        for each in (whole, again):
            each.watch(*(np.full(2, v) for v in (0.5, 900.0, 33.0, last + k)), np.ones(2, dtype=bool))
    assert k < 40
    np.testing.assert_allclose(again.estimator.mean, whole.estimator.mean, rtol=1e-7, atol=1e-9)
    early = whole.sample(*samples[0.0][:2], 0.0, samples[0.0][2])
    assert early == again.sample(*samples[0.0][:2], 0.0, samples[0.0][2]) == (hours < 48.0)


def test_a_share_of_the_inoculum_counts_as_if_drawn_with_the_first_reading():
    first, told = 7.0, (np.array([0.3, NAN]), np.full(2, 0.03))
    inoculum, then = (Recall(CompositionEstimator(CONFIG)) for _ in range(2))
    for each, minute in ((inoculum, 0.0), (then, first)):
        each.reset(2)
        for k in range(5):
            reading = (np.full(2, v) for v in (0.5, 900.0, 33.0, first + 2.0 * k))
            each.watch(*reading, np.ones(2, dtype=bool))
            each.dosed(np.array([0.3, 0.2]))
        before = each.estimate().share.copy()
        assert each.sample(*told, minute, np.array([True, False]))
        each.watch(*(np.full(2, v) for v in (0.5, 900.0, 33.0, first + 10.0)), np.ones(2, dtype=bool))
        assert abs(each.estimate().share[0] - 0.3) < 0.5 * abs(before[0] - 0.3)
    np.testing.assert_array_equal(inoculum.estimator.mean, then.estimator.mean)


def test_a_culture_that_was_not_seen_learns_nothing():
    estimator = CompositionEstimator(replace(CONFIG, share=0.4))
    estimator.sample(np.full(1, 0.9), np.full(1, 0.01), np.ones(1, dtype=bool))
    assert estimator.explain()["ratio"][0] == pytest.approx(0.5)


def protocol(share, n=40, hours=5, factor=0.8, offset=300.0):
    """Thirty readings of medium, and thirty of a culture at 33.2 degC after some hours at OD 0.5, (N, 30) each."""
    config = build(PlantConfig(), presets.load("plant/coculture"))
    light = replace(config.fluorescence, factor=(factor, factor), offset=(offset, offset))
    config = replace(config, fluorescence=light, second=replace(config.second, start_share=(share, share)))
    plant = Plant(config, n, np.random.default_rng(1))
    density = registry.build(registry.config("inverse"), model=EnvConfig())
    density.reset(n)
    readings, ods = [], []
    for k in range(60 * hours):
        od, light_now = plant.read_od(), plant.read_fluorescence()
        readings.append(light_now)
        ods.append(od)
        rate = density.act(od, np.full(n, 0.5), np.full(n, float(k)), np.ones(n, dtype=bool))
        plant.advance(1.0, 60.0 * rate)
    plant.reset(od=0.0)
    blank = [plant.read_fluorescence() for _ in range(30)]
    return np.array(blank).T, np.array(readings[-30:]).T, np.array(ods[-30:]).T


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_constants_of_a_reactor_are_found_within_their_sds(share):
    blank, light, od = protocol(share)
    found = [calibrate_sensor(*three, 33.2, share=share, growth_cv=0.0) for three in zip(blank, light, od, strict=True)]
    factor, offset = np.array([c.factor for c in found]), np.array([c.offset for c in found])
    assert factor.mean() == pytest.approx(0.8, rel=0.01)
    assert offset.mean() == pytest.approx(300.0, abs=3.0)
    assert np.mean([c.factor_sd for c in found]) == pytest.approx(factor.std(ddof=1), rel=0.35)
    assert np.mean([c.offset_sd for c in found]) == pytest.approx(offset.std(ddof=1), rel=0.35)


@pytest.mark.parametrize("growth", [None, 0.6])
def test_factor_and_offset_of_a_few_readings_by_hand(growth):
    """At 31 degC, where the curve's growth is another, or at the rate that was dosed: L = 0.8 g / D + 150.

    Mean light per OD over the blank's 300: that of 0.4 and 0.8, which is not the mean light over the mean OD.
    """
    rate = float(p_putida_rate(31.0)) if growth is None else growth
    pigment = 0.8 * float(steady_production(31.0)) / rate
    bright = 300.0 + np.array([0.4, 0.8]) * np.array([3000.0, 3300.0])
    found = calibrate_sensor(
        np.array([280.0, 300.0, 320.0]), bright, np.array([0.4, 0.8]), 31.0, 0.8, growth, share_sd=0.08, growth_cv=0.03
    )
    assert found.offset == pytest.approx(300.0)
    assert found.offset_sd == pytest.approx(20.0 / np.sqrt(3.0))
    factor = 3150.0 / (pigment + 150.0)
    assert found.factor == pytest.approx(factor)
    parts = [150.0, 20.0 / np.sqrt(3.0) * 1.875, factor * pigment * np.hypot(0.1, 0.03)]  # scatter, offset, culture
    assert found.factor_sd == pytest.approx(np.linalg.norm(parts) / (pigment + 150.0))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"blank": [300.0]}, "blank readings = 1: allowed two or more"),
        ({"light": [900.0, np.nan]}, "light readings = nan or inf"),
        ({"light": [900.0, 910.0, 920.0]}, "as many as of OD, 2"),
        ({"od": [0.5, 0.0]}, "smallest od"),
        ({"share": 0.0}, "without the second species nothing fluoresces"),
        ({"temperature": 37.0}, "29 to 36 degC"),
        ({"growth": 0.0}, "growth = 0.0"),
        ({"light": [100.0, 110.0]}, "light over the blank"),
    ],
)
def test_what_cannot_calibrate_is_refused(change, says):
    given = {"blank": [300.0, 310.0], "light": [900.0, 910.0], "od": [0.5, 0.5], "temperature": 33.2} | change
    with pytest.raises(ValueError, match=says):
        calibrate_sensor(**given)
