"""The agent: epsilon-greedy choice of actions and the DQN update, for S independent seeds at once."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import Relabel
from dqn.network import QNetwork, action_basis, initial_weights
from dqn.optimiser import Adam
from dqn.replay import Array, Replay, Transition
from dqn.streams import UniformStream
from dqn.targets import advantage_target, compressed, expanded, huber_loss, loss_gradient, q_target

STREAMS = ("init", "explore", "replay", "hindsight")
"""Names of the random streams an agent needs, each independent of the others."""

DIAGNOSED = 100  # updates between two diagnoses of the loss and the range of Q


class DQNAgent:
    """Deep Q-learning (Mnih 2015) of S independent agents.

    One update (`learn`): draw a minibatch, form y = r + gamma max_a Q_target(s', a), take one Adam step on
    mean (Q(s, a) - y)^2 / 2, and every `target_period` updates copy the weights to the target network. All updates of
    one environment step draw from the same memory, and the target network is constant between two copies. So the
    minibatches and targets of these updates are computed together. `hindsight_share` changes the minibatch,
    `action_gap` and `value_root` change the target y, and `huber` changes the loss.

    Args:
      config: hyper-parameters. observations: O, numbers per observation. actions: A, number of actions.
      streams: for each name in STREAMS one SeedSequence per agent.
      relabel: replaces the goals in a fraction `config.hindsight_share` of each minibatch.
      device: "cpu" or "cuda".
    """

    def __init__(
        self,
        config: DQNConfig,
        observations: int,
        actions: int,
        streams: Mapping[str, Sequence[np.random.SeedSequence]],
        relabel: Relabel | None = None,
        device: str = "cpu",
    ) -> None:
        self.config = config
        self.device = torch.device(device)
        self.n_agents = len(streams["init"])
        self.n_actions = actions
        matrix = offset = None
        if config.input_matrix:
            offset = torch.tensor(config.input_offset, dtype=torch.float32, device=self.device)
            matrix = torch.tensor(config.input_matrix, dtype=torch.float32, device=self.device).view(len(offset), -1)
        features = observations if offset is None else len(offset)
        self.sizes = (features, *config.hidden, actions)
        flat = np.stack([initial_weights(self.sizes, seed, config.init_zero_output) for seed in streams["init"]])
        weights = torch.from_numpy(flat).to(self.device)
        basis = action_basis(actions, config.output_basis_decay).to(self.device) if config.output_basis_decay else None
        self.network = QNetwork(weights, self.sizes, matrix, offset, basis)
        self.target = self.network.with_weights(weights.clone())
        self._adam = Adam(weights, self.network.grad)
        self.replay = Replay(self.n_agents, config.replay_size, observations, self.device)
        self._explore = UniformStream(streams["explore"], 2)
        self._draws = UniformStream(streams["replay"], config.batch_size)
        self._relabelled = round(config.hindsight_share * config.batch_size)
        if self._relabelled and relabel is None:
            raise ValueError(
                f"agent.hindsight_share = {config.hindsight_share}: the task has no goal to replace; set the share to 0"
            )
        self._relabel = relabel
        numbers = self._relabelled * relabel.numbers if relabel else 0
        self._goals = UniformStream(streams["hindsight"], max(1, numbers), self._drawn)
        self._parts: dict[str, Adam | Replay | UniformStream] = {
            "adam": self._adam, "replay": self.replay,
            "explore": self._explore, "draws": self._draws, "goals": self._goals,
        }  # fmt: skip
        self.steps = 0  # environment steps taken
        self.updates = 0
        self.loss = torch.zeros(self.n_agents, device=self.device)  # at the last diagnosed update
        self.q_range = torch.zeros(self.n_agents, 2, device=self.device)  # min and max Q in its minibatch

    @property
    def epsilon(self) -> float:
        return self.config.epsilon(self.steps)

    def act(self, observation: Array) -> NDArray[np.int64]:
        """Choose an epsilon-greedy action for the observation of each agent, (S, O) -> (S,)."""
        u: NDArray[np.float64] = self._explore.take(1)[:, 0]
        action = (u[:, 1] * self.n_actions).astype(np.int64)
        greedy = u[:, 0] >= self.epsilon
        if greedy.any():
            seen = torch.from_numpy(observation).to(self.device).unsqueeze(1)
            best = self.network(seen).argmax(-1).view(-1).cpu().numpy()
            action = np.where(greedy, best, action)
        return action

    def observe(
        self, s_tm1: Array, a_tm1: Array, r_t: Array, s_t: Array, continues: Array, ended: Array | None = None
    ) -> None:
        """Store one step of every agent and run the updates that are due.

        Args: as in `Replay.add`; ended: not used, because transitions are replayed one by one.
        """
        self.replay.add(s_tm1, a_tm1, r_t * self.config.reward_scale, s_t, continues)
        self.steps += 1
        if self.steps > self.config.learn_start:
            self.learn(self.config.updates_per_step)

    def _drawn(self, uniform: Array) -> torch.Tensor:
        """Turn a block of random numbers into goals: (S, calls, m W) -> (S, calls, m, any)."""
        assert self._relabel is not None
        numbers = torch.from_numpy(uniform).to(self.device)
        return self._relabel.drawn(numbers.view(*numbers.shape[:2], -1, self._relabel.numbers))

    def _minibatches(self, most: int) -> Transition:
        """Draw n <= `most` minibatches of B transitions per agent, (S, n, B); part of each minibatch gets new goals.

        The observations are returned as features, (S, n, B, F), because the map from one to the other is constant.
        """
        batch = self.replay.sample(self._draws.take(most))
        if self._relabelled:
            assert self._relabel is not None
            first = Transition(*(field[:, :, : self._relabelled] for field in batch))
            self._relabel.replace(first, self._goals.take(most))
            first.r_t.mul_(self.config.reward_scale)
        features = self.network.features
        return batch._replace(s_tm1=features(batch.s_tm1), s_t=features(batch.s_t))

    def _q_target(self, features: torch.Tensor) -> torch.Tensor:
        """Compute Q with the target network, (S, n, B, F) -> (S, n, B, A)."""
        agents, n, b, f = features.shape
        return self.target.forward(features.view(agents, n * b, f))[0].view(agents, n, b, self.n_actions)

    def _td_target(self, batch: Transition) -> torch.Tensor:
        c = self.config
        q_t = self._q_target(batch.s_t)
        if c.value_root:
            target = compressed(
                q_target(batch.r_t, batch.continues, c.gamma, expanded(q_t, c.value_root)), c.value_root
            )
        else:
            target = q_target(batch.r_t, batch.continues, c.gamma, q_t)
        if c.action_gap:
            target = advantage_target(target, c.action_gap, self._q_target(batch.s_tm1), batch.a_tm1)
        return target

    def learn(self, updates: int = 1) -> None:
        """Run `updates` gradient steps, split at each copy of the target network."""
        while updates:
            due = self.config.target_period - self.updates % self.config.target_period
            batch = self._minibatches(min(updates, due))
            target = self._td_target(batch)
            for one in zip(batch.s_tm1.unbind(1), batch.a_tm1.unbind(1), target.unbind(1), strict=True):
                self.fit(*one)
            updates -= target.shape[1]

    def fit(self, features: torch.Tensor, action: torch.Tensor, target: torch.Tensor) -> None:
        """Take one Adam step towards Q(features, action) = target; if due, copy to the target network and diagnose.

        Args: features: features of the observations, (S, B, F). action: (S, B) int64. target: (S, B).
        """
        c = self.config
        q, inputs = self.network.forward(features)
        td_error, gradient = loss_gradient(q, action, target, c.huber)
        self.network.backward(inputs, gradient)
        self._adam.step(c.learning_rate_at(self.updates))
        self.updates += 1
        if self.updates % c.target_period == 0:
            self.target.flat.copy_(self.network.flat)
        if self.updates % DIAGNOSED == 0:
            self.loss = huber_loss(td_error, c.huber)
            self.q_range = torch.stack([q.amin((1, 2)), q.amax((1, 2))], dim=1)

    def curves(self) -> dict[str, NDArray[np.float64] | float]:
        """Return the exploration rate now, and the loss and range of Q at the last diagnosed update."""
        q_range = self.q_range.cpu().numpy().astype(np.float64)
        return {
            "train/loss": self.loss.cpu().numpy().astype(np.float64),
            "train/epsilon": self.epsilon,
            "q/min": q_range[:, 0],
            "q/max": q_range[:, 1],
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the complete learning state; with it, a new agent continues bit for bit on the same processor."""
        tensors = {"online": self.network.flat, "target": self.target.flat, "loss": self.loss, "q_range": self.q_range}
        counts = {"steps": self.steps, "updates": self.updates}
        parts = {name: part.state_dict() for name, part in self._parts.items()}
        return {**{name: tensor.cpu() for name, tensor in tensors.items()}, **parts, **counts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a saved state. Raises: RuntimeError from torch if shapes differ."""
        self.network.flat.copy_(state["online"])
        self.target.flat.copy_(state["target"])
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.steps = state["steps"]
        self.updates = state["updates"]
        self.loss = state["loss"].to(self.device)
        self.q_range = state["q_range"].to(self.device)
