"""Kinds of agents: `build` makes agents from their config, `add` registers another kind."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from conf import presets
from conf.messages import NameTaken
from dqn.agent import STREAMS, DQNAgent
from dqn.config import DQNConfig
from dqn.trainer import Agent
from experiments.training.config import AGENTS
from experiments.training.tasks import Task

__all__ = ["Streams", "add", "build", "names"]

PARTS = (
    "config", "network", "n_agents", "steps", "updates", "act", "observe", "curves", "state_dict", "load_state_dict",
)  # fmt: skip
Streams = Mapping[str, Sequence[np.random.SeedSequence]]
"""By name, one per agent."""


class AgentKind(NamedTuple):
    """Function that makes agents from config, task, streams and device, and its stream names."""

    make: Callable[[Any, Task, Streams, str], Agent]
    streams: tuple[str, ...]


def _dqn(config: DQNConfig, task: Task, streams: Streams, device: str) -> DQNAgent:
    """Make deep Q-learners. Raises: ValueError if they never learn, or if the inputs are those of another task."""
    if config.learn_start >= config.total_steps:
        raise ValueError(
            f"agent.learn_start = {config.learn_start}: allowed 0 to {config.total_steps - 1}, below "
            "agent.total_steps; learning starts after it"
        )
    width, seen = np.size(config.input_matrix) // max(1, len(config.input_offset)), len(task.observation)
    if width not in (0, seen):
        raise ValueError(
            f"agent.input_matrix has rows of {width} numbers, this task observes {seen} "
            f"({', '.join(task.observation)}): choose the agent of the task, which has its name (agent=relative for "
            "env=relative), or agent=paper"
        )
    return DQNAgent(config, seen, task.actions.size, streams, task.hindsight(config), device)


KINDS: dict[type[Any], AgentKind] = {DQNConfig: AgentKind(_dqn, STREAMS)}


def add(
    kind: str, config: type[Any], make: Callable[[Any, Task, Streams, str], Agent], streams: Sequence[str], what: str
) -> None:
    """Register an agent as `train agent=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`; with `total_steps`.
      make: called with config, task, streams and device.
      streams: names of its random streams.
      what: sentence in the help.
    Raises: ValueError for a kind that exists.
    """
    if kind in AGENTS:
        raise NameTaken(what="agent", name=kind)
    presets.add(f"agent/{kind}", {"kind": kind}, what)
    AGENTS[kind], KINDS[config] = config, AgentKind(make, tuple(streams))


def names(config: Any) -> tuple[str, ...]:
    """Return the names of the streams that agents of this config need."""
    return KINDS[type(config)].streams


def build(config: Any, task: Task, streams: Streams, device: str = "cpu") -> Agent:
    """Make one agent per seed of each stream.

    Raises: ValueError for a config that does not fit the task, or an agent that lacks a method of `Agent`.
    """
    made = KINDS[type(config)].make(config, task, streams, device)
    if missing := [part for part in PARTS if not hasattr(made, part)]:
        raise ValueError(f"agent {config.kind} has no {', '.join(missing)} (docs/extending.md, An agent)")
    return made
