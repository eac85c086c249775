"""Shares that somebody counted: they move an estimate as their variances say, whenever they come."""

import json
from dataclasses import replace

import numpy as np
import pytest

from envs.scenario import Scenario
from experiments.coculture import recall
from experiments.coculture.base import SHARE
from experiments.coculture.estimator import (
    FACTOR,
    GAIN,
    LOGIT,
    OFFSET,
    CompositionEstimator,
    CompositionEstimatorConfig,
)
from experiments.coculture.recall import Recall
from experiments.coculture.signal import Share
from experiments.laws import registry
from hardware import memory

CONFIG = CompositionEstimatorConfig(starts=1)
NAN = float("nan")


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
