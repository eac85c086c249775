"""The config of a training run. Free of torch."""

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
    """How a task is made of its config, and what it makes of a training run's config.

    make: called with the config, returns a `Task` (`experiments/training/tasks.py`).
    completed: reads the files that the run's config names; None: `env_file` is a calibrated.yaml, which replaces env.
    repeats: keys of the run's config that `deploy` has, too, and is to be told alike.
    """

    make: Callable[[Any], Any]
    completed: Callable[["TrainConfig"], "TrainConfig"] | None = None
    repeats: tuple[str, ...] = ()


TASKS: dict[type[Any], TaskKind] = {}
"""By the class of their config."""


def add(
    kind: str,
    config: type[Any],
    task: Callable[[Any], Any],
    what: str,
    completed: Callable[["TrainConfig"], "TrainConfig"] | None = None,
    repeats: tuple[str, ...] = (),
) -> None:
    """Make a task known as `train env=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`.
      what: the sentence that the help shows; "": it has a preset of conf/, whose words are shown.
      task, completed, repeats: as of `TaskKind`.
    Raises: ValueError for a kind that exists.
    """
    if kind in ENVS:
        raise NameTaken(what="env", name=kind)
    if what:
        presets.add(f"env/{kind}", {"kind": kind}, what)
    ENVS[kind], TASKS[config] = config, TaskKind(task, completed, repeats)


def env_schema(kind: str, key: str = "env") -> Any:
    """Return the default config of an environment of this kind. Raises: ValueError naming the kinds there are."""
    if kind not in ENVS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(ENVS))
    return ENVS[kind]()


AGENTS: dict[str, type[Any]] = {"dqn": DQNConfig}


def agent_schema(kind: str, key: str = "agent") -> Any:
    """Return the default config of an agent of this kind, "": dqn. Raises: ValueError naming the kinds there are."""
    if (kind or "dqn") not in AGENTS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(AGENTS))
    return AGENTS[kind or "dqn"]()


@dataclass(frozen=True)
class TrainConfig:
    """`python -m experiments.train`. Raises: ValueError with key, value and allowed range."""

    env: Any = part(EnvConfig, "the training model and its episodes", env_schema)
    agent: Any = part(DQNConfig, "the agent's hyper-parameters", agent_schema)
    env_file: str | None = setting(
        None,
        "a calibrated.yaml, or `latest`: the newest one of calibrate; replaces env. For other tasks as their page says",
    )
    seed: int = setting(0, "seed of the first agent", at_least=0)
    n_agents: int = setting(1, "number of agents, with seeds seed, seed + 1, ... in one process", within=(1, 100_000))
    device: str = setting("cpu", "device on which networks are trained", choices=("cpu", "cuda"))
    threads: int | None = setting(
        None, "groups of 16 agents trained in parallel; null: one per core. No effect on results", at_least=1
    )
    eval_every: int = setting(
        100, "steps between evaluations of the greedy policy on the selection grid", "steps", at_least=1
    )
    stop_within: float | None = setting(
        None,
        "stop when the kept policies of all agents are within this multiple of the task's limits on the selection grid "
        "(env=sim: 0.5 % regret, 0.003 OD steady error); null: never",
        above=0.0,
    )
    checkpoint_every: int = setting(1000, "steps between checkpoints", "steps", at_least=1)
    resume: str | None = setting(None, "a run folder to continue, or `latest`")

    def __post_init__(self) -> None:
        check(self)
