"""The second simulator does what its formulas say."""

from dataclasses import replace

import numpy as np
import pytest

from tests.studies.second_simulator import LAWS, Conditions, simulate

pytestmark = pytest.mark.slow  # of a yardstick, which no change of the program reaches
QUIET = Conditions(hours=2, wander=0, dose_spread=0, noise=0)
NEVER, ALWAYS = 1e9, 1e-9  # setpoints at which a threshold never or always pumps


def test_constant_rates_give_an_exponential() -> None:
    for setpoint, net in ((NEVER, 0.03), (ALWAYS, 0.03 - 0.02 * 3)):
        made = simulate(replace(QUIET, law="threshold", setpoint=setpoint), 2, 0)
        np.testing.assert_allclose(made.od[0], 0.5 * np.exp(net * made.time), rtol=1e-11)
        np.testing.assert_allclose(made.growth, 0.03, rtol=1e-12)


def test_wander_has_its_sd_and_memory() -> None:
    sd, memory = 0.1, 30.0
    made = simulate(replace(QUIET, hours=12, law="threshold", wander=sd, wander_min=memory), 200, 1)
    rows = np.diff(np.log(made.od)) + made.pump_rate[:, :-1] / made.tau[:, None]  # m averaged over each minute
    np.testing.assert_allclose(rows.mean(axis=1), made.growth, rtol=1e-9)
    wander, a = rows / 0.03 - 1, 1 / memory
    variance = 2 * sd**2 * (a - 1 + np.exp(-a)) / a**2
    assert np.mean(wander**2) == pytest.approx(variance, rel=0.1)
    for lag in (10, 30, 60):
        correlation = np.mean(wander[:, lag:] * wander[:, :-lag]) / np.mean(wander**2)
        assert correlation == pytest.approx(np.exp(-lag / memory), abs=0.05)


def test_doses_spread_readings_are_noisy_and_a_share_of_a_dose_is_late() -> None:
    made = simulate(replace(QUIET, law="threshold", dose_spread=0.2, hours=6), 50, 2)
    on = made.pump_rate[:, :-1] > 0
    factor = (0.03 - np.diff(np.log(made.od))[on]) / (0.02 * 3)
    assert (factor.mean(), factor.std()) == (pytest.approx(1, abs=0.01), pytest.approx(0.2, rel=0.05))
    still = replace(QUIET, law="threshold", mu=0, setpoint=NEVER, hours=12)
    ratio = simulate(replace(still, noise=0.01, noise_correlation=0.4), 50, 3).od / 0.5 - 1
    assert ratio.std() == pytest.approx(0.01, rel=0.03)
    assert np.mean(ratio[:, 1:] * ratio[:, :-1]) / ratio.var() == pytest.approx(0.4, abs=0.03)
    late = simulate(replace(QUIET, law="threshold", mu=0, setpoint=0.49, hours=0.1, late_share=0.25), 1, 0)
    np.testing.assert_allclose(late.od[0, :3], 0.5 * np.exp([0, -0.045, -0.06]), rtol=1e-12)


@pytest.mark.parametrize("law", ["pi", "tuned_pi", "threshold", "proportional"])
def test_laws_hold_the_setpoint_at_the_balance(law: str) -> None:
    made = simulate(Conditions(law=law, hours=12), 30, 4)
    held = made.od[:, 240:]
    assert held.mean() == pytest.approx(0.5, rel=0.03)
    assert held.std() < 0.05
    assert made.pump_rate[:, 240:].mean() == pytest.approx(0.03 / 3, rel=0.03)
    assert made.growth.mean() == pytest.approx(0.03, abs=3 * 0.03 * 0.05 * np.sqrt(2 * 30 / 720 / 30))


def test_device_pi_is_the_documented_one() -> None:
    made = simulate(replace(QUIET, start=0.55, hours=0.1), 1, 0)
    y, u = made.od[0], made.pump_rate[0]
    assert u[:2].tolist() == [0, 0]  # cycles 1 and 2
    seal = slow = 0.0
    for row in (2, 3, 4):  # all within .1 of the setpoint or beyond it with a still culture
        error = y[row] - 0.5
        seal = 0.0 if error < 0.01 else seal + (0.1 * error if error > 0.025 else 0)
        far = abs(error) > 0.1
        slow = 0.0 if far else slow + 0.01 * error
        push = np.log(y[row] / 0.5) / 12 * (1 if far else 0.7)
        assert u[row] == pytest.approx(min(push + seal + slow, 0.02), abs=1e-12)
    stepped = simulate(replace(QUIET, law="setpoint_steps", hours=9), 1, 0)
    np.testing.assert_allclose(stepped.od[0, [179, 359, 539]], [0.8, 0.65, 0.5], rtol=0.01)


@pytest.mark.parametrize("law", sorted(LAWS))
def test_every_law_is_bounded_and_repeats(law: str) -> None:
    conditions = Conditions(law=law, hours=10)
    made, again = simulate(conditions, 5, 6), simulate(conditions, 5, 6)
    np.testing.assert_array_equal(made.od, again.od)
    assert made.od.shape == made.pump_rate.shape == (5, 601)
    assert made.pump_rate.min() >= 0
    assert made.pump_rate.max() <= 0.02
    assert 0.08 * 0.4 < made.od.min() <= made.od.max() < 1.2 * np.exp(0.4)  # a random walk beyond the bounds comes back
