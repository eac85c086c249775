"""The dynamic-programming optimum against independent numbers, also in relative coordinates, where one line is it."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from envs.optimum import solve, solve_episode, solve_relative
from envs.relative import RelativeConfig, RelativeVectorEnv, nearest_level
from envs.task import EnvConfig, step_factors
from experiments.training.density import DensityTask
from experiments.training.evaluation import Evaluation
from experiments.training.relative import Relative
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


CONFIG = RelativeConfig()


@pytest.mark.parametrize(
    "overrides", [{}, {"mu": 0.011, "tau": 0.55}, {"control_min": 5.0, "max_pump_rate": 0.05, "tau": 0.6}]
)
def test_a_step_is_a_period_of_the_growth_model(overrides: dict[str, float]) -> None:
    """x' = (mu - u/tau) x over one period, finely integrated, from three OD towards two setpoints, for every level."""
    model = EnvConfig(integrator="rk4", **overrides)  # type: ignore[arg-type]
    od, setpoint = (a.ravel() for a in np.meshgrid([0.3, 0.5, 0.8], [0.4, 0.7]))
    full_pump = model.max_pump_rate * model.control_min / model.tau
    error, share = np.log(od / setpoint) / full_pump, model.mu * model.control_min / full_pump
    env = RelativeVectorEnv(od.size, RelativeConfig(growth_shares=(0.01, 0.999)))
    env.reset(seed=0)
    for action in range(17):
        env.state[:] = np.stack([error, np.full(od.size, share)], axis=1)
        _, reward, *_ = env.step(np.full(od.size, action))
        reached = od * step_factors(model)[action]
        np.testing.assert_array_equal(env.state[:, 1], share)
        np.testing.assert_allclose(setpoint * np.exp(full_pump * env.state[:, 0]), reached, rtol=1e-6)
        np.testing.assert_allclose(reward, -((np.log(reached / setpoint) / full_pump) ** 2), rtol=1e-5, atol=1e-9)


def test_starts_cover_the_range_and_depend_on_the_seed_of_their_copy_alone() -> None:
    many, one = RelativeVectorEnv(2000), RelativeVectorEnv(1)
    start = many.reset(seed=3)[0]
    low, high = CONFIG.growth_shares
    for k, (least, most) in enumerate([(-1.2, 1.2), (low, high)]):
        quarters = np.quantile(start[:, k], [0.25, 0.5, 0.75])
        np.testing.assert_allclose(quarters, np.linspace(least, most, 5)[1:4], atol=0.07)
    thirds = [np.histogram2d(*start.T, 3)[0] / len(start)]  # every error with every share, none is left untrained
    np.testing.assert_allclose(thirds, 1.0 / 9.0, atol=0.025)
    np.testing.assert_array_equal(one.reset(seed=3 + 41)[0][0], start[41])


def test_the_nearest_level_by_hand() -> None:
    error = np.array([-2.0, 0.0, 0.03, 0.04, 0.2, 0.5, 2.0])
    #              clip(e + s) 16:  0   8   8.48  8.64  11.2  16  16
    assert nearest_level(error, np.full(7, 0.5)).tolist() == [0, 8, 8, 9, 11, 16, 16]
    #              clip(e + s) 32:  0   16  16.96  17.28  22.4  32  32;    clip(e + s) 4: 0  2  2.12  2.16  2.8  4  4
    assert nearest_level(error, np.full(7, 0.5), 33).tolist() == [0, 16, 17, 17, 22, 32, 32]
    assert nearest_level(error, np.full(7, 0.5), 5).tolist() == [0, 2, 2, 2, 3, 4, 4]


@pytest.mark.parametrize("levels", [5, 9])
def test_the_one_line_law_is_the_optimum_of_any_number_of_levels(levels: int) -> None:
    task = Relative(replace(CONFIG, n_actions=levels))
    law = Evaluation(task, task.report_grid()[::7])(task.myopic)
    assert abs(law.regret_pct[0]) < 1e-3


def test_nothing_beats_the_optimum_and_the_one_line_law_is_it() -> None:
    task = Relative(CONFIG)
    evaluation = Evaluation(task, task.report_grid()[::5])
    law = evaluation(task.myopic)
    assert abs(law.regret_pct[0]) < 1e-5  # the optimum's values are interpolated
    rng = np.random.default_rng(0)
    for change in (0.02, 0.1, 0.5):  # a law that is off by so much
        off = evaluation(
            lambda o, by=change: nearest_level(o[..., 0] + by * rng.standard_normal(o.shape[:-1]), o[..., 1])
        )
        assert off.regret_pct[0] > law.regret_pct[0]
    assert evaluation(lambda o: nearest_level(o[..., 0] + 0.03, o[..., 1])).regret_pct[0] > 0.1


def test_a_finer_grid_finds_the_same_optimum() -> None:
    starts = np.linspace(-1.2, 1.2, 13)
    for share in (0.05, 0.317, 0.6, 0.98):
        coarse, fine = (solve_relative(CONFIG, share, 40, spacing) for spacing in (1 / 256, 1 / 1024))
        costs = [np.square(o.rollout(starts)[0]).sum() for o in (coarse, fine)]
        assert costs[0] == pytest.approx(costs[1], rel=2e-4)
