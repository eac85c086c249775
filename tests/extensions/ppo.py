"""Example of an agent: proximal policy optimization (Schulman 2017) with an actor and a critic."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from conf.schema import check, setting
from dqn.network import QNetwork, initial_weights
from dqn.optimiser import Adam
from dqn.streams import UniformStream
from experiments.training import agents
from experiments.training.agents import Streams
from experiments.training.tasks import Task


@dataclass(frozen=True)
class PpoConfig:
    """Hyper-parameters of the agent. Raises: ValueError with key, value and allowed range."""

    kind: str = setting("ppo", "kind of agent")
    hidden: tuple[int, ...] = setting((32, 32), "hidden layers of actor and critic", "units", at_least=1, some=True)
    gamma: float = setting(0.95, "discount per step", at_least=0.0, below=1.0)
    trace: float = setting(0.9, "lambda of the advantages", within=(0, 1))
    learning_rate: float = setting(3e-3, "learning rate of Adam", above=0.0, at_most=1.0)
    total_steps: int = setting(20_000, "length of training", "steps", at_least=1)
    horizon: int = setting(200, "steps between updates", "steps", at_least=2)
    epochs: int = setting(10, "gradient steps on each horizon", at_least=1)
    clip: float = setting(0.2, "largest relative change of a probability in one update", above=0.0, below=1.0)
    entropy: float = setting(3e-3, "weight of the policy's entropy", at_least=0.0)

    def __post_init__(self) -> None:
        check(self, "agent")


class Ppo:
    """S agents. The actor's outputs are logits; the greedy action has the largest logit."""

    def __init__(self, config: PpoConfig, task: Task, streams: Streams, device: str) -> None:
        self.config, self.device = config, torch.device(device)
        self.n_agents, self.steps, self.updates = len(streams["actor"]), 0, 0
        seen = len(task.observation)
        self.network, self._critic = (
            QNetwork(self._weights(streams[name], (seen, *config.hidden, outputs)), (seen, *config.hidden, outputs))
            for name, outputs in (("actor", task.actions.size), ("critic", 1))
        )
        self._adams = [Adam(one.flat, one.grad) for one in (self.network, self._critic)]
        self._explore = UniformStream(streams["explore"], 1)
        self._kept: list[tuple[torch.Tensor, ...]] = []  # of this horizon: s, a, r, s', continues, ended
        self._loss = torch.zeros(self.n_agents)  # loss of the critic

    def _weights(self, seeds: Any, sizes: tuple[int, ...]) -> torch.Tensor:
        flat = np.stack([initial_weights(sizes, seed, zero_output=True) for seed in seeds])
        return torch.from_numpy(flat).to(self.device)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        chances = self.network(torch.from_numpy(observation).to(self.device).unsqueeze(1))[:, 0].softmax(-1)
        drawn = torch.from_numpy(self._explore.take(1)[:, 0]).to(self.device)
        below = (chances.cumsum(-1)[:, :-1] <= drawn).sum(-1)
        return below.cpu().numpy()

    def observe(self, s_tm1: Any, a_tm1: Any, r_t: Any, s_t: Any, continues: Any, ended: Any) -> None:
        given = (s_tm1, a_tm1, r_t.astype(np.float32), s_t, continues, ended)
        self._kept.append(tuple(torch.from_numpy(np.array(each)).to(self.device) for each in given))
        self.steps += 1
        if len(self._kept) == self.config.horizon:
            self._learn(*(torch.stack(column, 1) for column in zip(*self._kept, strict=True)))
            self._kept = []

    def _learn(self, s: Any, a: Any, r: Any, s_t: Any, continues: Any, ended: Any) -> None:
        """Learn from one horizon, (S, T, ...) each: generalized advantages, then `epochs` steps on clipped ratios."""
        c = self.config
        v, v_t = (self._critic(seen).squeeze(-1) for seen in (s, s_t))
        advantage = r + c.gamma * continues * v_t - v
        for k in range(c.horizon - 2, -1, -1):
            advantage[:, k] += c.gamma * c.trace * ~ended[:, k] * advantage[:, k + 1]
        target = advantage + v
        advantage = (advantage - advantage.mean(1, True)) / (advantage.std(1, keepdim=True) + 1e-8)
        before = self._chances(s)[1].gather(-1, a.unsqueeze(-1)).squeeze(-1)
        for _ in range(c.epochs):
            inputs, logs = self._chances(s)
            ratio = (logs.gather(-1, a.unsqueeze(-1)).squeeze(-1) - before).exp()
            free = torch.where(advantage > 0.0, ratio < 1.0 + c.clip, ratio > 1.0 - c.clip)
            chances, taken = logs.exp(), torch.nn.functional.one_hot(a, logs.shape[-1])
            entropy = -(chances * logs).sum(-1, keepdim=True)
            gradient = (free * ratio * advantage).unsqueeze(-1) * (chances - taken)
            gradient += c.entropy * chances * (logs + entropy)
            self.network.backward(inputs, gradient / c.horizon)
            value, inputs = self._critic.forward(s)
            error = value - target.unsqueeze(-1)
            self._critic.backward(inputs, error / c.horizon)
            for adam in self._adams:
                adam.step(c.learning_rate)
            self.updates += 1
        self._loss = error.square().mean((1, 2)).cpu()

    def _chances(self, s: Any) -> tuple[Any, torch.Tensor]:
        logits, inputs = self.network.forward(s)
        return inputs, logits.log_softmax(-1)

    def curves(self) -> Mapping[str, NDArray[np.float64] | float]:
        return {"train/critic_loss": self._loss.double().numpy()}

    def state_dict(self) -> dict[str, Any]:
        return {
            "weights": [one.flat.cpu() for one in (self.network, self._critic)],
            "adams": [adam.state_dict() for adam in self._adams],
            "explore": self._explore.state_dict(),
            "kept": [tuple(each.cpu() for each in step) for step in self._kept],
            "loss": self._loss,
            "counts": (self.steps, self.updates),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for one, flat in zip((self.network, self._critic), state["weights"], strict=True):
            one.flat.copy_(flat)
        for adam, saved in zip(self._adams, state["adams"], strict=True):
            adam.load_state_dict(saved)
        self._explore.load_state_dict(state["explore"])
        self._kept = [tuple(each.to(self.device) for each in step) for step in state["kept"]]
        self._loss = state["loss"]
        self.steps, self.updates = state["counts"]


agents.add("ppo", PpoConfig, Ppo, ("actor", "critic", "explore"), "Proximal policy optimization.")
