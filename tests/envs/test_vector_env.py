"""The native vector environment against Gymnasium's own machinery and against a plain loop."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs  # registers the environment
from envs.task import EnvConfig, step_factors
from envs.vector_env import BioreactorVectorEnv

ID = "Bioreactor-v0"
assert envs.__doc__


def test_gymnasium_checks_the_single_environment():
    check_env(gymnasium.make(ID).unwrapped)


def test_stable_baselines_checks_the_single_environment():
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra [bench]")
    checker.check_env(gymnasium.make(ID).unwrapped, warn=True)


def test_make_vec_gives_the_native_environment():
    env = gymnasium.make_vec(ID, num_envs=3)
    assert isinstance(env.unwrapped, BioreactorVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("overrides", [{}, {"episode_steps": 7, "final_reward_weight": 3.0, "mu": 0.02}])
def test_native_equals_gymnasiums_sync_step_for_step(overrides):
    n, steps = 5, 250
    native = gymnasium.make_vec(ID, num_envs=n, **overrides)
    sync = gymnasium.make_vec(
        ID,
        num_envs=n,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        **overrides,
    )
    a, _ = native.reset(seed=11)
    b, _ = sync.reset(seed=11)
    np.testing.assert_array_equal(a, b)
    rng = np.random.default_rng(0)
    ends = 0
    for _ in range(steps):
        action = rng.integers(0, 17, n)
        oa, ra, ta, ua, ia = native.step(action)
        ob, rb, tb, ub, ib = sync.step(action)
        np.testing.assert_array_equal(oa, ob)
        np.testing.assert_array_equal(ra, rb)
        np.testing.assert_array_equal(ta, tb)
        np.testing.assert_array_equal(ua, ub)
        if ua.any():
            ends += int(ua.sum())
            np.testing.assert_array_equal(ia["_final_obs"], ib["_final_obs"])
            for i in np.flatnonzero(ua):
                np.testing.assert_array_equal(ia["final_obs"][i], ib["final_obs"][i])
    assert ends >= n


def test_the_last_reward_of_an_episode_is_weighted_and_no_other():
    env = BioreactorVectorEnv(2, EnvConfig(episode_steps=3, final_reward_weight=4.0))
    env.reset(seed=0)
    for weight in (1.0, 1.0, 4.0, 1.0, 1.0, 4.0):
        od, setpoint = env.od.copy() * step_factors(env.config)[3], env.setpoint.copy()
        reward = env.step(np.array([3, 3]))[1]
        np.testing.assert_allclose(reward, -weight * (od - setpoint) ** 2, rtol=1e-12)


def test_copies_follow_the_model_and_the_reward():
    config = EnvConfig()
    env = BioreactorVectorEnv(64, config)
    observation, _ = env.reset(seed=0)
    od, setpoint = env.od.copy(), env.setpoint.copy()
    assert np.all((od >= 0.1) & (od <= 1.1))
    assert set(np.round(setpoint, 3)) <= set(config.setpoints)
    action = np.arange(64) % 17
    observation, reward, terminated, truncated, _ = env.step(action)
    expected = od * step_factors(config)[action]
    np.testing.assert_allclose(env.od, expected, rtol=1e-15)
    np.testing.assert_allclose(reward, -((expected - setpoint) ** 2))
    np.testing.assert_allclose(observation[:, 0], expected, rtol=1e-6)
    assert not terminated.any()
    assert not truncated.any()


def test_copy_i_is_the_same_whatever_the_number_of_copies():
    many, one = BioreactorVectorEnv(8), BioreactorVectorEnv(1)
    many.reset(seed=5)
    one.reset(seed=5 + 3)
    for _ in range(350):
        many.step(np.full(8, 4))
        one.step(np.full(1, 4))
        assert many.od[3] == one.od[0]
        assert many.setpoint[3] == one.setpoint[0]


def test_two_seeds_differ_and_one_seed_repeats():
    first, second, third = (BioreactorVectorEnv(4) for _ in range(3))
    a, _ = first.reset(seed=0)
    b, _ = second.reset(seed=0)
    c, _ = third.reset(seed=100)
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    d, _ = first.reset()
    assert not np.array_equal(a, d)


def test_starts_cover_their_ranges_evenly():
    env = BioreactorVectorEnv(4000)
    env.reset(seed=1)
    counts = np.array([(np.abs(env.setpoint - s) < 1e-9).sum() for s in env.config.setpoints])
    assert counts.sum() == 4000
    chi2 = ((counts - 4000 / 9) ** 2 / (4000 / 9)).sum()
    assert chi2 < 26.1  # 99.9 % quantile, 8 degrees of freedom
    assert abs(env.od.mean() - 0.6) < 0.02


def test_state_continues_to_the_bit():
    env = BioreactorVectorEnv(3)
    env.reset(seed=2)
    actions = np.random.default_rng(0).integers(0, 17, (400, 3))
    for action in actions[:130]:
        env.step(action)
    state = env.state_dict()
    expected = [env.step(a)[0] for a in actions[130:]]
    other = BioreactorVectorEnv(3)
    other.seed_streams([0, 1, 2])
    other.load_state_dict(state)
    for action, observation in zip(actions[130:], expected, strict=True):
        np.testing.assert_array_equal(other.step(action)[0], observation)


def test_partial_reset_touches_only_the_masked_copies():
    env = BioreactorVectorEnv(4)
    env.reset(seed=0)
    env.step(np.zeros(4, dtype=int))
    before = env.od.copy()
    env.reset(options={"reset_mask": np.array([True, False, False, True])})
    np.testing.assert_array_equal(env.od[1:3], before[1:3])
    assert env.od[0] != before[0]
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.ones(3, dtype=bool)})


def test_step_before_reset_and_bad_actions_are_refused():
    with pytest.raises(RuntimeError, match="reset"):
        BioreactorVectorEnv(1).step(np.zeros(1, dtype=int))
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="allowed 0 to 16"):
        env.step(17)
