"""The two-chamber rig: steady state by hand, closed forms, balances, small doses, an empty reservoir, the optimum."""

import itertools

import numpy as np
import pytest

from envs.dual_chamber.estimator import Estimator, EstimatorConfig
from envs.dual_chamber.laws import PI, FeedForward, Planned, hold_reservoir, spare_reservoir
from envs.dual_chamber.optimum import Grid, best_dose, cost_to_go, doses, model
from envs.dual_chamber.rig import Readings, Rig, RigCase, RigConfig, advance, carried
from envs.dual_chamber.task import cost, fall_min, mixture, settled, start, steady_dose
from envs.plant.noise import streams

RIG = RigConfig()
EXACT = RigCase(
    growth_cv=0.0, gain_cv=0.0, dose_cv=0.0, smallest_ml=0.0, od_sd=0.0, fluorescence_sd=0.0, fluorescence_cv=0.0
)


def rigs(case: RigCase, n: int, state: np.ndarray, config: RigConfig = RIG, seed: int = 0) -> Rig:
    return Rig(config, case, streams(np.random.default_rng(seed), n), np.broadcast_to(state, (n, 4)))


def test_the_steady_state_is_that_of_the_balances_by_hand() -> None:
    """D1 + D2 = .030 and D2 = .010 * .5 * .5 / .5 = .005 a minute: .6 and .1 mL of 20, as growth goes to continuous."""
    fresh, slow = steady_dose(RIG, 0.5, 0.5, 0.5)
    assert slow == pytest.approx(0.1, rel=0.01)
    assert fresh + slow == pytest.approx(0.6, rel=0.02)
    state = start(RIG, 0.5, np.array([0.25, 0.5, 0.75]))
    law, held = FeedForward(RIG, 0.5), state
    for minute in range(200):
        for n, ratio in enumerate((0.25, 0.5, 0.75)):
            dose = law.act(held[n : n + 1], ratio, minute)
            dose[:, 2] = hold_reservoir(RIG, held[n : n + 1], dose[:, 1])
            held[n : n + 1] = advance(RIG, held[n : n + 1], dose)
    np.testing.assert_allclose(held, start(RIG, 0.5, np.array([0.25, 0.5, 0.75])), rtol=1e-9)


def test_many_small_pulses_are_the_differential_equations() -> None:
    """Euler's method on the balances in steps of a thousandth, D's constant, beside pulses of a small rig's minute."""
    rates, flow = np.array([0.03, 0.02]) / 100.0, np.array([0.4, 0.3, 0.2]) / 100.0
    small = RigConfig(mu_fast=rates[0], mu_slow=rates[1])
    pulsed, x = start(small, 0.5, np.array(0.3)), np.array([0.35, 0.15, 0.5])
    for _ in range(6000):
        pulsed = advance(small, np.append(pulsed[:3], 20.0), flow)
        d = flow / 20.0
        x = x + np.array(
            [
                (rates[0] - d[0] - d[1]) * x[0],
                (rates[1] - d[0] - d[1]) * x[1] + d[1] * x[2],
                (rates[1] - flow[2] / 20.0) * x[2],
            ]
        )
    np.testing.assert_allclose(pulsed[:3], x, rtol=2e-3)


def test_the_share_falls_no_faster_than_the_difference_of_growth() -> None:
    state = start(RIG, 0.5, np.array([0.75, 0.5]))
    for _ in range(85):
        state = advance(RIG, state, np.stack([np.full(2, 0.5), np.zeros(2), np.zeros(2)], -1))
    logit = np.log(mixture(state)[1] / (1.0 - mixture(state)[1]))
    np.testing.assert_allclose(logit, np.log([3.0, 1.0]) - 85 * 0.01, rtol=1e-9)
    assert fall_min(RIG, 0.5, 0.3) == pytest.approx(100.0 * np.log(7.0 / 3.0))


def test_volume_and_biomass_are_accounted_for() -> None:
    config = RigConfig(mu_fast=1e-12, mu_slow=1e-13)
    rig = rigs(EXACT, 3, start(config, 0.5, 0.4), config)
    rng, waste = np.random.default_rng(1), np.zeros((3, 3))
    for _ in range(60):
        before, dose = rig.state, rng.uniform(0.0, 1.2, (3, 3)) * [1.0, 0.5, 1.0]
        given = np.minimum(dose[:, 1], before[:, 3] - 1.0)
        rig.step(dose)
        waste[:, :2] += rig.state[:, :2] * (dose[:, :1] + given[:, None])
        waste[:, 2] += rig.state[:, 2] * (before[:, 3] - given + dose[:, 2] - rig.state[:, 3])
    volume = 20.0 + rig.state[:, 3] + rig.waste_ml - rig.fresh_ml
    np.testing.assert_allclose(volume, 40.0, atol=1e-9)
    fast, slow = rig.state[:, 0] * 20.0 + waste[:, 0], rig.state[:, 1] * 20.0 + waste[:, 1]
    np.testing.assert_allclose(fast, 0.3 * 20.0, atol=1e-8)
    np.testing.assert_allclose(slow + rig.state[:, 2] * rig.state[:, 3] + waste[:, 2], 0.2 * 20.0 + 10.0, atol=1e-8)


def test_an_empty_reservoir_gives_nothing() -> None:
    rig = rigs(EXACT, 1, start(RIG, 0.5, 0.5))
    for _ in range(16):
        rig.step(np.array([[0.0, 1.2, 0.0]]))
    assert rig.state[0, 3] == 1.0
    share = mixture(rig.state)[1]
    rig.step(np.array([[0.0, 1.2, 0.0]]))
    logits = np.log([share / (1 - share), mixture(rig.state)[1] / (1 - mixture(rig.state)[1])])
    assert logits[1] - logits[0] == pytest.approx(-0.01)


def test_a_reservoir_below_its_critical_level_runs_dry_and_one_above_it_recovers() -> None:
    """Steady dose at .75: .15 mL of what .0202 VR makes, critical at 7.5 mL."""
    level = {}
    for begin in (6.5, 8.5):
        state = start(RIG, 0.5, np.array([0.75]))
        state[:, 3] = begin
        for minute in range(300):
            dose = FeedForward(RIG, 0.5).act(state, 0.75, minute)
            dose[:, 2] = hold_reservoir(RIG, state, dose[:, 1])
            state = advance(RIG, state, dose)
        level[begin] = state[0, 3]
    assert level[6.5] < 4.5
    assert level[8.5] > 18.0
    asked, steady = np.full(3, 1.2), np.full(3, 0.15)
    state = np.tile(start(RIG, 0.5, 0.5), (3, 1))
    state[:, 3] = 20.0, 11.5, 9.0
    critical = 0.15 / np.expm1(0.02)
    np.testing.assert_allclose(
        spare_reservoir(RIG, state, asked, steady, 1.5), [1.2, 11.5 - 1.5 * critical, 0.15], rtol=1e-9
    )


def test_small_doses_are_put_together_until_they_flow() -> None:
    given, rest = [], np.zeros(2)
    for _ in range(6):
        dose, rest = carried(np.array([0.08, 0.5]), rest, 0.2, 0.4)
        given.append(dose)
    np.testing.assert_allclose(np.array(given)[:, 0], [0, 0, 0.24, 0, 0, 0.24], atol=1e-12)
    np.testing.assert_allclose(np.array(given)[:, 1], 0.4)  # what a pump cannot give is not owed
    assert rest[1] == 0.0
    np.testing.assert_array_equal(carried(np.array([-1.0, 0.1]), np.array([0.1, 0.1]), 0.2, 1.0)[0], [0.0, 0.2])


def test_a_dose_below_the_smallest_does_not_flow() -> None:
    rig = rigs(RigCase(growth_cv=0.0, gain_cv=0.0, dose_cv=0.0), 2, start(RIG, 0.5, 0.5))
    rig.step(np.array([[0.19, 0.19, 0.19], [0.2, 0.2, 0.2]]))
    np.testing.assert_allclose(rig.fresh_ml, [0.0, 0.4])
    np.testing.assert_allclose(rig.waste_ml, [0.0, 0.4])


def test_pumps_grow_and_read_as_the_case_says_and_rigs_are_their_streams() -> None:
    weak = RigCase(reservoir_gain=0.6, fast_scale=0.9, growth_cv=0.0, gain_cv=0.0, dose_cv=0.0)
    rig = rigs(weak, 2, start(RIG, 0.5, 0.5))
    rig.step(np.array([[0.0, 1.0, 0.0]] * 2))
    kept = 20.0 / 20.6
    np.testing.assert_allclose(rig.state[:, 0], 0.25 * kept * np.exp(0.027))
    np.testing.assert_allclose(rig.state[:, 1], (0.25 + 0.5 * 0.03) * kept * np.exp(0.02))
    many, few = (rigs(RigCase(), n, start(RIG, 0.5, 0.5), seed=3) for n in (5, 2))
    for _ in range(3):
        read = [r.step(np.full((n, 3), 0.3)) for r, n in ((many, 5), (few, 2))]
        np.testing.assert_array_equal(np.array(read[0])[:, :2], np.array(read[1]))
    assert len(set(many.growth[:, 0])) == 5


def test_noise_has_the_size_it_is_said_to_have() -> None:
    case = RigCase(growth_cv=0.0, gain_cv=0.0, dose_cv=0.0, fluorescence_cv=0.0, od_sd=0.02, fluorescence_sd=0.05)
    rig = rigs(case, 4000, start(RIG, 0.5, 0.5))
    read = rig.step(np.zeros((4000, 3)))
    assert np.std(read.od) == pytest.approx(0.02, rel=0.05)
    assert np.std(read.reservoir_od) == pytest.approx(0.02, rel=0.05)
    assert np.std(read.fluorescence) == pytest.approx(0.05, rel=0.05)
    assert np.mean(read.fluorescence) == pytest.approx(0.25 * np.exp(0.03), rel=0.01)


def test_the_cost_and_when_a_window_has_settled() -> None:
    state = start(RIG, np.array([0.5, 0.55, 0.5]), np.array([0.5, 0.5, 0.6]))
    np.testing.assert_allclose(cost(state, 0.5, 0.5), [0.0, 0.01, 0.01], atol=1e-12)
    od = np.array([[0.6, 0.5, 0.5], [0.5, 0.6, 0.5], [0.5, 0.5, 0.5], [0.52, 0.5, 0.6]])
    np.testing.assert_array_equal(settled(od, np.full((4, 3), 0.46), 0.5, 0.5), [2.0, 3.0, np.nan])
    np.testing.assert_array_equal(settled(od[:, :1], np.full((4, 1), 0.44), 0.5, 0.5), [np.nan])


def test_a_dense_reservoir_raises_the_share_and_leaves_the_density_alone() -> None:
    config = RigConfig(reservoir_od=1.0)
    state = start(config, 0.5, np.array([0.5]))
    dose = FeedForward(config, 0.5, 0.3, 0.3).act(state, 0.7, 0)
    total, share = mixture(advance(config, state, dose))
    assert share[0] > 0.53
    assert total[0] == pytest.approx(0.5, rel=0.01)


def test_short_programs_agree_with_all_sequences_of_doses() -> None:
    """Three levels of each dose, four minutes, a step in the middle: the least cost of all 6561 sequences."""
    config, grid = RigConfig(largest_ml=4.0), Grid(finest=0.002, widening=0.1, levels=3)
    of = model(config, 0.0, 0.5, (0.5, 0.6), grid)
    program, begin = np.array([0.5, 0.5, 0.6, 0.6]), start(config, 0.55, np.array([0.45]))
    value, state, found = cost_to_go(of, 0.5, program[:, None]), begin, 0.0
    for k, ratio in enumerate(program):
        dose = best_dose(config, of, state, 0.5, np.array([ratio]), value[k + 1, :, 0])
        state = advance(config, np.concatenate([state[:, :2], begin[:, 2:]], 1), dose)
        found += float(cost(state, 0.5, ratio)[0])
    pairs = doses(config, 0.0, 3)
    sequences = pairs[np.array(list(itertools.product(range(9), repeat=4)))]
    states, costs = np.tile(begin, (6561, 1)), np.zeros(6561)
    for k, ratio in enumerate(program):
        states = advance(config, np.concatenate([states[:, :2], np.tile(begin[:, 2:], (6561, 1))], 1), sequences[:, k])
        costs += cost(states, 0.5, ratio)
    assert found == pytest.approx(costs.min(), rel=5e-3)
    assert value[0, :, 0].min() >= 0.0


def test_doses_of_the_plan_flow_or_are_none() -> None:
    levels = np.unique(doses(RIG, 0.2, 13)[:, :2])
    np.testing.assert_allclose(levels, [0.0, *np.arange(2, 13) / 10.0])


@pytest.mark.parametrize("shares", [(0.5,), (0.5, 0.65, 0.5)])
def test_nothing_beats_the_optimum_while_the_reservoir_is_held(shares: tuple[float, ...]) -> None:
    """Noise-free from four starts; planning pays only where a step is known ahead."""
    program = np.repeat(shares, 60)
    of = model(RIG, 0.2, 0.5, (0.5, 0.65), Grid(finest=0.004, widening=0.2))
    laws = {
        "feed_forward": FeedForward(RIG, 0.5),
        "proportional": FeedForward(RIG, 0.5, 0.3, 0.3),
        "pi": PI(RIG, 0.5, 4),
        "myopic": Planned(RIG, 0.5, of),
        "optimum": Planned(RIG, 0.5, of, [*cost_to_go(of, 0.5, program[:, None])[1:, :, 0]]),
    }
    total = {}
    for name, law in laws.items():
        state = start(RIG, np.array([0.45, 0.5, 0.5, 0.6]), np.array([0.3, 0.45, 0.5, 0.6]))
        held, rest, total[name] = state[:, 2:].copy(), np.zeros((4, 3)), 0.0
        for minute, ratio in enumerate(program.tolist()):
            dose, rest = carried(law.act(state, ratio, minute), rest, 0.2, 1.2)
            state = np.concatenate([advance(RIG, state, dose)[:, :2], held], axis=1)
            total[name] += float(cost(state, 0.5, ratio).sum())
    least = total.pop("optimum")
    assert least < 1.0005 * min(total.values()), (least, total)
    if len(shares) > 1:
        assert total["myopic"] > 1.05 * least, (least, total)
    else:
        assert total["myopic"] < 1.01 * least, (least, total)


def filtered(config: EstimatorConfig, plant: RigCase, fluorescence: bool, minutes: int) -> tuple[Rig, Estimator]:
    rig = rigs(plant, 64, start(RIG, 0.5, np.linspace(0.47, 0.53, 64)))
    believed = Estimator(config, RIG, np.tile(start(RIG, 0.5, 0.5), (64, 1)), fluorescence)
    dose = np.tile([0.5, 0.3, 0.4], (64, 1))
    for _ in range(minutes):
        believed.update(dose, rig.step(dose))
    return rig, believed


def test_density_alone_tells_the_strains_apart_by_their_growth() -> None:
    """An exact rig: the share is found from X alone."""
    rig, believed = filtered(EstimatorConfig(growth_sd=1e-5, dose_sd=1e-4, od_sd=1e-4, start_sd=0.06), EXACT, False, 60)
    np.testing.assert_allclose(mixture(believed.state)[1], mixture(rig.state)[1], atol=5e-3)
    np.testing.assert_allclose(believed.state[:, 2:], rig.state[:, 2:], rtol=1e-3)


def test_fluorescence_finds_the_share_where_growth_is_believed_wrongly() -> None:
    wrong = RigCase(fast_scale=0.9)
    error = {}
    for seen in (False, True):
        rig, believed = filtered(EstimatorConfig(), wrong, seen, 120)
        error[seen] = np.square(mixture(believed.state)[1] - mixture(rig.state)[1]).mean()
    assert error[True] < 0.3 * error[False]


def test_the_filter_is_as_sure_as_it_may_be() -> None:
    """Errors over believed standard deviations have the size one where all that is wrong is noise it knows of."""
    case = RigCase(growth_cv=0.0, gain_cv=0.0, fluorescence_cv=0.0, dose_cv=0.03, smallest_ml=0.0)
    config = EstimatorConfig(growth_sd=1e-6, start_sd=0.04)
    for seen in (False, True):
        rig, believed = filtered(config, case, seen, 60)
        error = np.log(believed.state[:, :2] / rig.state[:, :2])
        size = (error**2 / np.diagonal(believed.covariance, axis1=1, axis2=2)[:, :2]).mean()
        assert 0.6 < size < 1.6, (seen, size)


def test_a_minute_of_the_filter_is_the_jacobian_of_the_rig() -> None:
    """The covariance after a prediction beside differences of `advance` in logarithms."""
    config = EstimatorConfig(growth_sd=0.0, dose_sd=0.05, od_sd=0.2, fluorescence_sd=0.2, start_sd=0.1)
    state, dose = start(RIG, np.array([0.5]), np.array([0.4])), np.array([[0.4, 0.7, 0.3]])
    state[:, 3] = 12.0
    believed = Estimator(config, RIG, state, False)
    before = believed.covariance[0].copy()
    believed._predict(dose)

    def after(logs: np.ndarray, scales: np.ndarray) -> np.ndarray:
        return np.log(advance(RIG, np.append(np.exp(logs), 12.0), dose[0] * scales)[:3])

    at, h = np.log(state[0, :3]), 1e-6
    j = np.stack([(after(at + h * e, np.ones(3)) - after(at - h * e, np.ones(3))) / (2 * h) for e in np.eye(3)], -1)
    d = np.stack([(after(at, 1 + h * e) - after(at, 1 - h * e)) / (2 * h) for e in np.eye(3)], -1)
    np.testing.assert_allclose(believed.covariance[0], j @ before @ j.T + 0.0025 * d @ d.T, rtol=0.1, atol=2e-6)


def test_a_reading_far_off_moves_the_filter_by_a_bounded_step() -> None:
    believed = Estimator(EstimatorConfig(start_sd=3.0), RIG, start(RIG, np.array([0.5]), np.array([0.5])), False)
    believed.update(np.zeros((1, 3)), Readings(np.array([50.0]), np.array([0.5]), np.array([0.0])))
    assert np.all(np.isfinite(believed.state))
    assert believed.state[0, :2].max() < 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RigConfig(mu_fast=0.02), r"rig\.mu_fast = 0.02: allowed greater than rig\.mu_slow = 0.02"),
        (lambda: RigConfig(heel_ml=9.0), r"rig\.heel_ml = 9.0 mL: allowed 0.1 to 4"),
        (lambda: RigCase(reservoir_gain=-1.0), r"plant\.reservoir_gain = -1.0: allowed 0 to 2"),
        (lambda: EstimatorConfig(od_sd=0.0), r"estimator\.od_sd = 0.0 OD: allowed"),
    ],
)
def test_bad_values_are_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
