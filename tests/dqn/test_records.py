"""What training tells of itself, by hand: records, diagnostics, counts, targets."""

from typing import Any

import numpy as np
import pytest
import torch

from dqn.agent import DIAGNOSED, DQNAgent
from dqn.config import DQNConfig
from dqn.trainer import Trainer, TrainRecord
from tests.dqn.problems import IdentityEnv, streams

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
