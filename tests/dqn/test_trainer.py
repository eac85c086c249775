"""The loop of agent and environment, whose copies end at other steps and in other ways."""

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
