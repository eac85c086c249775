"""Agents in groups: the same whatever the number of threads, and whole again after a stop."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from dqn.agent import DQNAgent
from dqn.config import DQNConfig
from dqn.population import Population
from dqn.trainer import Trainer, TrainRecord
from tests.dqn.problems import IdentityEnv, streams
from tests.dqn.test_agent import SMALL

pytestmark = pytest.mark.numeric

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
    config = DQNConfig(**{**SMALL.__dict__, "total_steps": 1200, "hidden": (8,), "learning_rate": 0.05})
    agent = DQNAgent(config, 3, 3, streams(range(4)))
    agent.network.flat[:, 24:28] = -10.0  # biases of the first four units
    earlier = agent.state_dict()
    earlier["adam"]["mean"].fill_(1e-3)
    agent.load_state_dict(earlier)
    population = Population([Trainer(IdentityEnv(range(4)), agent, interval=100)])
    list(population.run())
    mean = population.state_dict()["groups"][0]["agent"]["adam"]["mean"][:, 24:28]
    assert not ((mean != 0) & (mean.abs() < torch.finfo(torch.float32).tiny)).any()
