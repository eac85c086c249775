"""Population of agents, trained in parallel groups on the CPU's cores."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

from dqn.network import QNetwork
from dqn.trainer import Trainer, TrainRecord

GROUP = 16
"""Agents per group on a CPU: many enough that the overhead of torch calls is small, few enough for the CPU's caches."""


def fast_arithmetic() -> None:
    """Treat numbers below 1e-38 as 0 in this thread, if the processor supports it.

    The gradient of an inactive unit is 0. Adam's running mean of it then shrinks by a tenth per update, down to 1e-45.
    Processors are many times slower with such numbers. They would cause steps below 1e-30, so no weight changes.
    """
    torch.set_flush_denormal(True)


class Population:
    """S agents in independent groups. Each group has its own copies of the environment and trains in a thread.

    Torch releases Python's lock during its operations, so two groups on two cores need two thirds of the sequential
    time. The grouping, and therefore the result, does not depend on the number of threads.

    Args:
      groups: trainers with the same config and interval; the agents are numbered in this order.
      threads: groups trained at the same time; None: the number of cores that this process may use.
    """

    def __init__(self, groups: Sequence[Trainer], threads: int | None = None) -> None:
        self.groups = list(groups)
        mine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()  # macOS, Windows
        self.threads = threads or mine or 1

    @property
    def n_agents(self) -> int:
        """Number of agents, S."""
        return sum(group.agent.n_agents for group in self.groups)

    @property
    def steps(self) -> int:
        return self.groups[0].agent.steps

    @property
    def updates(self) -> int:
        return self.groups[0].agent.updates

    @property
    def network(self) -> QNetwork:
        """Network of the first group; its shape and constants hold for every agent (`with_weights`)."""
        return self.groups[0].agent.network

    def weights(self) -> torch.Tensor:
        """Return a copy of the current weights of all agents, shape (S, P)."""
        return torch.cat([group.agent.network.flat for group in self.groups])

    def run(self) -> Iterator[TrainRecord]:
        """Train all groups to the end; yield one record of all agents per interval."""
        running = [group.run() for group in self.groups]
        with ThreadPoolExecutor(min(self.threads, len(running)), initializer=fast_arithmetic) as pool:
            while True:
                records = [r for r in pool.map(lambda group: next(group, None), running) if r is not None]
                if not records:
                    return
                yield TrainRecord.joined(records)

    def state_dict(self) -> dict[str, Any]:
        return {"groups": [group.state_dict() for group in self.groups]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for group, saved in zip(self.groups, state["groups"], strict=True):
            group.load_state_dict(saved)
