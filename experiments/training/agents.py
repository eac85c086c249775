"""Registry of agents. `build` makes agents of a registered kind, `population` makes groups of agents that train."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from conf import presets
from conf.messages import NameTaken
from dqn.agent import STREAMS, DQNAgent
from dqn.config import DQNConfig
from dqn.network import QNetwork
from dqn.population import GROUP, Population
from dqn.trainer import Agent, Trainer
from experiments.training.config import AGENTS
from experiments.training.evaluation import Act
from experiments.training.tasks import Task

PARTS = (
    "config", "network", "n_agents", "steps", "updates", "act", "observe", "curves", "state_dict", "load_state_dict",
)  # fmt: skip
Streams = Mapping[str, Sequence[np.random.SeedSequence]]
"""Random streams: name of the stream -> one stream for each agent."""


class AgentKind(NamedTuple):
    """Kind of agent. make: function of config, task, streams and device. streams: names of its random streams."""

    make: Callable[[Any, Task, Streams, str], Agent]
    streams: tuple[str, ...]


def _dqn(config: DQNConfig, task: Task, streams: Streams, device: str) -> DQNAgent:
    """Make deep Q-learners. Raises: ValueError if they would never learn, or if their inputs do not fit the task."""
    if config.learn_start >= config.total_steps:
        raise ValueError(
            f"agent.learn_start = {config.learn_start}: allowed 0 to {config.total_steps - 1}, below "
            "agent.total_steps, because learning starts after this step"
        )
    width, seen = np.size(config.input_matrix) // max(1, len(config.input_offset)), len(task.observation)
    if width not in (0, seen):
        raise ValueError(
            f"agent.input_matrix has rows of {width} numbers, but this task observes {seen} numbers "
            f"({', '.join(task.observation)}); choose the agent of the same name as the task (agent=relative for "
            "env=relative), or agent=paper"
        )
    return DQNAgent(config, seen, task.actions.size, streams, task.hindsight(config), device)


KINDS: dict[type[Any], AgentKind] = {DQNConfig: AgentKind(_dqn, STREAMS)}


def add(
    kind: str, config: type[Any], make: Callable[[Any, Task, Streams, str], Agent], streams: Sequence[str], what: str
) -> None:
    """Register an agent as `train agent=KIND`.

    Args:
      kind: name of the agent; `config` has a field `kind` with this default.
      config: dataclass of the agent's values, each made by `conf.schema.setting`; needs a field `total_steps`.
      make: function of config, task, streams and device that makes the agents.
      streams: names of the agent's random streams.
      what: sentence in the help.
    Raises: ValueError if the kind exists already.
    """
    if kind in AGENTS:
        raise NameTaken(what="agent", name=kind)
    presets.add(f"agent/{kind}", {"kind": kind}, what)
    AGENTS[kind], KINDS[config] = config, AgentKind(make, tuple(streams))


def build(config: Any, task: Task, streams: Streams, device: str = "cpu") -> Agent:
    """Make S agents, one for each of the streams' seeds.

    Raises: ValueError if the config does not fit the task, or if the agent lacks an attribute of `Agent`.
    """
    made = KINDS[type(config)].make(config, task, streams, device)
    if missing := [part for part in PARTS if not hasattr(made, part)]:
        raise ValueError(f"agent {config.kind} lacks {', '.join(missing)}; see docs/extending.md, An agent")
    return made


def streams(seeds: Sequence[int], names: Sequence[str]) -> dict[str, list[np.random.SeedSequence]]:
    """Make for each name one SeedSequence per seed. All of them are independent.

    A SeedSequence depends only on the seed and on the name's place in `names`, so agent i of a population has the same
    streams as a single agent with this seed. Append new names at the end.
    """
    spawned = [np.random.SeedSequence(seed).spawn(len(names)) for seed in seeds]
    return {name: [children[k] for children in spawned] for k, name in enumerate(names)}


def population(
    task: Task, agent: Any, seeds: Sequence[int], device: str = "cpu", threads: int | None = None
) -> Population:
    """Make agents with the given seeds in groups of a suitable size. Args: threads: as of `Population`."""
    size = GROUP if device == "cpu" else len(seeds)
    groups = [seeds[k : k + size] for k in range(0, len(seeds), size)]
    return Population([trainer(task, agent, group, device) for group in groups], threads)


def trainer(task: Task, agent: Any, seeds: Sequence[int], device: str = "cpu") -> Trainer:
    """Make a trainer of one agent per seed, each in its own environment, with one record per episode."""
    own = streams(seeds, (*KINDS[type(agent)].streams, "env"))
    return Trainer(task.copies(own["env"]), build(agent, task, own, device), interval=task.episode_steps)


def act_with(network: QNetwork, flat: torch.Tensor) -> Act:
    """Return the greedy policies of weights (S, P), as a function on NumPy arrays."""
    network = network.with_weights(flat)

    def act(observation: np.ndarray) -> np.ndarray:
        return network(torch.from_numpy(observation.astype(np.float32)).to(flat.device)).argmax(-1).cpu().numpy()

    return act
