"""The task's numbers: step factors, action grid, range checks; a change of the setpoint that is known ahead."""

import gymnasium
import numpy as np
import pytest

from envs.bench import Bench
from envs.preview import half_way
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


def test_an_episode_is_judged_by_the_setpoint_in_force_and_the_change_comes_when_it_was_announced() -> None:
    """Against an account of its own, over several episodes of which each begins with another announcement."""
    many = gymnasium.make_vec("envs:BioreactorPreview-v0", num_envs=40, episode_steps=8)
    rng, (seen, _) = np.random.default_rng(0), many.reset(seed=3)
    now, following, left = seen[:, 1:].T.astype(float)
    assert set(left) <= set(5.0 * np.arange(1, 7))
    assert len(set(left)) == 6
    assert (now != following).any()
    for step in range(1, 33):
        seen, reward, _, truncated, infos = many.step(rng.integers(0, 17, 40))
        last = infos["final_obs"] if truncated.all() else seen
        np.testing.assert_allclose(reward, -((last[:, 0] - now) ** 2), rtol=1e-4, atol=1e-9)
        left = np.maximum(left - 5.0, 0.0)
        now = np.where(left == 0.0, following, now)
        np.testing.assert_allclose(last[:, 1:], np.stack([now, following, left], axis=1), rtol=1e-6)
        assert truncated.all() == (step % 8 == 0)
        if truncated.all():
            now, following, left = seen[:, 1:].T.astype(float)


@pytest.mark.parametrize(("now", "following"), [(0.5, 0.8), (0.9, 0.3), (0.2, 1.0)])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_begun_earlier_or_later_the_best_way_costs_more(now: float, following: float, share: float) -> None:
    """On a fine grid of time; it moves as fast as growth (share of .06 a period) or full pump can."""
    left, earlier = np.arange(150.0, -150.0, -0.02), np.arange(-5.0, 5.1, 0.25)
    od = half_way(np.array(now), np.array(following), left - earlier[:, None], 0.06, share)
    cost = np.square(od - np.where(left > 0.0, now, following)).sum(axis=1)
    assert earlier[cost.argmin()] == 0.0
    moves = np.diff(np.log(od[0])) / 0.02
    fastest = 0.06 * (share if following > now else share - 1.0)
    assert np.abs(moves)[np.abs(moves) > 1e-9][1:-1] == pytest.approx(abs(fastest))
    assert (od[0, 0], od[0, -1]) == (now, following)
