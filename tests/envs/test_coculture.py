"""The composition task: rates by hand, the integrator, announced changes, and an optimum that nothing beats."""

import itertools

import numpy as np
import pytest

from envs.coculture.optimum import Grid, best_action, cost_to_go, transitions
from envs.coculture.task import CocultureConfig, CocultureVectorEnv, advance, at_rest, limits, logit, passed, share
from experiments.coculture.task import Coculture
from experiments.training.evaluation import Evaluation
from tests.two_species import EQUAL_RATES_C, p_putida_rate

pytestmark = pytest.mark.numeric

PREVIEW = CocultureConfig(control_min=30.0, episode_steps=24, preview_min=360.0)


def test_an_announced_change_comes_nearer_and_is_then_the_setpoint() -> None:
    goal = np.array([[0.1, 0.9, 60.0]])
    np.testing.assert_array_equal(first := passed(PREVIEW, goal), [[0.1, 0.9, 30.0]])
    np.testing.assert_array_equal(second := passed(PREVIEW, first), [[0.9, 0.9, 0.0]])
    np.testing.assert_array_equal(passed(PREVIEW, second), second)
    slow = CocultureConfig(control_min=20.0, preview_min=360.0)
    np.testing.assert_array_equal(passed(slow, goal), [[0.1, 0.9, 40.0]])
    np.testing.assert_array_equal(passed(slow, np.array([[0.1], [0.2]])), [[0.1], [0.2]])


def test_starts_are_drawn_one_by_one() -> None:
    """Share, temperature, setpoint, the next one and when it comes: none is known from another."""
    env = CocultureVectorEnv(4000, PREVIEW)
    env.reset(seed=1)
    alike = np.corrcoef(env.state[:, [0, 1, 3, 4, 5]].T)
    assert np.abs(alike - np.eye(5)).max() < 0.06


def test_the_reward_is_that_of_the_setpoint_in_force() -> None:
    env = CocultureVectorEnv(2, PREVIEW)
    env.reset(seed=0)
    rest = at_rest(PREVIEW, logit(np.array([0.3, 0.3])))
    env.state[:] = np.concatenate([rest, logit(np.array([[0.4, 0.8]] * 2)), [[30.0], [60.0]]], axis=1)
    for wanted in ([0.4, 0.4], [0.8, 0.4], [0.8, 0.8]):
        _, reward, *_ = env.step(np.array([10, 10]))
        np.testing.assert_allclose(reward, -np.square(share(env.state[:, 0]) - wanted), rtol=1e-12)


def minutes_of_two(state: np.ndarray, target: np.ndarray, minutes: float, step: float = 0.1) -> np.ndarray:
    """State (N, 3) after `minutes` at targets (N,), by equations written down here, in steps of 6 s.

    A vial cools towards 24 degC with 39 min, a heater adds up to 2 degC/min until the target; mu_e follows at once,
    m_p with 60 min; the logit grows by their difference.
    """
    x, warm, m_p = state.T.copy()
    for _ in range(round(minutes / step)):
        falls = (warm - 24.0) / 39.0
        warm = np.maximum(warm - falls * step, np.minimum(target, warm + (2.0 - falls) * step))
        mu_p = -0.02208 * warm**2 + 1.3796 * warm - 20.56996
        m_p = m_p + (mu_p - m_p) / 60.0 * step
        x = x + (m_p - (0.07727 * warm - 1.66954)) / 60.0 * step
    return np.stack([x, warm, m_p], axis=1)


def test_share_heat_and_rate_follow_their_equations() -> None:
    """Heated, cooled and held; a minute of the task is one step, of which the heat is late by less than a tenth."""
    rng = np.random.default_rng(1)
    warm = rng.uniform(29.0, 36.0, 50)
    state = np.stack([rng.normal(0.0, 1.0, 50), warm, rng.uniform(0.5, 0.95, 50)], axis=1)
    target = np.where(rng.uniform(size=50) < 0.2, warm, rng.uniform(29.0, 36.0, 50))
    for minutes in (30.0, 240.0):
        ours, theirs = advance(PREVIEW, state, target, minutes), minutes_of_two(state, target, minutes, 0.01)
        np.testing.assert_allclose(ours[:, 1], theirs[:, 1], atol=0.02)
        np.testing.assert_allclose(ours[:, 2], theirs[:, 2], atol=2e-3)
        np.testing.assert_allclose(ours[:, 0] - state[:, 0], theirs[:, 0] - state[:, 0], atol=4e-3)


def test_short_programs_agree_with_all_sequences_of_actions() -> None:
    """Three temperatures, six decisions, a change in the middle: the least cost of all 729 sequences, each followed by
    other equations than the optimum's own; a decision too many or too few would cost a tenth."""
    config = CocultureConfig(control_min=30.0, n_actions=3, preview_min=90.0)
    model = transitions(config, Grid(logits=321, temperatures=29, rates=9, logit_span=3.0))
    program = np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5])
    value, start = cost_to_go(model, program[:, None]), np.array([[np.log(0.3 / 0.7), EQUAL_RATES_C, 0.0]])
    start[0, 2] = -0.02208 * EQUAL_RATES_C**2 + 1.3796 * EQUAL_RATES_C - 20.56996
    targets = np.array([29.0, 32.5, 36.0])
    state, cost = start, 0.0
    for k, wanted in enumerate(program):
        action = best_action(config, model, value[k + 1, :, 0], state, np.array([wanted]))
        state = minutes_of_two(state, targets[action], 30.0)
        cost += float(np.square(1.0 / (1.0 + np.exp(-state[0, 0])) - wanted))
    sequences = targets[np.array(list(itertools.product(range(3), repeat=6)))]
    states, costs = np.repeat(start, 729, axis=0), np.zeros(729)
    for k, wanted in enumerate(program):
        states = minutes_of_two(states, sequences[:, k], 30.0)
        costs += np.square(1.0 / (1.0 + np.exp(-states[:, 0])) - wanted)
    assert cost == pytest.approx(costs.min(), rel=5e-3)
    assert np.sort(costs)[1] > 1.005 * costs.min()


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.6])
def test_the_optimum_s_grid_holds_what_a_culture_can_be(scale: float) -> None:
    """At rest anywhere from 29 to 36 degC, the second species growing by its curve times its scale."""
    config = CocultureConfig(scale_p=scale, scale_e=1.3)
    temperature, rate, x = Grid().axes(config)
    curve = scale * p_putida_rate(np.linspace(29.0, 36.0, 701))
    assert (temperature[0], temperature[-1], x[0], x[-1]) == (29.0, 36.0, -6.0, 6.0)
    assert (rate[0], rate[-1]) == pytest.approx((curve.min(), curve.max()), rel=1e-3)
    rest = at_rest(config, np.zeros(3), np.array([29.0, 31.2, 36.0]))
    np.testing.assert_allclose(rest[:, 2], scale * p_putida_rate(np.array([29.0, 31.2, 36.0])), rtol=1e-9)
    low, high = limits(config)
    assert low[2] <= curve.min() < curve.max() <= high[2]


def test_a_minute_by_hand_of_a_pair_a_heater_and_a_room_of_one_s_own() -> None:
    """From 30 degC towards 35 in a room of 20: the heater adds 0.5 degC to what 20 min of cooling leave."""
    config = CocultureConfig(scale_e=1.3, scale_p=0.7, heating_c_per_min=0.5, cooling_min=20.0, ambient_c=20.0)
    warm = 20.0 + 10.0 * np.exp(-0.05) + 0.5
    mean, follow = 0.5 * (30.0 + warm), 1.0 - np.exp(-1.0 / 60.0)
    mu_e, mu_p = 0.07727 * mean - 1.66954, -0.02208 * mean**2 + 1.3796 * mean - 20.56996
    for errors, e, p in ((None, 1.3, 0.7), (np.array([0.1, -0.2]), 1.43, 0.56)):
        after = advance(config, np.array([0.4, 30.0, 0.5]), np.float64(35.0), 1.0, errors)
        rate = 0.5 + (p * mu_p - 0.5) * follow
        np.testing.assert_allclose(after, [0.4 + (0.5 * (0.5 + rate) - e * mu_e) / 60.0, warm, rate], rtol=1e-9)


def test_each_number_of_a_start_is_of_its_own_range() -> None:
    """Few start where the setpoints are, and a change comes after one, two or three decisions."""
    config = CocultureConfig(
        start_share=(0.05, 0.2), setpoints=(0.6, 0.9), temperatures=(30.0, 32.0), control_min=30.0, preview_min=90.0
    )
    env = CocultureVectorEnv(300, config)
    env.reset(seed=3)
    for values, low, high in (
        (share(env.state[:, 0]), 0.05, 0.2),
        (env.state[:, 1], 30.0, 32.0),
        (share(env.state[:, 3]), 0.6, 0.9),
        (share(env.state[:, 4]), 0.6, 0.9),
    ):
        assert low <= values.min() < low + 0.02 * (high - low) + 1e-9
        assert high - 0.02 * (high - low) < values.max() <= high
    assert set(env.state[:, 5]) == {30.0, 60.0, 90.0}
    np.testing.assert_allclose(env.state[:, 2], p_putida_rate(env.state[:, 1]), rtol=1e-9)
    env.reset(options={"temperature": 31.0, "next_setpoint_logit": 1.5})
    np.testing.assert_array_equal(env.state[:, [1, 4]], np.tile([31.0, 1.5], (300, 1)))


@pytest.fixture(scope="module")
def tasks() -> dict[str, Evaluation]:
    """Both tasks on a few starts, with few programs: from several shares to .2 and .7, and changes between four."""
    found = {}
    for name, config in (("plain", CocultureConfig()), ("preview", PREVIEW)):
        task = Coculture(config)
        grid = task.report_grid()
        goals = np.isin(share(grid[:, 3]).round(6), (0.2, 0.7))
        found[name] = Evaluation(task, grid[goals][::3] if name == "plain" else grid[::17])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "preview"])
def test_nothing_beats_the_optimum(tasks: dict[str, Evaluation], name: str) -> None:
    evaluation = tasks[name]
    targets, rng = evaluation.task.actions, np.random.default_rng(0)  # type: ignore[attr-defined]

    def towards(observation: np.ndarray, gain: float) -> np.ndarray:
        wanted = EQUAL_RATES_C - gain * (observation[..., 3] - observation[..., 0])
        return np.asarray(np.abs(wanted[..., None] - targets).argmin(-1))

    rivals = {gain: evaluation(lambda o, g=gain: towards(o, g)).regret_pct[0] for gain in (3.0, 10.0, 20.0, 100.0)}
    rivals["random"] = evaluation(lambda o: rng.integers(0, 17, o.shape[:-1])).regret_pct[0]
    assert min(rivals.values()) > -0.05, rivals
    assert rivals["random"] > 50.0
