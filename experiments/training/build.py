"""Agents in their environments from a config, and policies from weights."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from dqn.network import QNetwork
from dqn.population import GROUP, Population
from dqn.trainer import Trainer
from experiments.training import agents
from experiments.training.evaluation import Act
from experiments.training.tasks import Task

__all__ = ["act_with", "population", "streams", "trainer"]


def streams(seeds: Sequence[int], names: Sequence[str]) -> dict[str, list[np.random.SeedSequence]]:
    """Make for each name one SeedSequence per seed, independent of the other names and seeds.

    The stream of a name depends on its seed and its place in `names` only, so agent i of a population has the same
    streams as a single agent with its seed. Append new names at the end.
    """
    spawned = [np.random.SeedSequence(seed).spawn(len(names)) for seed in seeds]
    return {name: [children[k] for children in spawned] for k, name in enumerate(names)}


def population(
    task: Task, agent: Any, seeds: Sequence[int], device: str = "cpu", threads: int | None = None
) -> Population:
    """Make agents with the given seeds in groups of a suitable size; arguments as `Population`."""
    size = GROUP if device == "cpu" else len(seeds)
    groups = [seeds[k : k + size] for k in range(0, len(seeds), size)]
    return Population([trainer(task, agent, group, device) for group in groups], threads)


def trainer(task: Task, agent: Any, seeds: Sequence[int], device: str = "cpu") -> Trainer:
    """Make one group of agents with the given seeds, each with its own environment; one record per episode."""
    own = streams(seeds, (*agents.names(agent), "env"))
    return Trainer(task.copies(own["env"]), agents.build(agent, task, own, device), interval=task.episode_steps)


def act_with(network: QNetwork, flat: torch.Tensor) -> Act:
    """Turn weights (S, P) into greedy policies on NumPy grids."""
    network = network.with_weights(flat)

    def act(observation: np.ndarray) -> np.ndarray:
        return network(torch.from_numpy(observation.astype(np.float32)).to(flat.device)).argmax(-1).cpu().numpy()

    return act
