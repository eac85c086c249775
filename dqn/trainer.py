"""Training loop of agents and environment, a generator of records. The caller logs, evaluates and stops."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from dqn.network import QNetwork

Array = NDArray[np.float64]
Curves = Mapping[str, Array | float]

Step = tuple[
    NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
]  # observations, rewards, terminated, truncated, infos


class TrainingEnv(Protocol):
    """Vector environment with one copy per agent and SAME_STEP autoreset; its state can be saved."""

    def reset(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes in all copies."""

    def step(self, actions: NDArray[np.intp]) -> Step:
        """Run one step in all copies; infos["final_obs"] holds the last observation of each episode that ended."""

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state."""

    def load_state_dict(self, state: dict[str, Any]) -> NDArray[np.float32]:
        """Restore a state; return the current observations."""


class Agent(Protocol):
    """Interface of S agents that learn in parallel, each in its own copy of the environment; `DQNAgent` is one kind.

    config: has `kind` and `total_steps`. network: the networks of all agents; the action with the largest output is
    greedy, and this policy is scored and exported. steps: environment steps so far. updates: gradient steps so far.
    """

    config: Any
    network: QNetwork
    n_agents: int
    steps: int
    updates: int

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Choose exploratory actions, (S, O) -> (S,)."""

    def observe(
        self,
        s_tm1: NDArray[np.float32],
        a_tm1: NDArray[np.int64],
        r_t: Array,
        s_t: NDArray[np.float32],
        continues: NDArray[np.bool_],
        ended: NDArray[np.bool_],
    ) -> None:
        """Process one step of every agent and learn from it.

        Args: s_tm1, s_t: observation before and after the step, (S, O). continues: whether to bootstrap from s_t, (S,).
        ended: whether the episode ended, (S,). Both are true at the last step of a truncated episode.
        """

    def curves(self) -> Curves:
        """Return the values to log, by tag: one number per agent, (S,), or one number for all agents."""

    def state_dict(self) -> dict[str, Any]:
        """Return tensors and plain values from which a new agent with the same config continues bit for bit."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a saved state."""


@dataclass(frozen=True)
class TrainRecord:
    """Record of one interval of training; arrays have one entry per agent, shape (S,).

    episode_return: sum of rewards of the last episode that ended in the interval, nan if none ended.
    curves: the values of `Agent.curves`, by tag.
    """

    step: int
    updates: int
    episode_return: Array
    curves: Curves

    @classmethod
    def joined(cls, records: Sequence[TrainRecord]) -> TrainRecord:
        """Join records of the same step into one record of all agents."""
        curves = {
            tag: np.concatenate([np.asarray(r.curves[tag]) for r in records]) if np.ndim(first) else first
            for tag, first in records[0].curves.items()
        }
        return replace(records[0], episode_return=np.concatenate([r.episode_return for r in records]), curves=curves)


class Trainer:
    """Training loop: S agents act in S copies of the environment and learn.

    Args: env: the S copies. agent: the S agents. interval: environment steps between records.
    """

    def __init__(self, env: TrainingEnv, agent: Agent, interval: int) -> None:
        self.env = env
        self.agent = agent
        self.interval = interval
        self._return = np.zeros(agent.n_agents)
        self._finished = np.full(agent.n_agents, np.nan)
        self._observation: NDArray[np.float32] | None = None

    def run(self) -> Iterator[TrainRecord]:
        """Train up to `total_steps` of the config; yield a record every `interval` steps and at the end."""
        if self._observation is None:
            self._observation, _ = self.env.reset()
        total = self.agent.config.total_steps
        while self.agent.steps < total:
            self._until(min(total, self.agent.steps - self.agent.steps % self.interval + self.interval))
            record = self._record()
            self._finished[:] = np.nan  # a state saved at a record must not contain its returns
            yield record

    @torch.inference_mode()  # gradients are computed by hand, so torch needs no graph
    def _until(self, step: int) -> None:
        while self.agent.steps < step:
            self._step()

    def _step(self) -> None:
        """Run one environment step of every agent and the updates that are due."""
        assert self._observation is not None
        agent = self.agent
        before = self._observation
        action = agent.act(before)
        self._observation, reward, terminated, truncated, infos = self.env.step(action)
        done = terminated | truncated
        ended = done.any()
        # at the end of an episode the environment returns the first observation of the next one
        reached = np.where(done[:, None], infos["final_obs"], self._observation) if ended else self._observation
        agent.observe(before, action, reward, reached, ~terminated, done)
        self._return += reward
        if ended:
            self._finished[done] = self._return[done]
            self._return[done] = 0.0

    def _record(self) -> TrainRecord:
        agent = self.agent
        return TrainRecord(agent.steps, agent.updates, self._finished.copy(), agent.curves())

    def state_dict(self) -> dict[str, Any]:
        return {
            "agent": self.agent.state_dict(),
            "env": self.env.state_dict(),
            "return": self._return.tolist(),
            "finished": self._finished.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.agent.load_state_dict(state["agent"])
        self._observation = self.env.load_state_dict(state["env"])
        self._return[:] = state["return"]
        self._finished[:] = state["finished"]
