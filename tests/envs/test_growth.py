"""Growth laws, integrators and the chemostat against their formulas."""

import numpy as np
import pytest

from envs.integrators import INTEGRATORS, rk4
from envs.plant.culture import Culture, GrowthConfig
from envs.plant.strains import Strain, cardinal, response


@pytest.mark.parametrize(("name", "order"), [("euler", 1.0), ("rk4", 4.0)])
def test_order_of_convergence_against_the_exact_solution(name, order):
    """x(t) = x0 exp((mu - u/tau) t): the error falls like h^order."""
    rng = np.random.default_rng(0)
    n = 64
    mu, u, x0 = rng.uniform(0.01, 0.04, n), rng.uniform(0.0, 0.02, n), rng.uniform(0.1, 1.0, n)
    exact = x0 * np.exp((mu - 3.0 * u) * 20.0)
    errors = []
    steps = np.array([8, 16, 32, 64])
    for k in steps:
        end = INTEGRATORS[name](lambda x: (mu - 3.0 * u) * x, x0, 20.0, int(k))
        errors.append(np.abs(end - exact).max())
    slope = np.polyfit(np.log(20.0 / steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)


def test_chemostat_reaches_its_steady_state():
    """Monod's chemostat: s* = k_s D / (mu_max - D), x* = yield (1 - s*); mu is that in fresh medium, s = 1."""
    mu_max, k_s, yield_od, dilution = 0.03, 0.1, 3.0, np.array([0.006, 0.015, 0.024])
    strain = Strain(np.full(3, mu_max / (1.0 + k_s)), np.ones_like, 0.0, np.ones(3))
    culture = Culture(GrowthConfig(yield_od=yield_od, k_s=k_s), [strain], rk4)
    culture.reset(0.5, 37.0)
    culture.grow(4000.0, dilution, np.full(3, 37.0), np.zeros(3))
    substrate = k_s * dilution / (mu_max - dilution)
    np.testing.assert_allclose(culture.substrate, substrate, rtol=1e-6)
    np.testing.assert_allclose(culture.od, yield_od * (1.0 - substrate), rtol=1e-6)


@pytest.mark.parametrize(("law", "low", "high"), [("arrhenius", 0.59, 0.62), ("cardinal", 0.64, 0.67)])
def test_thirty_degrees_against_thirty_seven(law, low, high):
    """Ratios of the literature (docs/biology.md, Temperature); the reference temperature changes nothing."""
    rate = 0.03 * response(law, None, 56.0, 0)(np.array([30.0, 37.0]))
    assert rate[1] == pytest.approx(0.03, rel=1e-12)
    assert low <= rate[0] / rate[1] <= high


def test_cardinal_model_peaks_at_its_optimum_and_is_zero_outside_its_limits():
    phi, best = cardinal(), 41.0
    t = np.linspace(7.0, 47.0, 4001)
    assert t[np.argmax(phi(t))] == pytest.approx(best, abs=0.02)
    assert phi(np.array([0.0, 4.0, best, 50.0])).tolist() == pytest.approx([0.0, 0.0, 1.0, 0.0], abs=0.0)
