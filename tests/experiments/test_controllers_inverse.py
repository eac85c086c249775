"""Inverse control: its filter against least squares on all data at once, what each part does, what it learns."""

import numpy as np
import pytest

from envs.task import EnvConfig
from experiments.laws.density.estimator import EstimatorConfig
from experiments.laws.density.inverse import Inverse, InverseConfig

pytestmark = pytest.mark.numeric

ONE = np.ones(1, dtype=bool)
PLAIN = {"noise_memory": 0.0, "warmth": 0.0, "warmth_sd": 0.0, "first_dose": 1.0, "first_dose_sd": 0.0, "hurry": 0.0}


def law(model: EnvConfig | None = None, **beliefs: float) -> Inverse:
    """Inverse control on a filter with these beliefs."""
    return Inverse(InverseConfig(estimator=EstimatorConfig(**beliefs)), model or EnvConfig())  # type: ignore[arg-type]


@pytest.mark.parametrize("told", [False, True])
def test_filter_equals_least_squares_on_all_data(told: bool) -> None:
    """Without walks the estimate is the weighted least-squares fit of ln x0, mu, g with their priors.

    What it decides is dosed; or it is told what is, which is something else.
    """
    model = EnvConfig()
    still = {"mu_walk": 0.0, "gain_walk": 0.0, "pulse_cv": 0.0, "growth_cv": 0.0, "gate_sigma": 20.0}
    inverse = law(model, **PLAIN, **still)
    config = inverse.estimator.config
    rng = np.random.default_rng(1)
    inverse.reset(1)
    log_x, dosed, minute = np.log(0.6), 0.0, 0.0
    rows, values, weights = [], [], []
    for k in range(40):
        reading = np.exp(log_x) + 0.005 * rng.standard_normal()
        rows.append([1.0, minute, -dosed])
        values.append(np.log(reading))
        weights.append(reading / np.hypot(config.noise_floor, config.noise_relative * reading))
        setpoint = np.array([0.5 if k < 20 else 0.7])
        u = inverse.act(np.array([reading]), setpoint, np.array([minute]), ONE)[0]
        if told:
            u = u * rng.choice([0.0, 0.5, 1.0]) + 0.03 * (k == 25)
            inverse.dosed(np.array([40.0 * u]))
            inverse.dosed(np.array([20.0 * u]))  # in two parts, mL of a period
        step = 1.0 if k % 7 else 2.0  # now and then a reading is missed
        log_x += 0.024 * step - 0.9 * u / model.tau
        dosed += u / model.tau
        minute += step
    a = np.vstack([np.array(rows), [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    b = np.append(values, [model.mu, 1.0])
    w = np.append(weights, [1.0 / config.mu_sd, 1.0 / config.gain_sd])
    x0, mu, gain = np.linalg.lstsq(a * w[:, None], b * w, rcond=None)[0]
    seen = inverse.explain()
    assert seen["mu"][0] == pytest.approx(mu, rel=1e-8)
    assert seen["gain"][0] == pytest.approx(gain, rel=1e-8)
    assert np.log(seen["od_estimate"][0]) == pytest.approx(np.dot([x0, mu, gain], rows[-1]), rel=1e-8)


def steady(inverse: Inverse, minutes: int) -> None:
    for k in range(minutes):
        inverse.act(np.array([0.5]), np.array([0.5]), np.array([float(k)]), ONE)


def test_an_outlier_changes_nothing_and_a_lasting_jump_is_believed() -> None:
    inverse = law()
    inverse.reset(1)
    steady(inverse, 30)
    before = inverse.explain()
    usual = inverse.act(np.array([0.5]), np.array([0.5]), np.array([30.0]), ONE)[0]
    for k in range(5):  # a bubble of five readings
        rate = inverse.act(np.array([0.7]), np.array([0.5]), np.array([31.0 + k]), ONE)[0]
        assert rate == pytest.approx(usual, rel=0.05)
    rate = inverse.act(np.array([0.7]), np.array([0.5]), np.array([36.0]), ONE)[0]
    assert rate == 0.02
    assert inverse.explain()["mu"][0] == pytest.approx(before["mu"][0], rel=0.05)
    assert inverse.explain()["od_estimate"][0] == pytest.approx(0.7)


def test_the_law_inverts_the_model_of_another_period_and_a_stronger_pump() -> None:
    """With the truth known exactly the next OD, 3 min on, is the setpoint, or the pump is at a bound."""
    known = {"mu_sd": 1e-5, "gain_sd": 0.0, "gain_walk": 0.0, "mu_walk": 0.0}
    inverse = law(EnvConfig(mu=0.025, tau=0.3, control_min=3.0, max_pump_rate=0.05), **known)
    inverse.reset(5)
    od, setpoint = np.array([0.42, 0.61, 0.3, 0.9, 0.2]), np.array([0.4, 0.5, 0.31, 0.5, 0.5])
    u = inverse.act(od, setpoint, np.zeros(5), np.ones(5, dtype=bool))
    np.testing.assert_allclose((od * np.exp(3.0 * (0.025 - u / 0.3)))[:3], setpoint[:3], rtol=1e-9)
    assert u[1] > 0.02
    np.testing.assert_array_equal(u[3:], [0.05, 0.0])


@pytest.mark.parametrize(("levels", "rates"), [(2, [0.0, 0.02]), (5, [0.0, 0.005, 0.01, 0.015, 0.02])])
def test_with_levels_it_gives_the_nearest_of_them_from_none_to_all(levels: int, rates: list[float]) -> None:
    """Of a law that knows the truth: u = tau (mu + ln(x / r)), over the range of the pump and beyond."""
    model = EnvConfig(mu=0.03, tau=1.0 / 3.0)
    known = EstimatorConfig(mu_sd=1e-5, gain_sd=0.0, gain_walk=0.0, mu_walk=0.0)
    od = 0.5 * np.exp(np.linspace(-0.05, 0.05, 23))
    stepped = Inverse(InverseConfig(levels=levels, estimator=known), model)
    stepped.reset(od.size)
    given = stepped.act(od, np.full(od.size, 0.5), np.zeros(od.size), np.ones(od.size, dtype=bool))
    exact = np.clip((0.03 + np.log(od / 0.5)) / 3.0, 0.0, 0.02)
    np.testing.assert_allclose(given, np.asarray(rates)[np.abs(exact[:, None] - rates).argmin(axis=1)], atol=1e-9)
    np.testing.assert_allclose(np.unique(given.round(9)), rates)
