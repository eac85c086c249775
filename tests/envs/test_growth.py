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


@pytest.mark.parametrize(
    ("response", "low", "high"),
    [(Arrhenius(56.0), 0.59, 0.62), (Cardinal(), 0.64, 0.67)],
)
def test_thirty_degrees_against_thirty_seven(response, low, high):
    """Ratios of the literature (docs/biology.md, Temperature); the reference temperature changes nothing."""
    rate = 0.03 * relative_to_37(response)(np.array([30.0, 37.0]))
    assert rate[1] == pytest.approx(0.03, rel=1e-12)
    assert low <= rate[0] / rate[1] <= high


def test_cardinal_model_peaks_at_its_optimum_and_is_zero_outside_its_limits():
    model = Cardinal()
    t = np.linspace(7.0, 47.0, 4001)
    assert t[np.argmax(model(t))] == pytest.approx(model.t_opt, abs=0.02)
    assert model(np.array([0.0, 4.0, model.t_opt, 50.0])).tolist() == pytest.approx([0.0, 0.0, 1.0, 0.0], abs=0.0)
