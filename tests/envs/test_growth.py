"""Growth laws and mass balances against their formulas and against each other."""

import numpy as np
import pytest

from envs.growth import Arrhenius, Cardinal, DilutedCulture, Exponential, Monod, relative_to_37
from envs.integrators import INTEGRATORS, rk4


@pytest.mark.parametrize(("name", "order"), [("euler", 1.0), ("rk4", 4.0)])
def test_order_of_convergence_against_the_exact_solution(name, order):
    """x(t) = x0 exp((mu - u/tau) t): the error falls like h^order."""
    rng = np.random.default_rng(0)
    n = 64
    mu, u, x0 = rng.uniform(0.01, 0.04, n), rng.uniform(0.0, 0.02, n), rng.uniform(0.1, 1.0, n)
    culture = DilutedCulture(Exponential(mu), tau=1.0 / 3.0)
    exact = x0 * np.exp((mu - 3.0 * u) * 20.0)
    start = np.stack([x0, np.ones(n)], axis=1)
    errors = []
    steps = np.array([8, 16, 32, 64])
    for k in steps:
        end = INTEGRATORS[name](lambda y: culture.derivative(y, u), start, 20.0, int(k))
        errors.append(np.abs(end[:, 0] - exact).max())
    slope = np.polyfit(np.log(20.0 / steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)


def test_chemostat_reaches_its_steady_state():
    """Monod's chemostat: s* = k_s D / (mu_max - D), x* = yield (1 - s*)."""
    mu_max, k_s, tau, yield_od = 0.03, 0.1, 1.0 / 3.0, 3.0
    u = np.array([0.002, 0.005, 0.008])
    dilution = u / tau
    culture = DilutedCulture(Monod(mu_max, k_s), tau, yield_od)
    state = np.tile([0.5, 0.8], (3, 1))
    state = rk4(lambda y: culture.derivative(y, u), state, 4000.0, 4000)
    substrate = k_s * dilution / (mu_max - dilution)
    np.testing.assert_allclose(state[:, 1], substrate, rtol=1e-6)
    np.testing.assert_allclose(state[:, 0], yield_od * (1.0 - substrate), rtol=1e-6)


def test_batch_growth_follows_the_logistic_curve_when_substrate_is_everything():
    """With k_s much larger than s the rate is linear in s, and without flow x + Y s is conserved: logistic growth."""
    k_s, yield_od, x0 = 1e6, 2.0, 0.05
    rate = 0.03  # of mu_max / k_s
    culture = DilutedCulture(Monod(rate * k_s, k_s), 1.0, yield_od)
    capacity = x0 + yield_od
    growth = rate * capacity / yield_od
    state = np.array([[x0, 1.0]])
    state = rk4(lambda y: culture.derivative(y, np.zeros(1)), state, 100.0, 1000)
    expected = capacity / (1.0 + (capacity / x0 - 1.0) * np.exp(-growth * 100.0))
    assert state[0, 0] == pytest.approx(expected, rel=1e-5)
    assert state[0, 0] + yield_od * state[0, 1] == pytest.approx(capacity, rel=1e-12)


@pytest.mark.parametrize(
    ("response", "low", "high"),
    [(Arrhenius(56.0), 0.59, 0.62), (Cardinal(), 0.64, 0.67)],
)
def test_thirty_degrees_against_thirty_seven(response, low, high):
    """Ratios of the literature (docs/biology.md, Temperature); the reference temperature changes nothing."""
    rate = 0.03 * relative_to_37(response)(np.array([30.0, 37.0]))
    assert rate[1] == pytest.approx(0.03, rel=1e-12)
    assert low <= rate[0] / rate[1] <= high


def test_no_growth_outside_the_cardinal_temperatures():
    assert np.all(Cardinal()(np.array([0.0, 4.0, 50.0, 80.0])) == 0.0)


def test_cardinal_model_peaks_at_its_optimum():
    model = Cardinal()
    t = np.linspace(7.0, 47.0, 4001)
    assert t[np.argmax(model(t))] == pytest.approx(model.t_opt, abs=0.02)
    assert model(np.array([model.t_opt]))[0] == pytest.approx(1.0)
