"""What speed is compared with: other ways to do the same work. Never imported by anything but `experiments.speed`.

The single-file loop follows the structure that is common in single-file DQN code: `torch.nn` layers, autograd,
`torch.optim.Adam`, a NumPy ring buffer, one Gymnasium environment at a time. Same schedule as ours throughout.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import envs
from dqn.config import DQNConfig
from dqn.schedules import linear

__all__ = ["Ring", "single_file_dqn", "stable_baselines_dqn", "sync_vector_env"]

ENV_ID = "Bioreactor-v0"
assert envs.__doc__  # imported for its registration


class Ring:
    """A replay memory in NumPy, one array per field."""

    def __init__(self, capacity: int, observations: int) -> None:
        self.before = np.zeros((capacity, observations), dtype=np.float32)
        self.after = np.zeros((capacity, observations), dtype=np.float32)
        self.action = np.zeros(capacity, dtype=np.int64)
        self.reward = np.zeros(capacity, dtype=np.float32)
        self.ended = np.zeros(capacity, dtype=np.float32)
        self.added = 0

    def add(
        self, before: NDArray[np.float32], after: NDArray[np.float32], action: int, reward: float, ended: bool
    ) -> None:
        """Store one transition in place of the oldest."""
        k = self.added % self.action.size
        self.before[k], self.after[k], self.action[k] = before, after, action
        self.reward[k], self.ended[k] = reward, ended
        self.added += 1

    def sample(self, rng: np.random.Generator, batch: int) -> tuple[torch.Tensor, ...]:
        """A uniform minibatch as tensors."""
        k = rng.integers(0, min(self.added, self.action.size), batch)
        fields = (self.before, self.after, self.action, self.reward, self.ended)
        return tuple(torch.from_numpy(field[k]) for field in fields)


def single_file_dqn(config: DQNConfig, seed: int) -> torch.nn.Module:
    """Train one agent with `config`'s schedule the common way; returns its network."""
    env = gymnasium.make(ENV_ID)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    units = (2, *config.hidden)

    def network() -> torch.nn.Module:
        layers: list[torch.nn.Module] = []
        for i, o in zip(units[:-1], units[1:], strict=True):
            layers += [torch.nn.Linear(i, o), torch.nn.ReLU()]
        return torch.nn.Sequential(*layers, torch.nn.Linear(units[-1], 17))

    online, target = network(), network()
    target.load_state_dict(online.state_dict())
    adam = torch.optim.Adam(online.parameters(), lr=config.learning_rate)
    memory = Ring(config.replay_size, 2)
    observation, _ = env.reset(seed=seed)
    for step in range(1, config.total_steps + 1):
        if rng.random() < linear(config.epsilon_start, config.epsilon_end, config.epsilon_steps, step):
            action = int(rng.integers(17))
        else:
            with torch.no_grad():
                action = int(online(torch.from_numpy(observation)).argmax())
        after, reward, ended, truncated, _ = env.step(action)
        memory.add(observation, after, action, float(reward), ended)
        observation = env.reset()[0] if ended or truncated else after
        if step <= config.learn_start:
            continue
        before, reached, actions, rewards, ends = memory.sample(rng, config.batch_size)
        with torch.no_grad():
            goal = rewards + config.gamma * (1.0 - ends) * target(reached).max(dim=1).values
        loss = torch.nn.functional.mse_loss(goal, online(before).gather(1, actions[:, None]).squeeze(1))
        adam.zero_grad()
        loss.backward()
        adam.step()
        if (step - config.learn_start) % config.target_period == 0:
            target.load_state_dict(online.state_dict())
    return online


def stable_baselines_dqn(config: DQNConfig, seed: int) -> object:
    """Train one agent with Stable-Baselines3's DQN at the same schedule. Raises: ImportError without extra [bench]."""
    from stable_baselines3 import DQN

    model = DQN(
        "MlpPolicy",
        gymnasium.make(ENV_ID),
        learning_rate=config.learning_rate,
        buffer_size=config.replay_size,
        learning_starts=config.learn_start,
        batch_size=config.batch_size,
        gamma=config.gamma,
        train_freq=1,
        gradient_steps=config.updates_per_step,
        target_update_interval=config.target_period,
        exploration_fraction=config.epsilon_steps / config.total_steps,
        exploration_initial_eps=config.epsilon_start,
        exploration_final_eps=config.epsilon_end,
        policy_kwargs={"net_arch": list(config.hidden)},
        seed=seed,
        device="cpu",
    )
    model.learn(config.total_steps)
    return model


def sync_vector_env(copies: int) -> gymnasium.vector.VectorEnv:
    """Gymnasium's own vectorisation: a Python loop over single environments."""
    return gymnasium.make_vec(
        ENV_ID,
        num_envs=copies,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
    )
