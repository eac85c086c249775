"""The dynamic-programming optimum against independent numbers and against policies that should not beat it."""

import numpy as np
import pytest

from envs.optimum import solve
from envs.task import EnvConfig, step_factors
from experiments.training.evaluation import Evaluation, report_grid


@pytest.fixture(scope="module")
def evaluation():
    config = EnvConfig()
    return Evaluation(config, 0.99, report_grid(config))


def test_cost_and_steady_error_of_the_nominal_task(evaluation):
    """An independent computation gave J* = 2.068 and a steady error of 0.0005 for mu 0.03, tau 1/3."""
    assert evaluation.optimum_cost == pytest.approx(2.068, abs=1e-3)
    assert evaluation.optimum_steady == pytest.approx(0.0005, abs=1e-4)


def test_one_step_inverse_law_does_not_beat_the_optimum(evaluation):
    """The law that aims at the setpoint in one step is nearly optimal here.

    J sums 100 undiscounted steps, the optimum minimises the discounted sum: 1e-3 % of room remains between the two.
    """
    factors = evaluation.factors

    def inverse(od, setpoint):
        return np.abs(od[..., None] * factors - setpoint[..., None]).argmin(-1)

    score = evaluation(inverse)
    assert -1e-3 <= score.regret_pct[0] < 1.0


def test_random_and_constant_policies_lose_clearly(evaluation):
    rng = np.random.default_rng(0)
    random = evaluation(lambda od, setpoint: rng.integers(0, 17, od.shape))
    constant = evaluation(lambda od, setpoint: np.full(od.shape, 8))
    assert random.regret_pct[0] > 100.0
    assert constant.regret_pct[0] > 100.0


def test_value_iteration_agrees_on_a_coarse_grid():
    """Policy iteration's fixed point is that of plain value iteration on the same grid."""
    config = EnvConfig()
    policy = solve(config, gamma=0.9, setpoints=np.array([0.5]), grid=301)
    od = np.exp(policy.log_od)
    spacing = policy.log_od[1] - policy.log_od[0]
    position = np.clip(np.arange(301)[:, None] + np.log(step_factors(config)) / spacing, 0, 300 - 1e-6)
    left, value = position.astype(int), np.zeros(301)
    weight = position - left
    stage = (od[:, None] * step_factors(config) - 0.5) ** 2
    for _ in range(400):
        value = (stage + 0.9 * ((1 - weight) * value[left] + weight * value[left + 1])).min(axis=1)
    np.testing.assert_allclose(policy.value[0], value, rtol=1e-6, atol=1e-10)


def test_a_setpoint_it_was_not_solved_for_is_refused():
    policy = solve(EnvConfig(setpoints=(0.5,)), grid=301)
    with pytest.raises(ValueError, match=r"setpoint 0\.6: the optimum was solved for"):
        policy.act(np.array([0.5]), np.array([0.6]))
