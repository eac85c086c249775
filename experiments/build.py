"""Config to objects: the single place where the parts meet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from dqn.agent import STREAMS, DQNAgent, Relabel
from dqn.network import QNetwork
from dqn.replay import Transition
from dqn.trainer import Trainer
from envs.rewards import tracking_reward
from envs.task import EnvConfig
from envs.vector_env import BioreactorVectorEnv
from experiments import seeding
from experiments.evaluation import Act

if TYPE_CHECKING:
    from dqn.config import DQNConfig

__all__ = ["act_with", "goal_relabel", "trainer"]


def goal_relabel(config: EnvConfig, device: str) -> Relabel:
    """Replace the setpoint of a transition: (x, u, x') does not depend on it, so the transition stays true.

    The new setpoint is one of the task's, uniformly; the reward is that of the new setpoint.
    """
    goals = torch.tensor(config.setpoints, dtype=torch.float32, device=device)

    def relabel(batch: Transition, uniform: torch.Tensor) -> Transition:
        goal = goals[(uniform[..., 0] * goals.numel()).long()]
        before = torch.stack([batch.s_tm1[..., 0], goal], dim=-1)
        after = torch.stack([batch.s_t[..., 0], goal], dim=-1)
        return batch._replace(s_tm1=before, s_t=after, r_t=tracking_reward(batch.s_t[..., 0], goal))

    return relabel


def trainer(env: EnvConfig, agent: DQNConfig, seeds: Sequence[int], device: str = "cpu") -> Trainer:
    """Agents with the given seeds, each in its own copy of the environment; one record per episode."""
    streams = seeding.streams(seeds, (*STREAMS, "env"))
    copies = BioreactorVectorEnv(len(seeds), env)
    copies.seed_streams(streams["env"])
    learner = DQNAgent(agent, 2, env.n_actions, streams, goal_relabel(env, device), device)
    return Trainer(copies, learner, interval=env.episode_steps)


def act_with(network: QNetwork, flat: torch.Tensor) -> Act:
    """The greedy policies of weights (S, P) as a function on NumPy grids."""
    network = network.with_weights(flat)

    def act(od: np.ndarray, setpoint: np.ndarray) -> np.ndarray:
        observation = torch.from_numpy(np.stack([od, setpoint], axis=-1).astype(np.float32)).to(flat.device)
        return network(observation).argmax(-1).cpu().numpy()

    return act
