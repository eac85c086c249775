"""A change of the setpoint that is known ahead: the environment's program, and when to begin."""

import gymnasium
import numpy as np
import pytest

from envs.preview import half_way


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
