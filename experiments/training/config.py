"""Config of a training run, and registries of its tasks and agents. This module does not load torch."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from conf import presets
from conf.messages import NameTaken, NotAllowed
from conf.schema import check, part, setting
from dqn.config import DQNConfig
from envs.preview import PreviewConfig
from envs.relative import RelativeConfig
from envs.task import EnvConfig

ENVS: dict[str, type[Any]] = {"density": EnvConfig, "relative": RelativeConfig, "preview": PreviewConfig}


@dataclass(frozen=True)
class TaskKind:
    """Kind of task.

    make: function that returns a `Task` (`experiments/training/tasks.py`) for the task's config.
    completed: function that fills a run's config from its files; None: `env_file` is a calibrated.yaml for env.
    repeats: keys of the run's config whose values `deploy` needs, too.
    """

    make: Callable[[Any], Any]
    completed: Callable[["TrainConfig"], "TrainConfig"] | None = None
    repeats: tuple[str, ...] = ()


TASKS: dict[type[Any], TaskKind] = {}
"""Class of a task's config -> kind of task."""


def add(
    kind: str,
    config: type[Any],
    task: Callable[[Any], Any],
    what: str,
    completed: Callable[["TrainConfig"], "TrainConfig"] | None = None,
    repeats: tuple[str, ...] = (),
) -> None:
    """Register a task as `train env=KIND`.

    Args:
      kind: name of the task; `config` has a field `kind` with this default.
      config: dataclass of the task's values, each made by `conf.schema.setting`.
      what: sentence in the help; "" if a preset in conf/ has the sentence.
      task, completed, repeats: as `make`, `completed` and `repeats` of `TaskKind`.
    Raises: ValueError if the kind exists already.
    """
    if kind in ENVS:
        raise NameTaken(what="env", name=kind)
    if what:
        presets.add(f"env/{kind}", {"kind": kind}, what)
    ENVS[kind], TASKS[config] = config, TaskKind(task, completed, repeats)


def env_schema(kind: str, key: str = "env") -> Any:
    """Return the default config of an environment of this kind. Raises: ValueError with all known kinds."""
    if kind not in ENVS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(ENVS))
    return ENVS[kind]()


AGENTS: dict[str, type[Any]] = {"dqn": DQNConfig}


def agent_schema(kind: str, key: str = "agent") -> Any:
    """Return the default config of an agent of this kind, "" for dqn. Raises: ValueError with all known kinds."""
    if (kind or "dqn") not in AGENTS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(AGENTS))
    return AGENTS[kind or "dqn"]()


@dataclass(frozen=True)
class TrainConfig:
    """Config of a training run. Raises: ValueError with key, value and allowed range."""

    env: Any = part(EnvConfig, "the training model and its episodes", env_schema)
    agent: Any = part(DQNConfig, "the agent's hyper-parameters", agent_schema)
    env_file: str | None = setting(
        None,
        "a calibrated.yaml, or `latest`: the newest one of calibrate; replaces env. Other tasks: see their pages",
    )
    seed: int = setting(0, "seed of the first agent", at_least=0)
    n_agents: int = setting(1, "number of agents, with seeds seed, seed + 1, ... in one process", within=(1, 100_000))
    device: str = setting("cpu", "device on which networks are trained", choices=("cpu", "cuda"))
    threads: int | None = setting(
        None, "groups of 16 agents that train in parallel; null: one per core. No effect on results", at_least=1
    )
    eval_every: int = setting(
        100, "steps between evaluations of the greedy policy on the selection grid", "steps", at_least=1
    )
    stop_within: float | None = setting(
        None,
        "stop when the kept policies of all agents are within this multiple of the task's limits on the selection grid "
        "(limits of env=sim: 0.5 % regret, 0.003 OD steady error); null: never",
        above=0.0,
    )
    checkpoint_every: int = setting(1000, "steps between checkpoints", "steps", at_least=1)
    resume: str | None = setting(None, "a run folder to continue, or `latest`")

    def __post_init__(self) -> None:
        check(self)
