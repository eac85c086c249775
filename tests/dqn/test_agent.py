"""Agents and their training: minibatches, updates, exploration, populations, copies, records."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dqn.agent import DIAGNOSED, DQNAgent
from dqn.config import DQNConfig
from dqn.population import Population
from dqn.replay import Transition
from dqn.trainer import Trainer, TrainRecord
from tests.dqn.problems import IdentityEnv, streams

pytestmark = pytest.mark.numeric

SMALL = DQNConfig(
    hidden=(16, 16),
    gamma=0.5,
    learning_rate=3e-3,
    total_steps=600,
    epsilon_steps=300,
    learn_start=32,
    batch_size=16,
    target_period=25,
    replay_size=500,
)
EVERYTHING: dict[str, Any] = {
    "action_gap": 0.5,
    "huber": 0.5,
    "updates_per_step": 2,
    "hindsight_share": 0.5,
}


class Shifted:
    """A goal replacement of no meaning that uses its random numbers."""

    numbers = 2

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        return uniform

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        batch.r_t.add_(drawn[..., 0])


def _train(trainer: Trainer) -> Trainer:
    list(trainer.run())
    return trainer


def _filled(config: DQNConfig, seeds: range) -> DQNAgent:
    """An agent with 40 transitions in its memory and no update yet."""
    agent, rng = DQNAgent(config, 3, 3, streams(seeds), Shifted()), np.random.default_rng(0)
    for _ in range(40):
        before, after = (rng.random((len(seeds), 3), dtype=np.float32) for _ in range(2))
        agent.replay.add(before, rng.integers(0, 3, len(seeds)), rng.random(len(seeds)), after, rng.random(3) < 0.9)
    return agent


def test_a_minibatch_is_of_the_rows_that_each_agent_s_own_numbers_choose() -> None:
    """A number in [0, 1) is a share of the 40 rows in the memory."""
    agent = _filled(SMALL, range(3))
    rows, chosen = agent.replay.state_dict()["rows"], agent._minibatches(1).s_tm1[:, 0]
    for i in range(3):
        draws = np.random.default_rng(streams(range(i, i + 1))["replay"][0]).random(SMALL.batch_size)
        assert torch.equal(chosen[i], rows[i][(draws * 40).astype(int), :3])


@pytest.mark.parametrize("changes", [{}, EVERYTHING], ids=["plain", "everything"])
@pytest.mark.parametrize("together", [4, 5, 200])
def test_updates_of_one_step_are_those_that_are_made_one_by_one(changes: dict[str, Any], together: int) -> None:
    """200 updates, more than a block of random numbers holds, with copies after every 23: in groups and one by one."""
    config = replace(SMALL, target_period=23, **changes)
    one, many = _filled(config, range(3)), _filled(config, range(3))
    for _ in range(200):
        one.learn()
    for _ in range(200 // together):
        many.learn(together)
    assert one.updates == many.updates == 200
    for name, value in one.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, many.state_dict()[name]), name
    assert one.state_dict()["draws"] == many.state_dict()["draws"]
    assert one.state_dict()["goals"] == many.state_dict()["goals"]


def test_the_target_network_is_asked_once_for_all_updates_between_two_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Period 6, eight updates a step: of the second step four come before the copy after update 12, and four after."""
    agent = _filled(replace(SMALL, target_period=6), range(3))
    forward, asked = agent.target.forward, []

    def counted(features: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        asked.append((agent.updates, tuple(features.shape)))
        return forward(features)

    monkeypatch.setattr(agent.target, "forward", counted)
    for _ in range(2):
        agent.learn(8)
    assert asked == [(0, (3, 96, 3)), (6, (3, 32, 3)), (8, (3, 64, 3)), (12, (3, 64, 3))]


def test_the_target_network_is_copied_when_it_is_due_and_stays_in_between() -> None:
    """Period 4: the target network is that of updates 0, 4, 8, 12 until the next of them."""
    agent = DQNAgent(replace(SMALL, target_period=4), 3, 3, streams(range(2)))
    draws = torch.Generator().manual_seed(0)
    history = [agent.network.flat.clone()]
    for update in range(1, 14):
        observation = torch.rand(2, 8, 3, generator=draws)
        agent.fit(observation, torch.randint(3, (2, 8), generator=draws), torch.rand(2, 8, generator=draws))
        history.append(agent.network.flat.clone())
        assert not torch.equal(history[-1], history[-2])
        assert torch.equal(agent.target.flat, history[[0, 4, 8, 12][update // 4]])


def test_rewards_of_replaced_goals_are_scaled_like_those_of_the_environment() -> None:
    """At gamma 0: Q = 10 * 1 where the environment paid 1, 10 * -2 where half of a minibatch got a goal paying -2."""
    config = replace(SMALL, gamma=0.0, reward_scale=10.0, hindsight_share=0.5, learning_rate=1e-2)

    class Elsewhere(Shifted):
        def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
            batch.s_tm1.copy_(batch.s_tm1.flip(-1))
            batch.r_t.fill_(-2.0)

    agent = DQNAgent(config, 2, 2, streams(range(2)), Elsewhere())
    here, paid = np.tile(np.array([1.0, 0.0], dtype=np.float32), (2, 1)), np.ones(2)
    for k in range(400):
        agent.observe(here, np.full(2, k % 2), paid, here, paid)
    q = agent.network(torch.eye(2).expand(2, 2, 2))
    torch.testing.assert_close(q[:, 0], torch.full((2, 2), 10.0), rtol=0.02, atol=0.0)
    torch.testing.assert_close(q[:, 1], torch.full((2, 2), -20.0), rtol=0.02, atol=0.0)


def test_exploration_follows_epsilon_and_tries_every_action_equally_often() -> None:
    """At epsilon 0.6 with 5 actions the greedy one comes up in 0.4 + 0.6 / 5 of the steps, each other one in 0.12."""
    config = replace(SMALL, epsilon_start=0.6, epsilon_end=0.6)
    agent = DQNAgent(config, 3, 5, streams(range(64)))
    observation = torch.eye(3)[torch.arange(64) % 3]
    greedy = agent.network(observation.unsqueeze(1))[:, 0].argmax(-1).numpy()
    beyond = (np.array([agent.act(observation.numpy()) for _ in range(400)]) - greedy) % 5
    np.testing.assert_allclose(np.bincount(beyond.ravel(), minlength=5) / beyond.size, [0.52, *[0.12] * 4], atol=0.01)


@pytest.mark.parametrize(
    ("steps", "step", "expected"),
    [(500, 0, 1.0), (500, 250, 0.525), (500, 500, 0.05), (500, 501, 0.05), (500, 10**6, 0.05), (0, 0, 0.05)],
)
def test_epsilon_falls_linearly(steps: int, step: int, expected: float) -> None:
    config = DQNConfig(epsilon_start=1.0, epsilon_end=0.05, epsilon_steps=steps)
    assert config.epsilon(step) == pytest.approx(expected)


def test_as_large_a_share_of_a_minibatch_gets_another_goal_as_is_asked_for() -> None:
    """A quarter of 16: four of each agent, whatever is drawn."""
    config = replace(SMALL, hindsight_share=0.25)

    class Marked(Shifted):
        def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
            batch.r_t.fill_(77.0)

    agent = DQNAgent(config, 3, 3, streams(range(2)), Marked())
    before = np.zeros((2, 3), dtype=np.float32)
    agent.replay.add(before, np.zeros(2), np.zeros(2), before, np.ones(2))
    assert ((agent._minibatches(3).r_t == 77.0).sum(-1) == 4).all()


def test_the_last_updates_are_taken_at_the_rate_that_the_config_ends_with() -> None:
    """Adam's first step is as long as its rate, whatever the gradient."""
    config = replace(SMALL, learning_rate_end=3e-5)
    for update, rate in ((0, 3e-3), (config.total_updates, 3e-5)):
        agent = DQNAgent(config, 3, 3, streams(range(2)))
        agent.updates, before = update, agent.network.flat.clone()
        agent.fit(torch.ones(2, 4, 3), torch.zeros(2, 4, dtype=torch.int64), torch.full((2, 4), 9.0))
        assert float((agent.network.flat - before).abs().max()) == pytest.approx(rate, rel=0.01)


def test_costs_are_learned_in_the_scale_of_their_root_and_gaps_are_widened_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """h(z) = c - sqrt(c^2 - z), h^-1(q) = c^2 - (c - q)^2: y = h(r + g h^-1(max q')) - gap (max q - q_a), c = 0.4."""
    config = replace(SMALL, value_root=0.4, action_gap=0.25, gamma=0.9)
    agent = DQNAgent(config, 1, 3, streams(range(1)))
    after, now = torch.tensor([-0.5, -0.3, -0.7]), torch.tensor([-0.9, -0.1, -0.6])
    monkeypatch.setattr(agent, "_q_target", lambda seen: torch.where(seen[..., :1] > 0.0, after, now))
    here, there = torch.full((1, 1, 1, 1), -1.0), torch.full((1, 1, 1, 1), 1.0)
    one = torch.ones(1, 1, 1)
    y = agent._td_target(Transition(here, torch.full((1, 1, 1), 2), -0.05 * one, there, one))
    value = -0.05 + 0.9 * (0.4**2 - (0.4 + 0.3) ** 2)
    assert float(y) == pytest.approx(0.4 - np.sqrt(0.4**2 - value) - 0.25 * (-0.1 + 0.6))


def test_relabelling_without_a_goal_is_refused() -> None:
    config = replace(SMALL, hindsight_share=0.5)
    with pytest.raises(ValueError, match=r"agent\.hindsight_share = 0\.5"):
        DQNAgent(config, 3, 3, streams(range(1)))


GROUPS = (range(4), range(4, 7), range(7, 8))


def _population(threads: int) -> Population:
    trainers = [Trainer(IdentityEnv(s), DQNAgent(SMALL, 3, 3, streams(s)), interval=50) for s in GROUPS]
    return Population(trainers, threads)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    one, many = _population(1), _population(3)
    for a, b in zip(one.run(), many.run(), strict=True):
        assert a.step == b.step
        assert a.episode_return.shape == a.curves["train/loss"].shape == (8,)
        np.testing.assert_array_equal(a.episode_return, b.episode_return)
        for tag, values in a.curves.items():
            np.testing.assert_array_equal(values, b.curves[tag])
    assert (many.n_agents, many.steps, many.updates) == (8, SMALL.total_steps, SMALL.total_updates)
    assert torch.equal(one.weights(), many.weights())


def test_agents_come_in_the_order_of_their_groups() -> None:
    """Agent 5 of the population is the second of the second group, and is the seed 5 trained alone."""
    population = _population(2)
    list(population.run())
    weights = population.weights()
    assert torch.equal(weights[5], population.groups[1].agent.network.flat[1])
    alone = Trainer(IdentityEnv(range(5, 6)), DQNAgent(SMALL, 3, 3, streams(range(5, 6))), interval=50)
    first = next(alone.run())
    np.testing.assert_allclose(next(_population(2).run()).episode_return[5], first.episode_return[0])


def test_an_error_in_one_group_ends_the_run() -> None:
    class Broken(Trainer):
        def run(self) -> Iterator[TrainRecord]:
            yield from ()
            raise RuntimeError("vial 3 is missing")

    population = _population(2)
    broken = population.groups[1]
    population.groups[1] = Broken(broken.env, broken.agent, 50)
    with pytest.raises(RuntimeError, match="vial 3 is missing"):
        list(population.run())


def test_no_running_mean_stays_too_small_for_the_processor() -> None:
    """Units that are never on have gradient 0, and 0.9^k of an earlier one falls below 1e-38 within 900 updates."""
    config = replace(SMALL, total_steps=1200, hidden=(8,), learning_rate=0.05)
    agent = DQNAgent(config, 3, 3, streams(range(4)))
    agent.network.flat[:, 24:28] = -10.0  # biases of the first four units
    earlier = agent.state_dict()
    earlier["adam"]["mean"].fill_(1e-3)
    agent.load_state_dict(earlier)
    population = Population([Trainer(IdentityEnv(range(4)), agent, interval=100)])
    list(population.run())
    mean = population.state_dict()["groups"][0]["agent"]["adam"]["mean"][:, 24:28]
    assert not ((mean != 0) & (mean.abs() < torch.finfo(torch.float32).tiny)).any()


Array = NDArray[Any]


class Uneven:
    """Copy 0 ends by itself after every second step, copy 1 is cut off after every third; each pays its number + 1.

    What is shown is 10 copy + the step of the episode, from 0 on.
    """

    def __init__(self) -> None:
        self._step = np.zeros(2, dtype=np.int64)

    def _show(self) -> Array:
        return (10.0 * np.arange(2) + self._step)[:, None].astype(np.float32)

    def reset(self) -> tuple[Array, dict[str, Any]]:
        return self._show(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        self._step = self._step + 1
        last, done = self._show(), self._step == [2, 3]
        self._step = np.where(done, 0, self._step)
        terminated = done & [True, False]
        return (
            self._show(),
            np.array([1.0, 2.0]),
            terminated,
            done & ~terminated,
            {"final_obs": np.where(done[:, None], last, -1.0)},
        )

    def state_dict(self) -> dict[str, Any]:
        return {"step": self._step.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> Array:
        self._step = np.array(state["step"])
        return self._show()


def test_torch_keeps_no_graph_while_it_trains_and_goes_on_when_it_is_used_afterwards() -> None:
    class Asked(Uneven):
        kept: bool = False

        def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
            self.kept |= not torch.is_inference_mode_enabled()
            return super().step(actions)

    config = DQNConfig(hidden=(8,), total_steps=40, learn_start=10, batch_size=4, target_period=7, replay_size=50)
    env = Asked()
    trainer = Trainer(env, DQNAgent(config, 1, 2, streams(range(2))), interval=15)
    assert [record.step for record in trainer.run()] == [15, 30, 40]
    assert not env.kept
    before = trainer.agent.network.flat.clone()
    trainer.agent.learn()
    assert not torch.equal(before, trainer.agent.network.flat)
    trainer.agent.load_state_dict(trainer.agent.state_dict())


def uneven(total_steps: int = 8) -> Trainer:
    config = DQNConfig(hidden=(4,), total_steps=total_steps, learn_start=total_steps, replay_size=8)
    return Trainer(Uneven(), DQNAgent(config, 1, 2, streams(range(2))), interval=4)


def test_copies_whose_episodes_end_at_other_steps_and_in_other_ways_are_told_apart() -> None:
    trainer = uneven()
    records = list(trainer.run())
    before, after, _, _, goes_on = trainer.agent.replay.state_dict()["rows"].permute(2, 0, 1).tolist()
    assert before == [[0, 1] * 4, [10, 11, 12, 10, 11, 12, 10, 11]]
    assert after == [[1, 2] * 4, [11, 12, 13, 11, 12, 13, 11, 12]]  # the last of an episode, not the next one's first
    assert goes_on == [[1, 0] * 4, [1] * 8]  # nothing follows an end, and a cut is none
    assert [record.episode_return.tolist() for record in records] == [[2.0, 6.0], [2.0, 6.0]]


def test_records_come_at_multiples_of_their_interval_wherever_a_run_goes_on() -> None:
    """After six steps the next one is due at eight, and the last at the end."""
    trainer = uneven(total_steps=11)
    trainer._observation, _ = trainer.env.reset()
    trainer._until(6)
    assert [record.step for record in trainer.run()] == [8, 11]


CONFIG = DQNConfig(
    hidden=(8,), total_steps=130, epsilon_steps=100, learn_start=20, batch_size=8, updates_per_step=2, target_period=10
)


class Paid(IdentityEnv):
    """Keeps what it paid."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.paid: list[np.ndarray] = []

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        answer = super().step(actions)
        self.paid.append(answer[1])
        return answer


def test_records_come_at_their_steps_and_at_the_end_and_tell_of_the_last_whole_episode() -> None:
    env = Paid(range(2), length=40)
    trainer = Trainer(env, DQNAgent(CONFIG, 3, 3, streams(range(2))), interval=30)
    records = list(trainer.run())
    assert [r.step for r in records] == [30, 60, 90, 120, 130]
    assert [r.updates for r in records] == [20, 80, 140, 200, 220]  # two from step 21 on
    assert [r.curves["train/epsilon"] for r in records] == pytest.approx([0.715, 0.43, 0.145, 0.05, 0.05])
    paid = np.array(env.paid)
    episodes = [paid[start : start + 40].sum(axis=0) for start in (0, 40, 80)]
    expected = [[np.nan] * 2, *episodes, [np.nan] * 2]
    np.testing.assert_array_equal([r.episode_return for r in records], expected)
    assert [bool(np.any(r.curves["q/max"] > r.curves["q/min"])) for r in records] == [False, False, True, True, True]
    assert list(trainer.run()) == []


def test_loss_and_range_of_q_are_looked_at_every_hundredth_update() -> None:
    agent = DQNAgent(DQNConfig(hidden=(8,), batch_size=4, huber=0.5), 3, 3, streams(range(2)))
    generator = torch.Generator().manual_seed(0)
    for k in range(1, DIAGNOSED + 2):
        observation = torch.randn(2, 4, 3, generator=generator)
        action = torch.randint(0, 3, (2, 4), generator=generator)
        target = torch.randn(2, 4, generator=generator)
        q = agent.network(observation).clone()
        agent.fit(observation, action, target)
        if k < DIAGNOSED:
            assert not agent.loss.any()
            assert not agent.q_range.any()
        if k == DIAGNOSED == 100:
            error = q.gather(-1, action.unsqueeze(-1)).squeeze(-1) - target
            loss = torch.nn.functional.huber_loss(error, torch.zeros(2, 4), reduction="none", delta=0.5).mean(-1)
            seen = torch.stack([q.flatten(1).min(1).values, q.flatten(1).max(1).values], dim=1)
    torch.testing.assert_close(agent.loss, loss)
    torch.testing.assert_close(agent.q_range, seen)


def test_records_of_several_trainers_are_joined_in_order() -> None:
    one, other = (
        TrainRecord(7, 5, np.array([10.0 * k]), {"loss": np.array([10.0 * k + 1]), "epsilon": 0.5}) for k in (1, 2)
    )
    joined = TrainRecord.joined([one, other])
    assert (joined.step, joined.updates, joined.curves["epsilon"]) == (7, 5, 0.5)
    assert [list(field) for field in (joined.episode_return, joined.curves["loss"])] == [[10.0, 20.0], [11.0, 21.0]]


@pytest.mark.parametrize(("total", "start", "each", "updates"), [(100, 30, 2, 140), (20, 30, 2, 0), (31, 30, 1, 1)])
def test_how_many_updates_a_training_takes(total: int, start: int, each: int, updates: int) -> None:
    assert DQNConfig(total_steps=total, learn_start=start, updates_per_step=each).total_updates == updates


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"input_matrix": (1.0, 0.0), "input_offset": ()}, "input_matrix has 2 values and agent.input_offset 0"),
        ({"input_matrix": (), "input_offset": (1.0,)}, "input_matrix has 0 values and agent.input_offset 1"),
        (
            {"input_matrix": (1.0, 0.0, 1.0), "input_offset": (0.0, 0.0)},
            "input_matrix has 3 values and agent.input_offset 2: allowed one row",
        ),
    ],
)
def test_parts_of_the_input_map_that_do_not_fit_are_refused(changes: dict[str, Any], key: str) -> None:
    with pytest.raises(ValueError, match=rf"agent\.{key}"):
        DQNConfig(**changes)
    DQNConfig(hidden=(5,), input_matrix=(1.0, 0.0, 0.0, 1.0), input_offset=(0.0, 0.0))


@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_the_target_of_an_update_with_and_without_an_action_gap(gap: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """y = r + gamma max Q(s') - gap (max Q(s) - Q(s, a)) of one transition; that of the second agent has terminated."""
    maps = {"input_matrix": (1.0, -1.0, 0.0, 2.0), "input_offset": (0.5, 0.0)}
    config = DQNConfig(hidden=(8,), batch_size=4, gamma=0.9, action_gap=gap, reward_scale=2.0, **maps)
    agent = DQNAgent(config, 2, 3, streams(range(2)))
    np.testing.assert_array_equal(agent.network.input_map()[0], [[1.0, -1.0], [0.0, 2.0]])
    np.testing.assert_array_equal(agent.network.input_map()[1], [0.5, 0.0])
    assert agent.sizes == (2, 8, 3)
    before, after, action = np.full((2, 2), 0.3), np.full((2, 2), 0.7), np.array([1, 2])
    agent.observe(before, action, np.array([0.25, -0.5]), after, np.array([1.0, 0.0]))
    seen: list[torch.Tensor] = []
    monkeypatch.setattr(agent, "fit", lambda observation, chosen, target: seen.append(target))
    agent.learn()
    q, q_after = (agent.target(torch.full((2, 1, 2), x))[:, 0] for x in (0.3, 0.7))
    chosen = q[torch.arange(2), torch.tensor(action)]
    y = torch.tensor([0.5, -1.0]) + torch.tensor([0.9, 0.0]) * q_after.max(1).values - gap * (q.max(1).values - chosen)
    torch.testing.assert_close(seen[0], y[:, None].expand(2, 4))
