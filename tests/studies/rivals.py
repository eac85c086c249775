"""What speed is compared with: other ways to do the same work. Nothing but the measurements of learning imports it.

The single-file loop has the structure of CleanRL's dqn.py: `torch.nn` layers, autograd, `torch.optim.Adam`, a NumPy
ring buffer, Gymnasium's sync vector environment with one copy and episode statistics; without its logging to disk.
Same schedule as ours throughout.
"""

from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import envs  # noqa: F401  (registers ENV_ID)
from dqn.config import DQNConfig

__all__ = ["Ring", "single_file_dqn", "stable_baselines_dqn", "sync_vector_env"]

ENV_ID = "Bioreactor-v0"


class Ring:
    """A replay memory in NumPy, one array per field."""

    def __init__(self, capacity: int, observations: int) -> None:
        kinds = ((observations,), "f4"), ((observations,), "f4"), ((), "i8"), ((), "f4"), ((), "f4")
        self.fields: list[NDArray[Any]] = [np.zeros((capacity, 1, *shape), dtype=kind) for shape, kind in kinds]
        self.capacity, self.added = capacity, 0

    def add(self, *fields: NDArray[Any]) -> None:
        """Store one transition (before, after, action, reward, ended) in place of the oldest."""
        for store, value in zip(self.fields, fields, strict=True):
            store[self.added % self.capacity] = value
        self.added += 1

    def sample(self, rng: np.random.Generator, batch: int) -> list[torch.Tensor]:
        """A uniform minibatch as tensors."""
        k = rng.integers(0, min(self.added, self.capacity), batch)
        return [torch.from_numpy(field[k, 0]) for field in self.fields]


def single_file_dqn(config: DQNConfig, seed: int) -> torch.nn.Module:
    """Train one agent with `config`'s schedule the way CleanRL's dqn.py is built; returns its network."""
    vector_kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP}
    envs_ = gymnasium.make_vec(ENV_ID, 1, "sync", vector_kwargs, [gymnasium.wrappers.RecordEpisodeStatistics])
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    units = (2, *config.hidden)

    def network() -> torch.nn.Module:
        layers: list[torch.nn.Module] = []
        for i, o in pairwise(units):
            layers += [torch.nn.Linear(i, o), torch.nn.ReLU()]
        return torch.nn.Sequential(*layers, torch.nn.Linear(units[-1], 17))

    online, target = network(), network()
    target.load_state_dict(online.state_dict())
    adam = torch.optim.Adam(online.parameters(), lr=config.learning_rate)
    memory = Ring(config.replay_size, 2)
    observation, _ = envs_.reset(seed=seed)
    for step in range(1, config.total_steps + 1):
        if rng.random() < config.epsilon(step):
            action = rng.integers(0, 17, 1)
        else:
            action = torch.argmax(online(torch.Tensor(observation)), dim=1).numpy()
        after, reward, terminated, truncated, infos = envs_.step(action)
        reached = after.copy()
        for i, ended in enumerate(truncated):
            if ended:
                reached[i] = infos["final_obs"][i]
        memory.add(observation, reached, action, reward, terminated)
        observation = after
        if step <= config.learn_start:
            continue
        before, next_, actions, rewards, ends = memory.sample(rng, config.batch_size)
        with torch.no_grad():
            goal = rewards + config.gamma * (1.0 - ends) * target(next_).max(dim=1).values
        loss = torch.nn.functional.mse_loss(goal, online(before).gather(1, actions[:, None]).squeeze(1))
        adam.zero_grad()
        torch.autograd.backward(loss)
        adam.step()
        if (step - config.learn_start) % config.target_period == 0:
            for t, o in zip(target.parameters(), online.parameters(), strict=True):
                t.data.copy_(o.data)
    return online


def stable_baselines_dqn(config: DQNConfig, seed: int) -> object:
    """Train one agent with Stable-Baselines3's DQN at the same schedule. Raises: ImportError without extra [bench]."""
    from stable_baselines3 import DQN

    model = DQN(
        "MlpPolicy", gymnasium.make(ENV_ID), learning_rate=config.learning_rate, buffer_size=config.replay_size,
        learning_starts=config.learn_start, batch_size=config.batch_size, gamma=config.gamma, train_freq=1,
        gradient_steps=config.updates_per_step, target_update_interval=config.target_period,
        exploration_fraction=config.epsilon_steps / config.total_steps, exploration_initial_eps=config.epsilon_start,
        exploration_final_eps=config.epsilon_end, policy_kwargs={"net_arch": list(config.hidden)}, seed=seed,
        device="cpu",
    )  # fmt: skip
    model.learn(config.total_steps)
    return model


def sync_vector_env(copies: int) -> gymnasium.vector.VectorEnv:
    """Gymnasium's own vectorisation: a Python loop over single environments."""
    return gymnasium.make_vec(
        ENV_ID, num_envs=copies, vectorization_mode="sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}
    )
