"""The loop of agent and environment, on a chain whose values are known by hand."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dqn.agent import DQNAgent
from dqn.config import DQNConfig
from dqn.trainer import Trainer
from tests.dqn.problems import streams

pytestmark = pytest.mark.numeric

Array = NDArray[Any]


class Chain:
    """Two states, shown one-hot: 0 leads to 1 and pays 0, 1 leads to itself and pays 1, whatever the action.

    Each episode is cut off after one step; they start in 0, 0, 1, 0, 0, 1 ..., all copies in the same state. With
    discount g, V(1) = 1 / (1 - g) and V(0) = g V(1).
    """

    def __init__(self, copies: int) -> None:
        self.copies, self._starts = copies, 0
        self._state = 0

    def _show(self, state: int) -> Array:
        return np.tile(np.eye(2, dtype=np.float32)[state], (self.copies, 1))

    def _begin(self) -> Array:
        self._state = 1 if self._starts % 3 == 2 else 0
        self._starts += 1
        return self._show(self._state)

    def reset(self) -> tuple[Array, dict[str, Any]]:
        return self._begin(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        paid, cut = np.full(self.copies, float(self._state)), np.ones(self.copies, dtype=np.bool_)
        infos = {"final_obs": self._show(1), "_final_obs": cut}
        return self._begin(), paid, np.zeros(self.copies, dtype=np.bool_), cut, infos

    def state_dict(self) -> dict[str, Any]:
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> Array:
        raise NotImplementedError


def test_what_follows_a_cut_episode_is_what_it_reached_and_not_where_the_next_one_starts() -> None:
    """V(1) = 1 / (1 - 0.8) = 5 and V(0) = 0.8 * 5 = 4; from the starts of the next episodes it were 2.4 and 1.8."""
    config = DQNConfig(
        hidden=(16,), gamma=0.8, learning_rate=3e-3, total_steps=900, epsilon_end=1.0, learn_start=32, batch_size=32,
        target_period=20, replay_size=900,
    )  # fmt: skip
    trainer = Trainer(Chain(4), DQNAgent(config, 2, 2, streams(range(4))), interval=100)
    returns = np.array([record.episode_return for record in trainer.run()])
    q = trainer.agent.online(torch.eye(2).expand(4, 2, 2))
    torch.testing.assert_close(q[:, 1], torch.full((4, 2), 5.0), rtol=0.05, atol=0.0)
    torch.testing.assert_close(q[:, 0], torch.full((4, 2), 4.0), rtol=0.05, atol=0.0)
    assert set(returns.ravel().tolist()) <= {0.0, 1.0}


def test_torch_keeps_no_graph_while_it_trains_and_goes_on_when_it_is_used_afterwards() -> None:
    class Asked(Chain):
        kept: bool = False

        def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
            self.kept |= not torch.is_inference_mode_enabled()
            return super().step(actions)

    config = DQNConfig(hidden=(8,), total_steps=40, learn_start=10, batch_size=4, target_period=7, replay_size=50)
    env = Asked(2)
    trainer = Trainer(env, DQNAgent(config, 2, 2, streams(range(2))), interval=15)
    assert [record.step for record in trainer.run()] == [15, 30, 40]
    assert not env.kept
    before = trainer.agent.online.flat.clone()
    trainer.agent.learn()
    assert not torch.equal(before, trainer.agent.online.flat)
    trainer.agent.load_state_dict(trainer.agent.state_dict())


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
