"""What a run learns of a vial: each part of the filter alone, its own doubt, and rows that do not know one another."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from envs.task import EnvConfig
from experiments.laws.density.estimator import GAIN, LOG_OD, MU, Estimator, EstimatorConfig
from hardware import memory

pytestmark = pytest.mark.numeric

MODEL = EnvConfig(mu=0.025, tau=1 / 3)
DEFAULT = EstimatorConfig()
BARE = EstimatorConfig(
    noise_memory=0.0, warmth=0.0, warmth_sd=0.0, first_dose=1.0, first_dose_sd=0.0, hurry=0.0, growth_cv=0.0
)
ONE = np.ones(1, dtype=bool)


def estimator(config: EstimatorConfig = DEFAULT, n: int = 1) -> Estimator:
    made = Estimator(config, MODEL)
    made.reset(n)
    return made


def shown(e: Estimator, od: float, minute: float, dose_ml: float = 0.0, degc: float = np.nan) -> None:
    """A reading of the first and only row, and then a dose."""
    at = np.array([minute])
    e.watch(np.array([od]), np.array([degc]), at, ONE)
    e.see(np.array([od]), at, ONE)
    e.dosed(np.array([dose_ml]))


def test_recovery_teaches_growth_before_the_schedule_begins() -> None:
    """In half an hour without a dose ln OD rises by mu a minute: 0.018 here, and 0.025 is believed."""
    for used in (True, False):
        e = estimator(replace(DEFAULT, recovery=used))
        for minute in range(31):
            e.watch(np.array([0.3 * np.exp(0.018 * minute)]), np.full(1, 37.0), np.array([float(minute)]), ONE)
        assert e.mean[0, MU] == pytest.approx(0.018 if used else 0.025, abs=3e-4)


def test_the_level_of_the_noise_is_learned() -> None:
    """Readings with sd 0.012 where 0.005 and 0.3 % are believed; at OD 0.5 that is hypot(0.005, 0.0015) = 0.00522."""
    rng = np.random.default_rng(4)
    od = 0.5 + 0.012 * rng.standard_normal(400)
    learned, fixed = estimator(), estimator(replace(DEFAULT, noise_memory=0.0))
    for minute, x in enumerate(od):
        for e in (learned, fixed):
            shown(e, float(x), float(minute), 20.0 * 0.025)
    assert learned.explain()["noise"][0] == pytest.approx(0.012 / 0.00522, rel=0.25)
    assert fixed.explain()["noise"][0] == 1.0
    swing = {e: np.sqrt(e.cov[0, LOG_OD, LOG_OD]) for e in (learned, fixed)}
    assert swing[learned] > 1.3 * swing[fixed]  # it trusts a single reading less


def test_doses_are_those_that_were_given() -> None:
    """0.5 mL were decided a minute, none is given; then OD rises by e^mu, which is no sign of fast growth."""
    for told in (True, False):
        e = estimator(replace(DEFAULT, told=told))
        for minute in range(40):
            e.see(np.array([0.3 * np.exp(0.025 * minute)]), np.array([float(minute)]), ONE)
            e.decided(np.array([0.5 / 60.0]))
            e.dosed(np.zeros(1))
        found = e.mean[0, MU] - e.mean[0, GAIN] * 0.5 / 20.0 * (not told)
        assert found == pytest.approx(0.025, abs=1e-3)  # either way the rise is explained
        assert bool(abs(e.mean[0, MU] - 0.025) < 1e-3) is told


def test_the_first_dose_after_a_pause_is_expected_smaller_and_not_blamed_on_the_pump() -> None:
    """Of the first 1 mL after 30 min only half arrives: its share is 1 - e^(-0.025) of the OD instead of e^(-0.05)."""
    sure = replace(DEFAULT, gain_sd=0.1)
    known, unknown = estimator(sure), estimator(replace(sure, first_dose=1.0, first_dose_sd=0.0))
    log_od = np.log(0.5)
    for e in (known, unknown):
        for k in range(10):
            shown(e, 0.5, float(k), 0.5)
    for minute in range(10, 41):
        log_od = np.log(0.5) + 0.025 * (minute - 10)
        for e in (known, unknown):
            shown(e, np.exp(log_od), float(minute), 1.0 if minute == 40 else 0.0)
    before = {e: e.mean[0, GAIN] for e in (known, unknown)}
    for e in (known, unknown):
        shown(e, np.exp(log_od + 0.025 - 0.5 / 20.0), 41.0)
    moved = {e: before[e] - e.mean[0, GAIN] for e in (known, unknown)}
    assert 0.0 <= moved[known] < 0.3 * moved[unknown]


@pytest.mark.parametrize(("rest", "share"), [((2, 4, 6, 8, 10, 12), 0.5), ((5, 12), 0.5), ((2, 4, 6, 8), 1.0)])
def test_a_pause_is_counted_in_minutes_whatever_the_period(rest: tuple[int, ...], share: float) -> None:
    """Nothing grows. 12 min without a dose are a pause, read every 2 min or with samples lost; 8 min are none."""
    e = estimator(replace(BARE, first_dose=0.5, pulse_cv=0.0, mu_walk=0.0, gain_walk=0.0))
    e.mean[0, MU] = 0.0
    shown(e, 0.5, -2.0, 1e-9)
    for minute in (0, *rest):
        shown(e, 0.5, float(minute), 1.0 if minute == rest[-1] else 0.0)
    mean = e.mean.copy()
    e._predict(np.array([0]), np.array([2.0]), np.zeros(1))
    assert mean[0, LOG_OD] - e.mean[0, LOG_OD] == pytest.approx(share * mean[0, GAIN] * 1.0 / 20.0, rel=1e-3)


def test_growth_is_carried_over_a_change_of_temperature() -> None:
    """2.5 % of mu a degree are believed at first: 37 to 33 degC make 0.025 to 0.0225 at once, without a reading."""
    e, blind = estimator(), estimator(replace(DEFAULT, warmth=0.0, warmth_sd=0.0))
    for one in (e, blind):
        for minute in range(30):
            shown(one, 0.5, float(minute), 20.0 * 0.025, 37.0)
        shown(one, 0.5, 30.0, 0.5, 33.0)
    full = {one: one.full_pump[0] for one in (e, blind)}
    growth = {one: one.relative(np.full(1, 0.5))[1][0] * full[one] / MODEL.control_min for one in (e, blind)}
    assert growth[e] == pytest.approx(0.9 * growth[blind], rel=0.03)
    for minute in range(31, 120):  # it really fell by 5 % a degree: 20 % over four
        shown(e, 0.5, float(minute), 20.0 * 0.02, 33.0)
    now = e.relative(np.full(1, 0.5))[1][0] * e.full_pump[0]
    assert now / e.mean[0, GAIN] == pytest.approx(0.02, rel=0.02)


def test_it_hurries_while_surprises_agree_and_only_then() -> None:
    """Growth falls by 40 % at once: with the hurry mu is there sooner; in a calm run both are the same."""

    def after(hurry: float, fall: float, minutes: int) -> float:
        e, od, rng = estimator(replace(DEFAULT, hurry=hurry)), 0.5, np.random.default_rng(2)
        for minute in range(60 + minutes):
            shown(e, od + 0.002 * rng.standard_normal(), float(minute), 20.0 * 0.025 * (od / 0.5))
            mu = 0.025 * (1.0 - fall * (minute >= 60))
            od *= np.exp(mu - 0.025 * (od / 0.5))
        return float(e.mean[0, MU] / e.mean[0, GAIN])

    quick, slow = (after(hurry, 0.4, 12) for hurry in (150.0, 0.0))
    assert abs(quick - 0.015) < 0.6 * abs(slow - 0.015)
    assert after(150.0, 0.0, 60) == pytest.approx(0.025, rel=0.05)


@pytest.mark.parametrize(("jump", "needed"), [(0.03, 2), (0.06, 3), (0.11, 5), (0.5, 6), (-0.06, 3)])
def test_the_larger_a_jump_the_more_readings_have_to_agree(jump: float, needed: int) -> None:
    """One per 0.025 OD begun, at least 2, at most 6; what is asked for is counted from the first reading on."""
    e = estimator(replace(DEFAULT, noise_floor=0.001, noise_relative=0.001, noise_memory=0.0, mu_sd=1e-4, hurry=0.0))
    for minute in range(30):
        shown(e, 0.5, float(minute), 20.0 * 0.025)
    for k in range(1, 8):
        shown(e, 0.5 + jump, 29.0 + k, 20.0 * 0.025)
        believed = bool(abs(np.exp(e.mean[0, LOG_OD]) - 0.5 - jump) < 0.005)
        assert believed is (k >= needed), k


def test_its_doubt_is_that_of_many_vials_drawn_from_its_beliefs() -> None:
    """Vials with growth, pump, doses and readings as the filter believes they scatter; 16 minutes, doses in between."""
    n, config = 4000, replace(BARE, gate_sigma=20.0, gain_sd=0.15, mu_sd=0.004)
    rng = np.random.default_rng(0)
    e = estimator(config, n)
    mu = MODEL.mu + config.mu_sd * rng.standard_normal(n)
    gain = 1.0 + config.gain_sd * rng.standard_normal(n)
    log_od, setpoint = np.full(n, np.log(0.6)), np.full(n, 0.5)
    for minute in range(17):
        reading = np.exp(log_od)
        sd = np.hypot(config.noise_floor, config.noise_relative * reading)
        e.see(reading + sd * rng.standard_normal(n), np.full(n, float(minute)), np.ones(n, dtype=bool))
        if minute == 16:
            break
        dose = (0.0, 0.6, 1.2)[minute % 3]
        e.dosed(np.full(n, dose))
        dilution = dose / (60.0 * MODEL.tau) * (gain + config.pulse_cv * rng.standard_normal(n))
        log_od = log_od + mu - dilution
        mu = mu + config.mu_walk * rng.standard_normal(n)
        gain = gain + config.gain_walk * rng.standard_normal(n)
    full = 0.02 / MODEL.tau
    believed_e, believed_s = e.doubt(setpoint)
    seen_e, seen_s = e.relative(setpoint)
    true_s = mu / (gain * full)
    assert np.std((e.mean[:, LOG_OD] - log_od) / e.full_pump) == pytest.approx(believed_e.mean(), rel=0.06)
    ratio = (seen_s - true_s) / believed_s
    assert np.median(np.abs(ratio)) == pytest.approx(0.6745, rel=0.08)  # of a normal distribution
    assert np.isfinite(seen_e).all()


@pytest.mark.parametrize(("gain", "period"), [(1.0, 1.0), (0.7, 1.0), (0.7, 2.0), (1.4, 5.0)])
def test_its_doubt_of_a_pump_that_is_not_sound_is_the_scatter_of_vials_as_it_believes_them(gain, period):
    """e = ln(x/r)/B and s = mu h/B with B = g u_max h/tau. Too small a doubt of a worn pump keeps a supervisor away."""
    e, r = Estimator(BARE, replace(MODEL, control_min=period)), np.full(1, 0.4)
    e.reset(1)
    e.mean[0] = [np.log(0.6), 0.021, gain, 0.0]
    sd, alike = np.array([0.006, 0.0006, 0.03 * gain, 1e-6]), np.eye(4)
    for i, k, how in ((LOG_OD, MU, 0.3), (MU, GAIN, 0.6)):
        alike[i, k] = alike[k, i] = how
    e.cov[0] = alike * np.outer(sd, sd)
    log_od, mu, flow, _ = np.random.default_rng(3).multivariate_normal(e.mean[0], e.cov[0], 100_000).T
    sound = 0.02 * period / (1 / 3)  # B of a pump as calibrated
    error, share = (log_od - np.log(0.4)) / (flow * sound), mu * period / (flow * sound)
    by_hand = np.log(1.5) / (gain * sound), 0.021 * period / (gain * sound)
    assert [float(v[0]) for v in e.relative(r)] == pytest.approx(by_hand)
    doubt_e, doubt_s = (float(v[0]) for v in e.doubt(r))
    assert doubt_s == pytest.approx(np.std(share), rel=0.02)
    assert doubt_e == pytest.approx(0.006 / (gain * sound))  # B taken as known
    told_e, told_s = (float(v[0]) for v in e.sd(r))
    assert told_e == pytest.approx(np.std(error), rel=0.02)
    assert told_s == pytest.approx(np.hypot(np.std(share), 0.02), rel=0.02)


def test_what_is_told_of_its_doubt_is_as_much_larger_as_surprises_were_lately_or_for_long() -> None:
    """0.75 of their squares is usual. Of ten readings four times that; and of forty, of which the last ten are usual.

    The third has three readings yet, and the fourth was surprised less than usual, which makes nothing smaller.
    """
    e = Estimator(BARE, MODEL)
    e.reset(5)
    e.mean[:], e.cov[:] = [np.log(0.6), 0.021, 0.9, 0.0], np.diag([1e-4, 1e-6, 1e-3, 0.0])
    e._squares[0, :30], e._squares[0, 30:] = 0.75, 3.0
    e._squares[1, :30], e._squares[1, 30:] = 3.75, 0.75
    e._squares[2, 37:] = 6.75
    e._squares[3] = 0.1
    setpoint = np.full(5, 0.4)
    error, share = e.sd(setpoint)
    larger = [2.0, np.sqrt((30 * 3.75 + 10 * 0.75) / 40 / 0.75), 3.0, 1.0, 1.0]
    np.testing.assert_allclose(error / error[4], larger)
    np.testing.assert_allclose(share, np.hypot(e.doubt(setpoint)[1] * larger, 0.02))


def test_what_passes_between_two_readings_is_closed_form_for_each_vial() -> None:
    """ln x + dt (mu + w (T - T0)) - g V / 30 mL, T the mean of both readings'; nothing is unsure, so none corrects it.

    One cools for 10 min, the other is warmed for 4 and gets its first dose after a rest, of which 0.6 arrive.
    """
    still = replace(BARE, warmth=0.025, first_dose=0.6, pulse_cv=0.0, mu_walk=0.0, gain_walk=0.0)
    e, both = Estimator(still, replace(MODEL, tau=0.5)), np.ones(2, dtype=bool)
    e.reset(2)
    e.watch(np.array([0.5, 0.4]), np.array([37.0, 30.0]), np.zeros(2), both)
    e.cov[:], e._idle_min[:], e.mean[:, GAIN] = 0.0, (0.0, 12.0), (0.9, 1.1)
    e.dosed(np.array([1.2, 0.5]))
    expected = np.log([0.5, 0.4]) + np.array([10.0, 4.0]) * 0.025 * (1.0 + 0.025 * np.array([-2.0, 3.0]))
    expected -= np.array([0.9 * 1.2, 1.1 * 0.5 * 0.6]) / 30.0
    e.watch(np.exp(expected) + 0.002, np.array([33.0, 36.0]), np.array([10.0, 4.0]), both)
    np.testing.assert_allclose(e.mean[:, LOG_OD], expected, rtol=1e-12)


def test_a_pump_is_taken_for_no_weaker_and_no_stronger_than_a_pump_can_be() -> None:
    """B = g u_max h / tau with g from 0.2 to 3, whatever the filter has come to."""
    e = Estimator(BARE, replace(MODEL, max_pump_rate=0.03, control_min=2.0))
    e.reset(4)
    e.mean[:, GAIN] = -1.0, 0.1, 0.9, 7.0
    np.testing.assert_allclose(e.full_pump, np.array([0.2, 0.2, 0.9, 3.0]) * 0.03 * 2.0 * 3.0)


def test_as_long_as_nobody_tells_a_rate_that_was_decided_counts_for_its_whole_period() -> None:
    """0.01 mL/s for two minutes are 1.2 mL."""
    told, untold = (Estimator(DEFAULT, replace(MODEL, control_min=2.0)) for _ in range(2))
    for minute, od in enumerate([0.5, 0.51, 0.52, 0.51, 0.5]):
        for e in (told, untold):
            e.see(np.full(1, od), np.full(1, 2.0 * minute), ONE)
        told.dosed(np.full(1, 1.2))
        untold.decided(np.full(1, 0.01))
    np.testing.assert_allclose(untold.mean, told.mean)


def busy(bend: float = 0.002) -> Estimator:
    """At a moment at which everything that it remembers matters to the next reading.

    The first dose after a pause is under way, the last reading was far off, surprises agree, the vial cools.
    """
    e = estimator()
    rng = np.random.default_rng(1)
    for minute in range(20):
        shown(e, 0.5 * np.exp(0.004 * max(minute - 12, 0)) + 0.004 * rng.standard_normal(), float(minute), 0.45, 37.0)
    for k in range(14):
        shown(e, 0.5 * np.exp(0.025 * k + bend * k**2), 20.0 + k, 0.0, 37.0 - 0.2 * k)
    shown(e, 1.4, 34.0, 0.7, 33.0)
    e.watch(np.array([np.nan]), np.array([32.0]), np.array([34.5]), ~ONE)
    return e


def next_readings(e: Estimator) -> list[float]:
    e.dosed(np.array([0.2]))
    e.watch(np.array([1.38]), np.array([np.nan]), np.array([34.0]), ONE)  # known already
    found = list[float]()
    for k in range(9):
        shown(e, 1.4 * np.exp(0.045 * k), 35.0 + k, 0.3)
        found += [*e.mean[0].tolist(), *e.cov[0].ravel().tolist(), float(e.loudness[0])]
    return found


@pytest.mark.parametrize("forgotten", ["", *Estimator.remembers])
def test_everything_that_it_remembers_matters(forgotten: str) -> None:
    bend = 0.003 if forgotten == "trend" else 0.002  # with more of it the walks are so fast that no jump stays far
    kept: dict[str, Any] = json.loads(json.dumps(memory.save(busy(bend))))
    if forgotten:
        kept[forgotten] = memory.save(estimator())[forgotten]
    e = estimator()
    memory.restore(e, kept, "estimator")
    assert (next_readings(e) == next_readings(busy(bend))) is not bool(forgotten)
