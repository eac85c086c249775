"""The PI laws against their difference equations, computed by hand."""

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.task import EnvConfig
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig, TunedPI, TunedPIConfig

pytestmark = pytest.mark.numeric

Array = NDArray[np.float64]


def play(
    controller: ChiBioPI | TunedPI, ods: list[float], setpoint: float, minutes: list[float] | None = None
) -> Array:
    """Pump rates for a sequence of readings of one reactor."""
    controller.reset(1)
    times = minutes or [float(k) for k in range(len(ods))]
    rates = [
        controller.act(np.array([x]), np.array([setpoint]), np.array([t]), np.array([True]))[0]
        for x, t in zip(ods, times, strict=True)
    ]
    return np.array(rates)


def test_the_devices_law_by_hand() -> None:
    ods = [0.55, 0.56, 0.57, 0.53, 0.505, 0.56, 0.62, 0.63, 0.48]
    by_hand = [
        0.0,  # cycle 1
        0.0,  # cycle 2
        # e .07, |dy| .01: P = .7 ln(1.14)/12 = .0076433, I1 = .007, I2 = .0007
        0.0076433 + 0.007 + 0.0007,
        # e .03, |dy| .04: P = .7 ln(1.06)/12 = .0033990, I1 = .007 + .003, I2 = .0007 + .0003
        0.0033990 + 0.010 + 0.0010,
        # e .005 < .01: I1 = 0; I2 = .0010 + .00005; P = .7 ln(1.01)/12 = .0005804
        0.0005804 + 0.00105,
        0.0,  # rose by .055: noise guard. I2 = .00105 + .0006
        0.0,  # rose by .06: noise guard. |e| = .12 but |dy| > .05, so I2 grows to .00285 and is not cleared
        0.02,  # e .13, |dy| .01: I2 cleared, P = ln(1.26)/12 = .01926 not reduced, I1 = .013: clamped
        0.0,  # e -.02: I1 = 0; |dy| .15: I2 kept; P < 0
    ]
    np.testing.assert_allclose(play(ChiBioPI(ChiBioPIConfig()), ods, 0.5), by_hand, atol=1e-7)


def test_the_devices_integrators_after_that_sequence() -> None:
    pi = ChiBioPI(ChiBioPIConfig())
    play(pi, [0.55, 0.56, 0.57, 0.53], 0.5)
    parts = pi.explain()
    assert parts["i1"][0] == pytest.approx(0.010)
    assert parts["i2"][0] == pytest.approx(0.0010)
    play(pi, [0.55, 0.56, 0.57, 0.53, 0.505, 0.56, 0.62], 0.5)
    assert pi.explain()["i2"][0] == pytest.approx(0.00285)


def test_a_dead_zone_keeps_the_gasket_integrator() -> None:
    """Between 0.01 and 0.025 the first integrator neither grows nor is cleared."""
    pi = ChiBioPI(ChiBioPIConfig())
    play(pi, [0.55, 0.55, 0.55, 0.52], 0.5)
    assert pi.explain()["i1"][0] == pytest.approx(0.005)


def test_the_interval_is_that_of_the_last_two_records() -> None:
    """The decision of a cycle is made before the cycle is recorded, so a long gap shows one cycle later."""
    pi = ChiBioPI(ChiBioPIConfig())
    play(pi, [0.52, 0.52, 0.52, 0.52], 0.5, [0.0, 1.0, 3.0, 4.0])
    assert pi.explain()["p"][0] == pytest.approx(0.7 * np.log(1.04) / 2.0 / 12.0)
    play(pi, [0.52, 0.52, 0.52], 0.5, [0.0, 1.0, 3.0])
    assert pi.explain()["p"][0] == pytest.approx(0.7 * np.log(1.04) / 12.0)


def test_gain_scales_with_volume_and_odd_readings_do_not_pump() -> None:
    pi = ChiBioPI(ChiBioPIConfig(), 10.0)
    play(pi, [0.52, 0.52, 0.52], 0.5)
    assert pi.explain()["p"][0] == pytest.approx(0.7 * np.log(1.04) / 24.0)
    assert play(pi, [0.0, 0.0, 0.0, -0.1], 0.5)[-1] == 0.0
    assert play(pi, [0.5, 0.5, 0.5], 0.0)[-1] == 0.02  # setpoint 0: the device pumps at its clamp


def test_tuned_pi_by_hand() -> None:
    """tau (K z + I) with K = 1/2, integral gain 1/16 and I starting at mu."""
    model = EnvConfig(mu=0.03, tau=1.0 / 3.0)
    z1, z2 = np.log(0.51 / 0.5), np.log(0.505 / 0.5)
    expected = [(0.03 + z1 / 2) / 3, (0.03 + z1 / 16 + z2 / 2) / 3]
    np.testing.assert_allclose(play(TunedPI(TunedPIConfig(), model), [0.51, 0.505], 0.5), expected)


def test_the_devices_clamp_is_the_one_it_is_told() -> None:
    assert play(ChiBioPI(ChiBioPIConfig(max_pump_rate=0.007)), [0.9, 0.9, 0.9], 0.5)[-1] == 0.007


def test_tuned_pi_with_other_times_and_a_stronger_pump_by_hand() -> None:
    """K = 1 / (2 + 3), and of I a part K h / (4 (2 + 3)) = 0.02 of z a period of 2 min; I begins at 0."""
    model = EnvConfig(mu=0.03, tau=0.4, control_min=2.0, max_pump_rate=0.05)
    config = TunedPIConfig(delay_min=2.0, closed_loop_min=3.0, feed_forward=False)
    z1, z2, z3 = np.log(0.6 / 0.5), np.log(0.57 / 0.5), np.log(0.9 / 0.5)
    expected = [0.4 * z1 / 5.0, 0.4 * (z2 / 5.0 + 0.02 * z1), 0.4 * (z3 / 5.0 + 0.02 * (z1 + z2))]
    assert 0.04 < expected[2] < 0.05
    pi = TunedPI(config, model)
    np.testing.assert_allclose(play(pi, [0.6, 0.57, 0.9], 0.5), expected)
    assert pi.explain()["p"][0] == pytest.approx(z3 / 5.0)


def test_tuned_pi_does_not_wind_up_at_full_pump_and_comes_back_from_it_by_itself() -> None:
    """K z alone asks for more than the pump gives; below the setpoint, still at full rate, I may fall again."""
    pi = TunedPI(TunedPIConfig(), EnvConfig())
    play(pi, [0.9, 0.85, 0.8], 0.5)
    assert pi.explain()["i"][0] == 0.03
    pi._integral[:] = 0.5
    assert pi.act(np.array([0.49]), np.array([0.5]), np.array([3.0]), np.array([True]))[0] == 0.02
    assert pi.explain()["i"][0] == pytest.approx(0.5 + np.log(0.98) / 16.0)


def test_tuned_pi_does_not_wind_up() -> None:
    """Climbing from 0.4 to 0.8 keeps the pump at 0 for 20 min; the integrator stands still meanwhile."""
    model = EnvConfig()
    pi = TunedPI(TunedPIConfig(), model)
    pi.reset(1)
    x, highest = 0.4, 0.0
    for k in range(60):
        u = pi.act(np.array([x]), np.array([0.8]), np.array([float(k)]), np.array([True]))[0]
        if u == 0.0:
            assert pi.explain()["i"][0] == model.mu
        x *= np.exp(model.mu - u / model.tau)
        highest = max(highest, x)
    assert highest < 0.8 * 1.01
    assert x == pytest.approx(0.8, abs=1e-3)
