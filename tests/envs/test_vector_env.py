"""The native vector environment against Gymnasium's own machinery and against a plain loop."""

import re
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs  # registers the environment
from envs.gym_adapter import REGISTERED
from envs.optimum import solve_episode, solve_relative
from envs.relative import RelativeConfig
from envs.task import EnvConfig, step_factors
from envs.vector_env import BioreactorVectorEnv

ID = "Bioreactor-v0"
LENGTHS = {ID: 100, "BioreactorPreview-v0": 12, "Coculture-v0": 72, "CoculturePreview-v0": 24, "Relative-v0": 20}
assert envs.__doc__


@pytest.mark.filterwarnings("ignore:.*Box observation space m")  # a relative error has no bound
@pytest.mark.parametrize("name", sorted(REGISTERED))
def test_a_task_is_what_gymnasium_asks_and_continues_from_its_state(name):
    """Also from the step that ended an episode, whose last observation is told beside the first one of the next."""
    check_env(gymnasium.make(name).unwrapped, skip_render_check=True)
    assert gymnasium.make(name).spec.max_episode_steps == LENGTHS[name]
    many, other = (gymnasium.make_vec(name, num_envs=3, episode_steps=4).unwrapped for _ in range(2))
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert many.reset(seed=4)[0] in many.observation_space
    for k in range(4):
        observation, _, terminated, truncated, infos = many.step(np.full(3, 5 * k))
        assert not terminated.any()
        assert truncated.all() == (k == 3)
    assert (observation != infos["final_obs"]).any(axis=1).all()
    other.reset(seed=9)
    np.testing.assert_array_equal(other.load_state_dict(many.state_dict()), observation)
    for k, action in enumerate((0, 16, 5, 5, 8, 1, 2, 3, 4)):
        if k == 2:  # and from within an episode
            other.reset(seed=9)
            other.load_state_dict(many.state_dict())
        np.testing.assert_array_equal(many.step(np.full(3, action))[0], other.step(np.full(3, action))[0])


@pytest.mark.parametrize(
    ("task", "grid", "solve"),
    [
        (ID, EnvConfig.pump_rates, solve_episode),
        ("Relative-v0", RelativeConfig.levels, lambda config, share: solve_relative(config, share, 20)),
    ],
)
def test_the_optimums_actions_in_info_cost_what_the_optimum_costs(task, grid, solve):
    env = gymnasium.make(task, optimum=True, episode_steps=20)
    _, info = env.reset(seed=3)
    first, held, *_ = info.values()
    best, total, over = solve(env.unwrapped.config, held), 0.0, False
    states, _ = best.rollout(np.array([first]))
    while not over:
        assert info["optimal_rate"] == grid(env.unwrapped.config)[info["optimal_action"]]
        _, reward, _, over, info = env.step(info["optimal_action"])
        total += reward
    assert total == pytest.approx(-np.sum((states[:, 0] - best.target) ** 2))


def pair(n, mode, **overrides):
    """The native environment and Gymnasium's loop over single ones, of the same autoreset mode."""
    native = gymnasium.make_vec(ID, num_envs=n, autoreset_mode=mode, **overrides)
    sync = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    return native, gymnasium.make_vec(ID, num_envs=n, **sync, **overrides)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.parametrize("overrides", [{}, {"episode_steps": 7, "final_reward_weight": 3.0, "mu": 0.02}])
def test_native_equals_gymnasiums_sync_step_for_step(overrides, mode):
    """Rewards, ends and observations of 250 steps, with some copies restarted out of turn on the way."""
    n, steps = 5, 250
    native, sync = pair(n, mode, **overrides)
    assert native.metadata["autoreset_mode"] is sync.metadata["autoreset_mode"] is mode
    np.testing.assert_array_equal(native.reset(seed=11)[0], sync.reset(seed=11)[0])
    rng = np.random.default_rng(0)
    ends = 0
    for k in range(steps):
        if k in (3, 7, 14, 100, 101):
            mask = rng.random(n) < 0.5
            mask[k % n] = True
            a, b = (env.reset(options={"reset_mask": mask.copy()})[0] for env in (native, sync))
            np.testing.assert_array_equal(a, b)
        action = rng.integers(0, 17, n)
        *ours, ia = native.step(action)
        *theirs, ib = sync.step(action)
        for one, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(one, other)
        truncated = ours[3]
        ends += int(truncated.sum())
        assert ("final_obs" in ia) == ("final_obs" in ib) == (mode is AutoresetMode.SAME_STEP and truncated.any())
        if "final_obs" in ia:
            np.testing.assert_array_equal(ia["_final_obs"], ib["_final_obs"])
            for i in np.flatnonzero(truncated):
                np.testing.assert_array_equal(ia["final_obs"][i], ib["final_obs"][i])
    assert ends >= n


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_a_saved_state_remembers_which_copies_wait_for_their_next_episode(mode):
    env, other = (BioreactorVectorEnv(2, autoreset_mode=mode, episode_steps=5) for _ in range(2))
    env.reset(seed=0)
    other.reset(seed=9)
    for _ in range(5):
        env.step(np.zeros(2, dtype=int))
    other.load_state_dict(env.state_dict())
    for _ in range(7):
        for one, same in zip(env.step(np.ones(2, dtype=int))[:4], other.step(np.ones(2, dtype=int))[:4], strict=True):
            np.testing.assert_array_equal(one, same)


@pytest.mark.parametrize("mode", [AutoresetMode.DISABLED, "never"])
def test_other_modes_are_refused(mode):
    with pytest.raises(ValueError, match=r"autoreset_mode = .*: allowed AutoresetMode.NEXT_STEP, AutoresetMode.SAME"):
        BioreactorVectorEnv(2, autoreset_mode=mode)


@pytest.mark.parametrize(("arguments", "steps"), [({}, 100), ({"episode_steps": 7}, 7), ({"episode_steps": 130}, 130)])
def test_a_made_environment_says_and_keeps_its_length(arguments, steps):
    """One episode ends after `steps`, once, and the next one after as many."""
    env = gymnasium.make(ID, render_mode=None, **arguments)
    assert env.spec.max_episode_steps == steps
    many = gymnasium.make_vec(ID, num_envs=2, render_mode=None, **arguments)
    assert many.spec.max_episode_steps == steps
    many.reset(seed=0)
    assert [bool(many.step(np.zeros(2, dtype=int))[3].any()) for _ in range(2 * steps)] == 2 * [
        *[False] * (steps - 1),
        True,
    ]
    for seed in (0, None):
        env.reset(seed=seed)
        assert [env.step(0)[3] for _ in range(steps)] == [False] * (steps - 1) + [True]


def test_gymnasiums_own_time_limit_shortens_episodes():
    env = gymnasium.make(ID, max_episode_steps=4)
    many = gymnasium.make_vec(ID, num_envs=2, max_episode_steps=4)
    assert BioreactorVectorEnv(2, episode_steps=7, max_episode_steps=30).config.episode_steps == 7
    assert env.spec.max_episode_steps == many.spec.max_episode_steps == 4
    many.reset(seed=0)
    for _ in range(2):
        env.reset()
        assert [env.step(0)[3] for _ in range(4)] == [False, False, False, True]
        assert [many.step(np.zeros(2, dtype=int))[3].all() for _ in range(4)] == [False, False, False, True]


@pytest.mark.filterwarnings("ignore:.*render_mode")  # Gymnasium's own
@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_way_to_draw_is_refused_and_who_asks_for_a_picture_told_that_there_is_none(make):
    with pytest.raises(TypeError, match="render_mode = human: allowed None"):
        make(ID, render_mode="human")
    env = make(ID)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="this environment has nothing to draw"):
        assert env.render() is None


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("Relative-v0", {"nokey": 3}, "nokey: no such key; allowed here: kind, n_actions, episode_steps, growth_sha"),
        ("Relative-v0", {"mu": 0.02, "n_actions": 5}, "mu: no such key; allowed here: kind, n_actions"),
        ("Bioreactor-v0", {"episode_step": 5}, "episode_step: no such key; did you mean episode_steps?; allowed here"),
        ("Coculture-v0", {"nokey": 3}, "nokey: no such key; allowed here: "),
    ],
)
def test_a_value_that_a_task_does_not_have_is_named_beside_those_it_has(make, name, given, said):
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        make(f"envs:{name}", **given)


def test_the_last_reward_of_an_episode_is_weighted_and_no_other():
    env = BioreactorVectorEnv(2, EnvConfig(episode_steps=3, final_reward_weight=4.0))
    env.reset(seed=0)
    for weight in (1.0, 1.0, 4.0, 1.0, 1.0, 4.0):
        od, setpoint = env.od.copy() * step_factors(env.config)[3], env.setpoint.copy()
        reward = env.step(np.array([3, 3]))[1]
        np.testing.assert_allclose(reward, -weight * (od - setpoint) ** 2, rtol=1e-12)


def test_copies_may_have_seeds_of_their_own():
    """The third with none has a start that differs from time to time."""
    many, one = BioreactorVectorEnv(3), BioreactorVectorEnv(1)
    start = many.reset(seed=[7, 3, None])[0]
    np.testing.assert_array_equal(start[0], one.reset(seed=7)[0][0])
    np.testing.assert_array_equal(start[1], one.reset(seed=3)[0][0])
    assert many.reset(seed=[7, 3, None])[0][2, 0] != start[2, 0]


def test_a_hundred_episodes_begin_each_in_its_own_way_and_continue_from_any_of_them():
    """Copies that are at different episodes, before and behind the end of a block of starts."""
    env, other = BioreactorVectorEnv(2, episode_steps=1), BioreactorVectorEnv(2, episode_steps=1)
    starts = [env.reset(seed=4)[0][:, 0]]
    for _ in range(20):
        env.reset(options={"reset_mask": np.array([True, False])})
    for _ in range(50):
        starts.append(env.step(np.zeros(2, dtype=int))[0][:, 0])
    other.reset(seed=9)
    other.load_state_dict(env.state_dict())
    for _ in range(50):
        starts.append(env.step(np.zeros(2, dtype=int))[0][:, 0])
        np.testing.assert_array_equal(other.step(np.zeros(2, dtype=int))[0][:, 0], starts[-1])
    assert len(np.unique(starts)) == 202


def test_starts_cover_their_ranges_evenly():
    env = BioreactorVectorEnv(4000)
    env.reset(seed=1)
    counts = np.array([(np.abs(env.setpoint - s) < 1e-9).sum() for s in env.config.setpoints])
    assert counts.sum() == 4000
    chi2 = ((counts - 4000 / 9) ** 2 / (4000 / 9)).sum()
    assert chi2 < 26.1  # 99.9 % quantile, 8 degrees of freedom
    assert abs(env.od.mean() - 0.6) < 0.02
    assert abs(np.corrcoef(env.od, env.setpoint)[0, 1]) < 0.06  # every OD with every setpoint
    before = env.od.copy()
    env.reset()  # without a seed it goes on with other starts
    assert (env.od != before).mean() > 0.9


def test_step_before_reset_is_refused():
    with pytest.raises(RuntimeError, match="reset"):
        BioreactorVectorEnv(1).step(np.zeros(1, dtype=int))


@pytest.mark.parametrize("action", [3, np.int64(3), np.uint8(3), np.array(3)])
def test_one_action_may_be_any_integer_scalar(action):
    one, other = (gymnasium.make(ID).unwrapped for _ in range(2))
    for env in (one, other):
        env.reset(seed=0)
    np.testing.assert_array_equal(one.step(action)[0], other.step(3)[0])


@pytest.mark.parametrize("action", [17, -1, 2.0, True, None, "3", [3], np.array([3]), np.array([[3]])], ids=repr)
def test_any_other_action_is_refused_and_changes_nothing(action):
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action .*: allowed integers from 0 to 16 \(.*\) of shape \(\)"):
        env.step(action)
    assert env._batch._steps[0] == 0


@pytest.mark.parametrize(
    "actions",
    [[0, 1, 17], [0, -1, 2], [0.0, 1.0, 2.0], [True, False, True], [1, 2], 1, [[0], [1], [2]], [[0, 1, 2]]],
    ids=repr,
)
def test_actions_of_many_copies_are_refused_together(actions):
    env = BioreactorVectorEnv(3)
    env.reset(seed=0)
    before = env.od.copy()
    with pytest.raises(ValueError, match=r"action .* of shape .*: allowed integers from 0 to 16 .* of shape \(3,\)"):
        env.step(np.array(actions))
    np.testing.assert_array_equal(env.od, before)


def test_an_episode_begins_where_it_is_told_and_says_where_it_is():
    """Of three copies two are restarted: one start for each, one setpoint for both; the third goes on."""
    many = gymnasium.make_vec(ID, num_envs=3)
    first = many.reset(seed=4)[0]
    mask = np.array([True, False, True])
    begun = many.reset(options={"reset_mask": mask, "od": np.array([0.3, 0.4, 0.7]), "setpoint": 0.45})[0]
    np.testing.assert_array_equal(begun, np.float32([[0.3, 0.45], first[1], [0.7, 0.45]]))
    one = gymnasium.make("envs:" + ID, mu=0.02, episode_steps=2)
    _, info = one.reset(seed=1, options={"od": 0.3, "setpoint": 0.5})
    assert info == {"od": 0.3, "setpoint": 0.5}
    for k, ended in ((1, False), (2, True)):  # with the pump off the culture grows by 2 % a minute
        observation, reward, _, truncated, info = one.step(0)
        assert info["od"] == pytest.approx(0.3 * np.exp(0.02 * k), rel=1e-4)
        assert reward == pytest.approx(-((info["od"] - 0.5) ** 2), rel=1e-6)
        np.testing.assert_allclose(observation, list(info.values()), rtol=1e-6)
        assert truncated is ended
    assert one.reset()[1]["od"] != 0.3  # told once, not for good
    for _ in range(2):
        one.step(0)
    assert one.reset(options={"od": 0.35, "setpoint": 0.6})[1] == {
        "od": 0.35,
        "setpoint": 0.6,
    }  # of a later episode, too


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start_od": 0.3}, "reset option = start_od: allowed reset_mask, od, setpoint"),
        ({"od": -0.1}, "od = -0.1: allowed 0 to 1000, one number or 2"),
        ({"setpoint": [0.5, 3.0]}, r"setpoint = \[0.5, 3.0\]: allowed 0 to 2"),
        ({"od": [0.5, 0.5, 0.5]}, "one number or 2"),
        ({"od": float("nan")}, "od = nan"),
        ({"reset_mask": np.ones(3, dtype=bool)}, "reset_mask has shape"),
    ],
)
def test_a_start_that_there_is_not_is_refused_and_changes_nothing(options, words):
    env = gymnasium.make_vec(ID, num_envs=2)
    before, _ = env.reset(seed=3)
    with pytest.raises(ValueError, match=words):
        env.reset(options=options)
    np.testing.assert_array_equal(env.unwrapped.state.astype(np.float32), before)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(REGISTERED))
def test_stable_baselines_opens_every_task_by_its_name(name):
    """It asks for a way to draw first, and does without one only after a TypeError."""
    env_util = pytest.importorskip("stable_baselines3.common.env_util", reason="needs the extra [bench]")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*render_mode")
        env = env_util.make_vec_env(f"envs:{name}", 2, seed=1)
    assert env.reset().shape == (2, *env.observation_space.shape)
    *_, infos = env.step(np.array([0, 1]))
    assert len(infos) == 2
    assert set(infos[0]) > {"TimeLimit.truncated"}
