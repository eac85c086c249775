"""The proof against what it does not use: brute force, single precision itself, formulas, and planted faults."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from dqn.policy import Policy
from envs.task import EnvConfig
from experiments.certification.config import CertifyConfig
from experiments.certification.intervals import Pieces, drops, images, points_in_strips
from experiments.certification.judge import SAFETY, _count, _required, _worst, certify, recheck
from experiments.certification.loops import OdCase, OdLoop
from experiments.certification.polygons import (
    Array,
    Network,
    Regions,
    area,
    contradictions,
    partition,
    possible,
    rounding,
)
from experiments.certification.question import CertificationError, question
from experiments.certification.verdict import Proof, attacked, dose_below, physical, prove
from tests.experiments import laws, proofs

pytestmark = pytest.mark.numeric

BOX = ((-0.02, 1.52), (0.4, 0.8))
FAST = CertifyConfig(trajectories=0)
proven = partial(proofs.proven, config=FAST)
LARGEST = 0.06  # what the full pump takes off ln x in a minute: 0.02 / (1/3)


def q_values(network: Network, points: Array) -> Array:
    """Q of points (N, 2) in double precision, shape (N, A)."""
    h = points
    for weight, bias in network.hidden:
        h = np.maximum(h @ weight + bias, 0.0)
    weight, bias = network.output
    return np.asarray(h @ weight + bias)


def inside(regions: Regions, point: Any) -> set[int]:
    """Actions of the polygons that hold a point, by the sign of the cross product with every edge."""
    a, b = regions.edges[:, 0], regions.edges[:, 1]
    cross = (b - a)[:, 0] * (point - a)[:, 1] - (b - a)[:, 1] * (point - a)[:, 0]
    n = regions.action.size
    least, most = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(least, regions.owner, cross)
    np.maximum.at(most, regions.owner, cross)
    return set(regions.action[(least >= -1e-15) | (most <= 1e-15)].tolist())


@pytest.mark.parametrize("policy", [laws.law(), laws.random(3), laws.random(4)], ids=["law", "random 3", "random 4"])
def test_the_polygons_tile_the_rectangle_and_name_the_best_action(policy: Policy) -> None:
    network = Network.of(policy)
    exact, wider = partition(network, BOX)
    assert area(exact).sum() == pytest.approx(1.54 * 0.4, abs=1e-12)
    points = np.random.default_rng(0).uniform(*np.transpose(BOX), (200, 2))
    lead = np.sort(q_values(network, points), axis=1)
    for point, q, gap in zip(points, policy.q_values(points), lead[:, -1] - lead[:, -2], strict=True):
        best = {int(q.argmax())}
        assert best <= inside(wider, point)
        assert inside(exact, point) == best or gap < 1e-4
    assert contradictions(network, exact, (64, 64)) == 0


def test_a_hidden_unit_may_have_any_scale_and_none_hides_a_kink() -> None:
    """A unit times c with its outputs over c is the same map, also for c far below every absolute limit."""
    policy = laws.random(3)
    scale = np.exp2(np.random.default_rng(0).integers(-60, 60, policy.biases[0].size)).astype(np.float32)
    weights = (policy.weights[0] * scale, policy.weights[1] / scale[:, None], *policy.weights[2:])
    other = replace(policy, weights=weights, biases=(policy.biases[0] * scale, *policy.biases[1:]))
    for one, same in zip(partition(Network.of(policy), BOX), partition(Network.of(other), BOX), strict=True):
        np.testing.assert_array_equal(one.edges, same.edges)
        np.testing.assert_array_equal(one.action, same.action)


@pytest.mark.parametrize("policy", [laws.law(), laws.random(5)], ids=["law", "random"])
def test_single_precision_stays_within_the_bound_and_the_bound_is_no_guess(policy: Policy) -> None:
    points = np.random.default_rng(1).uniform(*np.transpose(BOX), (50_000, 2))
    network = Network.of(policy)
    off, bound = np.abs(policy.q_values(points) - q_values(network, points)), rounding(network, points)
    assert (off <= bound).all()
    assert bound.max() < 300.0 * off.max()


def test_where_single_precision_swaps_two_actions_the_wider_polygons_hold_both() -> None:
    """Readings beside a switch, one float32 apart, among which some get the other action."""
    policy = laws.random(6)
    network = Network.of(policy)
    exact, wider = partition(network, BOX)
    corner = exact.edges[:, 0][(exact.edges[:, 0, 0] > 0.0) & (exact.edges[:, 0, 0] < 1.5)]
    ulp = np.arange(-8, 9)[:, None] * np.spacing(corner[:, 0].astype(np.float32)).astype(np.float64)
    points = np.stack([(corner[:, 0] + ulp).ravel(), np.tile(corner[:, 1], 17)], axis=1)
    points = points[(points[:, 1] > 0.4) & (points[:, 1] < 0.8)]
    swapped = np.flatnonzero(policy.act(points) != q_values(network, points).argmax(axis=1))
    assert swapped.size > 0
    for k in swapped[:50]:
        assert int(policy.act(points[k : k + 1])[0]) in inside(wider, points[k])


def test_a_label_that_is_wrong_is_contradicted_by_the_boxes() -> None:
    network = Network.of(laws.law())
    exact, _ = partition(network, BOX)
    wrong = Regions(exact.edges, exact.owner, np.where(exact.action == 16, 15, exact.action))
    assert contradictions(network, wrong, (64, 64)) > 0
    short = Regions(exact.edges[exact.owner > 0], exact.owner[exact.owner > 0] - 1, exact.action[1:])
    assert contradictions(network, short, (64, 64)) > 0


def test_boxes_bound_what_is_chosen_inside() -> None:
    policy = laws.random(7)
    rng = np.random.default_rng(2)
    low = rng.uniform([0, 0.4], [1.4, 0.7], (500, 2))
    allowed = possible(Network.of(policy), low, low + 0.02)
    chosen = policy.act((low[:, None] + rng.uniform(0, 0.02, (500, 20, 2))).reshape(-1, 2)).reshape(500, 20)
    assert np.take_along_axis(allowed, chosen, axis=1).all()
    assert (allowed.sum(axis=1) == 1).mean() > 0.5


@pytest.mark.parametrize(
    ("low", "high", "other", "allowed"),
    [
        (-3.0, 1.0, 0.7, [True, True]),  # the chord of relu is 0.25 (x + 3), at most 1
        (-3.0, 1.0, 1.1, [False, True]),
        (-3.0, 1.0, -0.7, [True, True]),
        (-3.0, 1.0, -0.8, [True, False]),
        (-1.0, 3.0, 2.9, [True, True]),
        (-1.0, 3.0, 3.1, [False, True]),
        (-1.0, 3.0, -0.8, [True, False]),
        (0.5, 3.0, 0.4, [True, False]),  # it does not bend here
        (-3.0, -0.5, 0.1, [False, True]),
    ],
)
def test_the_bound_of_a_box_by_hand(low: float, high: float, other: float, allowed: list[bool]) -> None:
    """Q of the first action is relu(x), of the second one a number; in a box relu is its chord less 0 to 0.75."""
    weights = np.eye(2), np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]])
    network = Network(weights, (np.zeros(2), np.zeros(1), np.array([0.0, other])))
    assert possible(network, np.array([[low, 0.4]]), np.array([[high, 0.8]])).tolist() == [allowed]


def test_a_map_that_leaves_its_start_has_no_band() -> None:
    whole = Pieces(np.array([[-9.0]]), np.array([[9.0]]), np.array([[0]]))
    band = images(whole, np.array([[[0.1, 0.1]]]), np.array([[-1.0, 1.0]]))
    assert not band.invariant[0]
    assert np.isnan(band.low[0])


def loop(low: float, high: float) -> OdLoop:
    return OdLoop(0.03, 1 / 3, 1.0, laws.RATES, (0.05, 1.5), np.array([low]), np.array([high]))


@pytest.mark.parametrize("control_min", [1.0, 2.0, 0.5])
def test_a_period_of_growth_is_as_long_as_the_control_period(control_min: float) -> None:
    """Growth at 0.03 1/min with the pump at rest, and against its full rate, which takes 0.06 1/min off."""
    case = OdCase("nominal", 0.0, 0.0)
    one = OdLoop(0.03, 1 / 3, control_min, laws.RATES, (0.05, 1.5), np.array([0.5, 0.6]), np.array([0.6, 0.7]))
    np.testing.assert_allclose(one.growth, [0.03 * control_min] * 2)
    np.testing.assert_allclose(one.shift(case)[:, 0], 0.03 * control_min)
    np.testing.assert_allclose(one.shift(case)[:, -1], (0.03 - 0.02 * 3.0) * control_min)


def test_what_is_uncertain_makes_growth_fast_where_doses_are_weak_and_slow_where_they_are_strong() -> None:
    """By 20 %, in periods of 2 min: the least change is that of 0.024 1/min with a dose by 1 / 0.8 as strong."""
    one = replace(loop(0.5, 0.6), control_min=2.0)
    found = one.shift(OdCase("", 0.2, 0.01))[0, [0, 16]]
    np.testing.assert_allclose(found, [[0.048, 0.072], [0.048 - 0.12 / 0.8, 0.072 - 0.12 / 1.2]])


def test_an_attack_pushes_what_is_shown_and_what_acts_each_by_its_own_part() -> None:
    """In periods of 2 min, at the setpoints 0.5 and 0.56 of a strip from 0.5 to 0.6."""
    one, state = replace(loop(0.5, 0.6), control_min=2.0), np.array([0.1, -0.2])
    push = np.array([[1.0, -0.5], [-0.2, 1.0]])
    seen, change = one.attack(OdCase("", 0.2, 0.01), state, np.array([[0.5, 0.6]] * 2), push)
    np.testing.assert_allclose(seen, [[0.5 * np.exp(0.1) - 0.01, 0.5], [0.56 * np.exp(-0.2) + 0.002, 0.56]])
    np.testing.assert_allclose(change[:, 0], [0.06 * 0.9, 0.06 * 1.2])
    np.testing.assert_allclose(change[:, 16], [0.06 * 0.9 - 0.12 / 0.9, 0.06 * 1.2 - 0.12 / 1.2])


def test_what_is_asked_is_of_the_model_that_the_policy_was_trained_on_unless_another_is_given() -> None:
    """Its setpoints may stand in any order; values of the command go before those of the policy."""
    policy = laws.law()
    said = {**laws.MODEL, "mu": 0.02, "tau": 0.25, "control_min": 2.0, "setpoints": [0.7, 0.9, 0.5]}
    policy = replace(policy, metadata={**policy.metadata, "control_min": 2.0, "model": said})
    own = question(policy, replace(FAST, uncertainty=0.2, noise=0.004, start_od=(0.1, 1.2)))
    assert (own.loop.mu, own.loop.tau, own.loop.control_min) == (0.02, 0.25, 2.0)
    assert own.setpoints == (own.loop.low[0], own.loop.high[-1]) == (0.5, 0.9)
    assert [(case.share, case.noise) for case in own.cases] == [(0.0, 0.0), (0.0, 0.004), (0.2, 0.0), (0.2, 0.004)]
    assert own.loop.start == (0.1, 1.2)
    assert list(own.margins.values()) == [0.012, 0.025, 0.025, 0.025]
    assert own.judged == {"nominal": 0.05, "noise and uncertain": 0.2}
    given = EnvConfig(mu=0.05, tau=0.3, control_min=2.0)
    other = question(policy, replace(FAST, env=given, setpoints=(0.6, 0.65)))
    assert (other.loop.mu, other.loop.tau) == (0.05, 0.3)
    assert other.setpoints == (other.loop.low[0], other.loop.high[-1]) == (0.6, 0.65)


def test_the_physics_of_a_way_by_hand() -> None:
    """From -3 at 0.2 a period 13 and from 2 at 0.6 three; 16 where the pump is the slower one; and at least one."""
    start = np.array([[-3.0, 2.0], [-3.0, 2.0], [-1.0, 1.0]])
    shift = np.array([[[0.2, 0.3], [-0.9, -0.6]], [[2.0, 2.5], [-0.3, -0.1]], [[0.2, 0.3], [-0.9, -0.6]]])
    goal = np.array([[-0.5, 0.4], [-0.5, 0.4], [-2.0, 2.0]])
    assert physical(start, shift, goal).tolist() == [13.0, 16.0, 1.0]


@pytest.mark.parametrize("r", [0.2, 0.55])
@pytest.mark.parametrize(
    ("mu", "tau"),
    [(0.0280086, 0.3097234), (0.031, 0.28)],
    ids=["growth is close to a level", "growth is between two levels"],
)
def test_entry_is_the_time_of_the_slowest_simulated_culture_into_what_is_allowed(mu, tau, r):
    """Periods until |x - r| is at most the law's half-width and 0.012 OD, and stays so, over those of the pump alone.

    With 0.0280086 * 0.3097234 / 0.02 * 16 = 6.94 levels of growth, level 7 takes off 0.0002 a period. The band itself
    is reached late then: time into it would say that a policy is the later, the narrower its band is.
    """
    one = OdLoop(mu, tau, 1.0, laws.RATES, (0.05, 1.5), np.array([r]), np.array([r]))
    policy, case = laws.law(share=mu * tau / 0.02, gain=40.0), OdCase("", 0.0, 0.0)
    wider = partition(Network.of(policy), ((-0.02, 1.6), (r - 0.01, r + 0.01)))[1]
    proof = prove(one, points_in_strips(wider, one.low, one.low), wider.action, case, 0.012)
    allowed = 0.012 + proof.law_half_width[0]
    x, pumped, last, alone = np.array([0.05, 1.5]), np.array([0.05, 1.5]), 0, 1
    for period in range(1, 1000):
        x = x * np.exp(mu - laws.RATES[policy.act(np.stack([x, np.full(2, r)], axis=1))] / tau)
        pumped = pumped * np.exp(mu - np.array([0.0, 0.02]) / tau)
        last = period if (np.abs(x - r) > allowed + 1e-9).any() else last
        alone = period + 1 if pumped[0] < r - allowed or pumped[1] > r + allowed else alone
    assert proof.entry[0] == pytest.approx((last + 1) / alone, abs=1.01 / alone)


def fewer(policy: Policy, levels: list[int]) -> Policy:
    """The same with some of its actions alone."""
    weights, biases = (
        (*policy.weights[:-1], policy.weights[-1][:, levels]),
        (*policy.biases[:-1], policy.biases[-1][levels]),
    )
    return replace(policy, weights=weights, biases=biases, actions=policy.actions[levels])


@pytest.mark.parametrize(
    "levels",
    [list(range(17)), list(range(16)), list(range(0, 17, 2)), list(range(0, 16, 3)), [0, 16], [0, 1, 2, 3, 7, 8, 15]],
    ids=["17", "16", "9", "6", "2", "7, unequal"],
)
def test_half_of_the_largest_dose_is_counted_on_any_grid_of_doses(levels: list[int]) -> None:
    """The lowest of 100,000 readings that get at least half of the largest dose; growth is 0.03 a period."""
    policy = fewer(laws.law(share=0.75), levels)
    found = certify(policy, replace(FAST, setpoints=(0.4, 0.405)))
    x = np.linspace(0.3, 0.42, 100_001)
    dosed = policy.chosen(np.stack([x, np.full_like(x, 0.4)], axis=1)) >= 0.4999 * policy.actions[-1]
    below = np.log(0.4 / x[dosed].min()) / 0.03
    assert below > 0.2
    counted = [check.value for check in found.checks if "half of the largest dose" in check.name]
    assert counted == pytest.approx([below] * 2, abs=0.01)


def test_how_much_later_than_the_law_a_policy_arrives_where_it_is_to_arrive() -> None:
    """Within the law's half-width and the margin; of a law that never does, periods count from the start."""
    every, law, policy = np.ones(3, dtype=bool), np.array([0.1, 0.2, 0.3]), np.array([0.125, 0.1875, 0.75])
    untils = [Mock(return_value=np.array(periods)) for periods in ([5.0, 7.0, np.inf], [3.0, np.inf, 2.0])]
    ends, bands = np.array([[-0.6, 0.6], [-0.7, 0.7], [-0.8, 0.8]]), (SimpleNamespace(until=each) for each in untils)
    proof = Proof(None, every, *bands, policy, law, ends, np.ones(3), every)
    assert proof.later.tolist() == [2.0, 7.0, np.inf]
    for until in untils:
        np.testing.assert_allclose(until.call_args.args, ends.T)
    np.testing.assert_allclose(proof.excess, [0.025, -0.0125, 0.45])


def test_how_low_a_dose_may_still_be_given_counts_periods_of_the_growth_of_each_strip() -> None:
    """Level 2 from -0.3 on and 1 from -0.5 on, of which no more counts than the start, -0.4; and nothing above zero."""
    pieces = Pieces(
        np.array([[-9.0, -0.5, -0.3], [-9.0, 0.1, 0.2]]), np.array([[-0.5, -0.3, 9.0], [0.1, 0.2, 9.0]]),
        np.array([[0, 1, 2], [0, 1, 2]]),
    )  # fmt: skip
    one: Any = SimpleNamespace(
        low=np.zeros(2), growth=np.array([0.1, 0.05]), states=lambda case: None,
        range=lambda case: np.array([[-0.4, 1.0], [-0.4, 1.0]]),
    )  # fmt: skip
    points: Any = SimpleNamespace(pieces=lambda action, states, strips: pieces)
    np.testing.assert_allclose(dose_below(one, points, np.zeros(0, int), None, (1, 2)), [[4.0, 0.0], [3.0, 0.0]])
    pieces.low[1, 1:] = -0.1, 0.2
    np.testing.assert_allclose(dose_below(one, points, np.zeros(0, int), None, (1, 2)), [[4.0, 2.0], [3.0, 0.0]])


def test_the_worst_strip_is_named_of_those_that_are_asked_about() -> None:
    """Of five strips the second has no proof; the last one, which is worst of the others, cannot be held."""
    edges = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    asked: Any = SimpleNamespace(loop=SimpleNamespace(low=edges[:-1], high=edges[1:]), what="setpoint")
    value, held = np.array([0.1, np.nan, 0.3, 0.2, 9.0]), np.array([True, False, True, True, False])
    assert str(_worst("wide", asked, value, 0.25, held)) == "wide: 0.3, allowed 0.25 (setpoint 0.5 to 0.6)"
    unproven = _worst("wide", asked, value, 0.25, held | [False, True, False, False, False])
    assert (unproven.where, unproven.holds) == ("setpoint 0.4 to 0.5", False)
    assert _worst("wide", asked, value, 0.25, np.zeros(5, dtype=bool)).holds
    found = _count("none", asked, np.array([False, True, True, False, True]))
    assert str(found) == "none: 3, allowed 0 (setpoint 0.4 to 0.6, setpoint 0.7 to 0.8)"


def test_bands_of_the_one_line_law_by_hand() -> None:
    """r = 1. Nominal: mu tau is level 8, which is dosed while |d| < B/32: the band.

    Noise n: level 8 may be dosed up to exp(B/32) + n; a lower level, chosen as much lower by a reading n too low, lets
    a culture grow to at most exp(B/32) + n exp(B/2).
    Uncertain by 30 %: level 13 is the last that may let the culture grow, 0.039 > 0.06 (13/16) / 1.3, and is dosed up
    to d = B (13.5/16 - 0.5); level 14 is dosed from there on and may take 0.06 (14/16) / 0.7 with a growth of 0.021.
    """
    one, q, n = loop(1.0, 1.0), 0.3, 0.0108
    bands = [images(one.law(case), one.shift(case), one.range(case)) for case in
             (OdCase("", 0, 0), OdCase("", 0, n), OdCase("", q, 0))]  # fmt: skip
    assert one.half_width(bands[0].low, bands[0].high)[0] == pytest.approx(np.expm1(LARGEST / 32), abs=1e-9)
    highest = np.exp(LARGEST / 32)
    assert highest + n <= np.exp(bands[1].high[0]) <= highest + n * np.exp(LARGEST / 2)
    switch = LARGEST * (13.5 / 16 - 0.5)
    assert bands[2].high[0] == pytest.approx(switch + 0.039 - 0.06 * 13 / 16 / 1.3, abs=1e-9)
    assert bands[2].low[0] == pytest.approx(switch + 0.021 - 0.06 * 14 / 16 / 0.7, abs=1e-9)


def test_the_law_of_a_strip_is_that_of_each_of_its_setpoints_and_of_every_reading() -> None:
    """Setpoints 0.2 to 0.5, readings within 0.02, periods of 2 min: the rate nearest to it is among those found."""
    found = replace(loop(0.2, 0.5), control_min=2.0).law(OdCase("", 0.0, 0.02))
    d, r, off = np.meshgrid(np.linspace(-0.3, 0.4, 141), np.linspace(0.2, 0.5, 31), np.linspace(-0.02, 0.02, 5))
    wanted = (0.03 + np.log(np.exp(d) + off / r) / 2.0) / 3.0
    level = np.clip(np.rint(wanted / 0.00125), 0, 16).astype(int)
    assert (found.low[0][level] <= d + 1e-9).all()
    assert (found.high[0][level] >= d - 1e-9).all()


def test_the_band_is_that_of_the_worst_simulated_culture() -> None:
    """Extremes of mu, tau and noise in every combination of two alternating values, 400 periods from far off."""
    policy, r, share, noise = laws.law(), 0.6, 0.3, 0.0108
    regions = partition(Network.of(policy), BOX)[1]
    line, case = loop(r, r), OdCase("", share, noise)
    proof = prove(line, points_in_strips(regions, line.low, line.high), regions.action, case)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 6)).reshape(6, -1)
    x = np.repeat(np.linspace(0.05, 1.5, 200)[:, None], corners.shape[1], axis=1)
    seen = [np.inf, -np.inf]
    for k in range(400):
        mu, tau, off = corners[:3] if k % 2 else corners[3:]
        rate = laws.RATES[policy.act(np.stack([x + noise * off, np.full_like(x, r)], axis=-1).reshape(-1, 2))]
        x = x * np.exp(0.03 * (1 + share * mu) - rate.reshape(x.shape) * 3 / (1 + share * tau))
        if k > 300:
            seen = [min(seen[0], x.min()), max(seen[1], x.max())]
    low, high = r * np.exp(proof.band.low[0]), r * np.exp(proof.band.high[0])
    assert low <= seen[0]
    assert seen[1] <= high
    assert max(seen[0] - low, high - seen[1]) < 0.15 * (high - low) / 2.0


def test_a_band_is_as_wide_as_its_farther_end() -> None:
    """At the highest setpoint of a strip; below, exp(-0.2) - 1 = -0.1813 is farther than exp(0.15) - 1 = 0.1618."""
    strips = loop(0.5, 0.6)
    ends = np.array([[-0.2, 0.15], [-0.1, 0.15], [-0.1, 0.1], [-0.5, 0.0]])
    found = [float(strips.half_width(low, high)[0]) for low, high in ends[:, :, None]]
    assert found == pytest.approx([0.6 * 0.181269, 0.6 * 0.161834, 0.6 * 0.105171, 0.6 * 0.393469], abs=1e-6)


def test_the_law_passes_and_no_trajectory_leaves_its_band() -> None:
    certificate = proven(laws.law(), config=CertifyConfig())
    assert CertifyConfig().trajectories == 20_000
    assert certificate.passed, [str(check) for check in certificate.checks]
    assert certificate.cannot_hold() == []
    assert certificate.drops == []


def test_a_band_that_is_too_narrow_is_left() -> None:
    policy = laws.law()
    certificate = proven(policy)
    proof = certificate.proofs[-1]
    narrow = replace(proof, band=replace(proof.band, low=0.9 * proof.band.low, high=0.9 * proof.band.high))
    assert attacked(policy, certificate.question.loop, proof, 5000)[0] == 0
    assert attacked(policy, certificate.question.loop, narrow, 5000)[0] > 0


class Excursion(OdLoop):
    """A loop in which the disturbance moves every state up by 0.01 in the first period and back in the next one."""

    def attack(self, case: Any, state: Any, second: Any, push: Any) -> Any:
        seen, change = super().attack(case, state, second, push)
        self.__dict__["asked"] = asked = self.__dict__.get("asked", 0) + 1
        return seen, np.full_like(change, {1: 0.01, 2: -0.01}.get(asked, 0.0))


def test_a_trajectory_that_left_its_band_and_came_back_has_left_it() -> None:
    policy, one = laws.law(), loop(0.6, 0.6)
    case = OdCase("", 0.0, 0.0)
    regions = partition(Network.of(policy), BOX)[1]
    proof = prove(one, points_in_strips(regions, one.low, one.high), regions.action, case)
    narrow = replace(proof, band=replace(proof.band, low=np.full(1, -0.005), high=np.full(1, 0.004)))
    assert attacked(policy, Excursion(**vars(one)), narrow, 300)[0] == 300


FAULTS: dict[str, tuple[Callable[[], Policy], str]] = {
    "random": (lambda: laws.random(0), "half-width over that of the one-line controller, safety"),
    "random, other weights": (lambda: laws.random(1), "without a band"),
    "flipped sign": (lambda: laws.law(gain=-laws.GAIN), "washed out"),
    "reversed actions": (lambda: laws.law(order=-1), "washed out"),
    "law of tau x 2": (lambda: laws.law(share=1.0, gain=2 * laws.GAIN), "median half-width"),
    "full dose in the low corner": (laws.low_corner, "washed out"),
    "no dose in the high corner": (laws.high_corner, "not entered"),
    "spike": (laws.spike, "half of the largest dose below the setpoint, safety"),
    "rests far above": (lambda: laws.law(share=-0.5), "half-width over that of the one-line controller, safety"),
    "rests far below": (lambda: laws.law(share=2.0), "half of the largest dose below the setpoint, safety"),
    "hardly reacts": (lambda: laws.law(gain=1.0), "half-width over that of the one-line controller, safety"),
    "never doses": (lambda: fewer(laws.law(), [0, 1]), "the pump cannot hold"),
    "never the upper half": (lambda: fewer(laws.law(), [*range(8)]), "the pump cannot hold"),
}


@pytest.mark.parametrize(("make", "failing"), FAULTS.values(), ids=list(FAULTS))
def test_a_planted_fault_is_not_safe(make: Callable[[], Policy], failing: str) -> None:
    certificate = proven(make())
    failed = [check.name for check in certificate.failed(SAFETY)]
    assert any(failing in name for name in failed), failed
    assert not certificate.safe


def test_every_setpoint_of_a_range_fails_where_nothing_is_entered() -> None:
    """A strip whose band is not entered is counted as one, whether or not it has a band."""
    proof = proven(laws.law()).proofs[0]
    never = replace(
        proof, band=replace(proof.band, high=proof.band.high - 0.01, path=np.full_like(proof.band.path, 9.0))
    )
    asked, dose = proven(laws.law()).question, np.zeros(80)
    counted = {c.title: c.value for c in _required(asked, [never], dose)}
    assert counted["strips whose band is not entered"] == 80.0
    assert counted["strips without a band"] == 0.0


@pytest.mark.parametrize(("action", "exact", "off"), [(6, True, False), (0, True, True), (9, False, False)])
def test_a_low_culture_grows_only_if_it_does_at_its_slowest(action: int, exact: bool, off: bool) -> None:
    """.03 - 3 * .0075 > 0, but with 30 % less growth and 30 % more flow .021 - 3 * .0075 / .7 < 0."""
    policy, line = laws.low_corner(action), loop(0.4, 0.4)
    regions = partition(Network.of(policy), BOX)[1]
    for share, grows in ((0.0, exact), (0.3, off)):
        proof = prove(line, points_in_strips(regions, line.low, line.high), regions.action, OdCase("", share, 0.0))
        assert proof.grows.tolist() == [grows]


def test_a_swap_of_one_level_is_listed_and_does_no_harm() -> None:
    certificate = proven(laws.swapped_level())
    assert certificate.passed
    assert {drop[2:] for drop in certificate.drops} == {(16, 15)}
    first, second = certificate.drops[0][:2]
    assert first + second > 2.2 - 1e-9


def test_drops_are_found_between_all_corners() -> None:
    """A strip of lower action, a millionth wide, that no setpoint of a grid meets."""
    polygons = [([[0, 0], [1, 0], [1, 0.3], [0, 0.3]], 2), ([[0, 0.300001], [1, 0.300001], [1, 1], [0, 1]], 2)]
    polygons += [([[0, 0.3], [0.5, 0.3], [0.5, 0.300001], [0, 0.300001]], 3)]
    polygons += [([[0.5, 0.3], [1, 0.3], [1, 0.300001], [0.5, 0.300001]], 1)]
    listed = drops(Regions.of([(np.array(corners, dtype=float), action) for corners, action in polygons]))
    assert listed == [(0.5, pytest.approx(0.3000005), 3, 1)]


def test_what_the_pump_cannot_hold_is_said_and_not_judged() -> None:
    """(1 + q)^2 mu tau > u_max from q = 0.414 on."""
    certificate = proven(laws.law(), config=replace(FAST, uncertainty=0.42))
    assert certificate.passed
    assert certificate.cannot_hold() == [
        "uncertain and 1 other: from setpoint 0.4 to 0.8 no pump rate holds the culture"
    ]
    unheld = [proof.case.name for proof in certificate.proofs if not proof.holdable.any()]
    assert unheld == ["uncertain", "noise and uncertain"]
    assert all(proof.holdable.all() for proof in certificate.proofs if proof.case.name not in unheld)
    assert proven(laws.law(), config=replace(FAST, uncertainty=0.41)).cannot_hold() == []
    lost = proven(laws.law(), config=replace(FAST, env=EnvConfig(mu=0.061)))
    assert not lost.passed
    assert str(lost.checks[1]) == "nominal: strips that the pump cannot hold: 80, allowed 0 (setpoint 0.4 to 0.8)"


def test_a_setpoint_alone_finds_what_it_fails() -> None:
    """Also at the ends of the range, and beyond them by the rounding of a setpoint."""
    assert recheck(laws.law(), FAST, [0.4 - 1e-10, 0.65, 0.8 + 1e-10]) == []
    failed = recheck(laws.spike(), FAST, [laws.SPIKE])
    assert failed
    assert all("0.5235" in check.where for check in failed)


def test_the_plane_holds_every_reading_of_every_state_that_is_carried() -> None:
    """A strip carries d up to ln(1.5 / low) for all its setpoints: an OD of 1.5 high / low, and noise on it."""
    asked = question(laws.law(), FAST)
    largest = max((asked.loop.high * np.exp(asked.loop.range(case)[:, 1])).max() for case in asked.cases)
    assert largest > 1.518
    assert asked.box[0][0] <= -FAST.noise
    assert asked.box[0][1] >= largest + FAST.noise


def test_policies_that_cannot_be_asked_say_why() -> None:
    with pytest.raises(CertificationError, match=r"acts every 1 min, but env\.control_min = 2; set env\.control_min=1"):
        question(laws.law(), replace(FAST, env=EnvConfig(control_min=2.0)))
    with pytest.raises(ValueError, match=r"setpoints = \[0.5, 0.5\]: allowed \[low, high\] with low < high"):
        CertifyConfig(setpoints=(0.5, 0.5))
