"""The task's numbers: step factors, action grid, range checks."""

import numpy as np
import pytest

from envs.task import EnvConfig, pump_rates, step_factors, tracking_reward


def test_action_grid_is_the_papers():
    rates = EnvConfig().pump_rates()
    assert rates.size == 17
    assert rates[0] == 0.0
    assert rates[-1] == 0.02
    np.testing.assert_allclose(np.diff(rates), 0.00125)


def test_ten_euler_steps_of_a_tenth_of_a_minute():
    """f = (1 + h (mu - u/tau))^10, written out here a second time."""
    config = EnvConfig(mu=0.023, tau=0.29)
    expected = (1.0 + 0.1 * (0.023 - config.pump_rates() / 0.29)) ** 10
    np.testing.assert_allclose(step_factors(config), expected, rtol=1e-14)


def test_fine_runge_kutta_steps_approach_the_exponential():
    config = EnvConfig(integrator="rk4", substeps=50)
    exact = np.exp(config.mu - config.pump_rates() / config.tau)
    np.testing.assert_allclose(step_factors(config), exact, rtol=1e-12)


def test_reward_is_minus_the_squared_error():
    np.testing.assert_allclose(tracking_reward(np.array([0.5, 0.7]), np.array([0.5, 0.4])), [0.0, -0.09])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mu", 0.0), ("mu", -0.1), ("mu", float("nan")), ("tau", 0.0), ("control_min", 0.0), ("integrator", "leapfrog"),
        ("substeps", 0), ("n_actions", 1), ("max_pump_rate", 0.2), ("episode_steps", 0), ("setpoints", ()),
        ("setpoints", (0.5, 5.0)), ("start_od", (1.0, 0.5)), ("final_reward_weight", -1.0),
    ],
)  # fmt: skip
def test_values_out_of_range_are_named(key, value):
    with pytest.raises(ValueError, match=rf"env\.{key} = .*allowed"):
        EnvConfig(**{key: value})


def test_a_pump_that_cannot_stop_is_refused():
    with pytest.raises(ValueError, match="allowed >= 2"):
        pump_rates(1)
