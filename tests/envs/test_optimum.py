"""The dynamic-programming optimum against independent numbers and against policies that should not beat it."""

from itertools import product

import numpy as np
import pytest

from envs.optimum import solve, solve_episode
from envs.task import EnvConfig, step_factors
from experiments.training.density import DensityTask
from experiments.training.evaluation import Evaluation
from experiments.training.session import merit

pytestmark = pytest.mark.numeric


@pytest.fixture(scope="module")
def evaluation():
    config = EnvConfig()
    return Evaluation(DensityTask(config), DensityTask(config).report_grid())


def test_cost_and_steady_error_of_the_nominal_task(evaluation):
    """An independent computation gave J* = 2.068 for mu 0.03, tau 1/3.

    A level more or less changes x by a 16th of 0.06 x, 0.0037 at x = 1, where x then rests within a quarter of that.
    """
    assert evaluation.optimum_cost == pytest.approx(2.068, abs=1e-3)
    assert evaluation.optimum_steady == pytest.approx(0.0037 / 4, abs=1e-4)


def test_starts_that_are_scored_are_known_where_training_begins_in_fewer():
    known = solve_episode(EnvConfig(start_od=(0.3, 0.5), episode_steps=2), 0.4, spacing=0.01)
    assert np.exp(known.grid[0]) <= 0.1
    assert np.exp(known.grid[-1]) >= 1.1


def of(law):
    """A law of OD and setpoint as a policy of observations."""
    return lambda observation: law(observation[..., 0], observation[..., 1])


def aiming(factors, at=lambda setpoint: setpoint):
    """The law that aims at `at(setpoint)` in one step."""
    return lambda od, setpoint: np.abs(od[..., None] * factors - at(setpoint)[..., None]).argmin(-1)


def tables(rng, actions):
    """A policy drawn at random: an action for each cell of log OD and setpoint."""
    table = rng.integers(0, actions, (40, 20))
    return lambda od, setpoint: table[
        np.clip((np.log(np.maximum(od, 1e-3)) * 8 + 20).astype(int), 0, 39), (setpoint * 10).astype(int)
    ]


@pytest.mark.parametrize(
    "model",
    [
        {},
        {"tau": 0.45},
        {"control_min": 5.0, "integrator": "rk4"},
        {"n_actions": 2},
        {"tau": 0.7},
        {"tau": 1.0},
        {"mu": 0.07},
        {"mu": 0.1, "tau": 100.0},
    ],
    ids=lambda model: " ".join(f"{k}={v}" for k, v in model.items()) or "nominal",
)
def test_nothing_beats_the_optimum(model):
    """Also of a culture that outgrows the pump (the last four); 0.002 % is left since V is linear in each cell."""
    config = EnvConfig(**model, setpoints=(0.2, 0.6, 1.0))
    score, rng = Evaluation(DensityTask(config), DensityTask(config).report_grid()), np.random.default_rng(0)
    factors, endless = step_factors(config), solve(config, grid=3001)
    rivals = {
        "one step ahead": aiming(factors),
        **{f"at {m} s": aiming(factors, lambda s, m=m: m * s) for m in (0.99, 0.95, 0.9, 0.7, 0.6, 0.5, 0.1)},
        "bang-bang": lambda od, setpoint: np.where(od > setpoint, config.n_actions - 1, 0),
        "always the most": lambda od, setpoint: np.full(od.shape, config.n_actions - 1),
        "without an end": lambda od, setpoint: endless.act(od[0], setpoint[0])[None],
        **{f"table {k}": tables(rng, config.n_actions) for k in range(5)},
    }
    regret = {name: float(score(of(rival)).regret_pct[0]) for name, rival in rivals.items()}
    assert min(regret.values()) >= -0.002, regret


@pytest.mark.parametrize("model", [{}, {"tau": 1.0}], ids=["held", "outgrown"])
def test_short_episodes_agree_with_all_sequences_of_actions(model):
    """Three actions and seven steps: the least cost of all 2187 sequences, also where the setpoint changes."""
    config = EnvConfig(n_actions=3, episode_steps=7, control_min=4.0, **model)
    factors = step_factors(config)
    for setpoint, start in product((0.3, 0.7, np.repeat([0.7, 0.3], (3, 4))), (0.2, 0.5, 0.75, 1.0)):
        sequences = factors[np.array(list(product(range(3), repeat=7)))]
        least = ((start * np.cumprod(sequences, axis=1) - setpoint) ** 2).sum(axis=1).min()
        ods, actions = solve_episode(config, setpoint).rollout(np.array([start]))
        assert ((ods[:, 0] - setpoint) ** 2).sum() == pytest.approx(least, rel=2e-4)
        np.testing.assert_allclose(ods[:, 0], start * np.cumprod(factors[actions[:, 0]]))


def test_an_offset_at_one_setpoint_shows(evaluation):
    """A law that aims at 0.212 where 0.2 is asked for, and at the setpoint everywhere else."""
    score = evaluation(
        of(aiming(step_factors(EnvConfig()), lambda setpoint: np.where(setpoint < 0.25, 0.212, setpoint)))
    )
    assert score.steady_by_setpoint.shape == (1, 9)
    assert score.steady_by_setpoint[0, 0] == pytest.approx(0.012, abs=0.001)
    assert score.steady_by_setpoint[0, 1:].max() < 0.002
    assert score.steady_abs_error[0] == score.steady_by_setpoint[0, 0]
    assert merit(score, DensityTask(EnvConfig()))[0] == pytest.approx(0.012 / 0.003, rel=0.1)


def test_starts_too_far_for_a_slow_pump_do_not_count_as_offsets():
    """At tau = 0.6 the culture thins by 0.3 % a minute: from 1.1 the setpoint 0.2 is eight hours away."""
    config = EnvConfig(tau=0.6)
    evaluation = Evaluation(DensityTask(config), DensityTask(config).report_grid())
    assert evaluation.optimum_steady < 0.001
    exact = evaluation(of(aiming(step_factors(config))))
    assert exact.steady_abs_error[0] < 0.001
    offset = evaluation(of(aiming(step_factors(config), lambda setpoint: np.where(setpoint < 0.25, 0.212, setpoint))))
    assert offset.steady_abs_error[0] == pytest.approx(0.012, abs=0.001)


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


def test_setpoints_in_any_order_have_each_their_own_best_action():
    """At an OD of 0.5 all of the pump where 0.2 is asked for, none of it for 1.0; held at 0.5, half of it."""
    policy = solve(EnvConfig(setpoints=(1.0, 0.2, 0.5)), grid=601)
    assert policy.act(np.full(3, 0.5), np.array([0.2, 1.0, 0.5])).tolist() == [16, 0, 8]
    assert policy.gamma == 0.99
