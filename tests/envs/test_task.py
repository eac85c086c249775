"""The task's numbers: step factors, action grid, range checks."""

import numpy as np
import pytest

from envs.bench import Bench
from envs.task import EnvConfig, step_factors


def test_action_grid_is_the_papers():
    rates = EnvConfig().pump_rates()
    assert rates.size == 17
    assert rates[0] == 0.0
    assert rates[-1] == 0.02
    np.testing.assert_allclose(np.diff(rates), 0.00125)
    with pytest.raises(ValueError, match="n_actions"):
        EnvConfig(n_actions=1)  # which could not stop


@pytest.mark.parametrize(("period_s", "stale_s"), [(30.0, 70.0), (60.0, 100.0), (120.0, 160.0), (600.0, 660.0)])
def test_a_sample_is_no_basis_for_a_dose_when_the_next_one_is_late_by_40_s_or_a_tenth(period_s, stale_s):
    bench = Bench(period_s=period_s)
    assert (bench.stale_s, bench.control_min) == (pytest.approx(stale_s), period_s / 60.0)


def test_each_reactor_has_its_own_volume_or_that_of_all():
    bench = Bench(volume_ml=18.0, volumes_ml={"M1": 14.0})
    assert bench.volumes(["M0", "M1", "M2"]).tolist() == [18.0, 14.0, 18.0]
    assert bench.tau == pytest.approx(0.3)


@pytest.mark.parametrize(("ml", "fits"), [(4.9, False), (5.0, True), (38.0, True), (38.1, False)])
def test_a_reactor_s_own_volume_is_within_what_a_vial_may_hold(ml, fits):
    if fits:
        assert Bench(volumes_ml={"M0": 20.0, "M5": ml}).volume_of("M5") == ml
    else:
        with pytest.raises(ValueError, match=rf"bench.volumes_ml.M5 = {ml} mL: allowed 5 to 38"):
            Bench(volumes_ml={"M0": 20.0, "M5": ml})


def test_a_factor_is_that_of_the_whole_control_period_and_of_the_rates_that_are_given():
    config = EnvConfig(mu=0.02, tau=0.4, control_min=5.0, substeps=4)
    rates = np.array([[0.001, 0.013]])
    np.testing.assert_allclose(step_factors(config, rates), (1.0 + 1.25 * (0.02 - rates / 0.4)) ** 4)
