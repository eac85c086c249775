"""The task in relative coordinates: the growth model in other units, with the one-line controller as optimum."""

from dataclasses import replace

import numpy as np
import pytest

from envs.optimum import solve_relative
from envs.relative import RelativeConfig, RelativeVectorEnv, nearest_level
from envs.task import EnvConfig, step_factors
from experiments.training.evaluation import Evaluation
from experiments.training.relative import Relative

pytestmark = pytest.mark.numeric

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
