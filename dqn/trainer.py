"""The loop of agent and environment as a generator; counting, logging, evaluating and stopping belong to the caller."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from dqn.agent import DQNAgent

__all__ = ["TrainRecord", "Trainer", "TrainingEnv"]

Step = tuple[
    NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
]  # observations, rewards, terminated, truncated, infos


class TrainingEnv(Protocol):
    """A vector environment with one copy per agent, SAME_STEP autoreset, whose state can be saved."""

    def reset(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes in all copies."""

    def step(self, actions: NDArray[np.intp]) -> Step:
        """One step in all copies; infos["final_obs"] holds last observations where an episode ended."""

    def state_dict(self) -> dict[str, Any]:
        """Complete state."""

    def load_state_dict(self, state: dict[str, Any]) -> NDArray[np.float32]:
        """Restore it; returns the current observations."""


@dataclass(frozen=True)
class TrainRecord:
    """What happened in one interval of training; arrays have one entry per agent, shape (S,).

    episode_return: undiscounted reward of the last episode that ended in the interval, nan where none did.
    loss, q_min, q_max: of the last update at which they were looked at, at most 100 updates ago.
    """

    step: int
    updates: int
    epsilon: float
    episode_return: NDArray[np.float64]
    loss: NDArray[np.float64]
    q_min: NDArray[np.float64]
    q_max: NDArray[np.float64]

    @classmethod
    def joined(cls, records: Sequence[TrainRecord]) -> TrainRecord:
        """One record of the agents of several, taken at the same step."""
        each = ("episode_return", "loss", "q_min", "q_max")
        whole: dict[str, Any] = {key: np.concatenate([getattr(r, key) for r in records]) for key in each}
        return replace(records[0], **whole)


class Trainer:
    """Lets S agents act in S copies of the environment and learn.

    Args: env: one copy per agent. agent: the S agents. interval: steps between records.
    """

    def __init__(self, env: TrainingEnv, agent: DQNAgent, interval: int) -> None:
        self.env = env
        self.agent = agent
        self.interval = interval
        self._return = np.zeros(agent.n_agents)
        self._finished = np.full(agent.n_agents, np.nan)
        self._observation: NDArray[np.float32] | None = None

    def run(self) -> Iterator[TrainRecord]:
        """Train until the config's total_steps, yielding a record every `interval` steps and at the end."""
        if self._observation is None:
            self._observation, _ = self.env.reset()
        total = self.agent.config.total_steps
        while self.agent.steps < total:
            self._until(min(total, self.agent.steps - self.agent.steps % self.interval + self.interval))
            record = self._record()
            self._finished[:] = np.nan  # whoever saves at a record saves none of its returns
            yield record

    @torch.inference_mode()  # gradients are written out by hand: torch need not be ready for any
    def _until(self, step: int) -> None:
        """Train until so many environment steps are done."""
        while self.agent.steps < step:
            self._step()

    def _step(self) -> None:
        """One environment step of every agent, and its updates."""
        assert self._observation is not None
        agent = self.agent
        before = self._observation
        action = agent.act(before)
        self._observation, reward, terminated, truncated, infos = self.env.step(action)
        done = terminated | truncated
        ended = done.any()
        # at the end of an episode the environment already shows the start of the next one
        reached = np.where(done[:, None], infos["final_obs"], self._observation) if ended else self._observation
        agent.observe(before, action, reward, reached, ~terminated)
        self._return += reward
        if ended:
            self._finished[done] = self._return[done]
            self._return[done] = 0.0

    def _record(self) -> TrainRecord:
        agent = self.agent
        q_range = agent.q_range.cpu().numpy().astype(np.float64)
        return TrainRecord(
            step=agent.steps, updates=agent.updates, epsilon=agent.epsilon, episode_return=self._finished.copy(),
            loss=agent.loss.cpu().numpy().astype(np.float64), q_min=q_range[:, 0], q_max=q_range[:, 1],
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Complete state of agents, environment and loop."""
        return {
            "agent": self.agent.state_dict(),
            "env": self.env.state_dict(),
            "return": self._return.tolist(),
            "finished": self._finished.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue as saved."""
        self.agent.load_state_dict(state["agent"])
        self._observation = self.env.load_state_dict(state["env"])
        self._return[:] = state["return"]
        self._finished[:] = state["finished"]
