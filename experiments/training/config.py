"""The config of a training run. Free of torch."""

from dataclasses import dataclass
from typing import Any

from conf.messages import NotAllowed
from conf.schema import check, part, setting
from dqn.config import DQNConfig
from envs.coculture.task import CocultureConfig
from envs.relative import RelativeConfig
from envs.task import EnvConfig

__all__ = ["AGENTS", "ENVS", "TrainConfig", "agent_schema", "env_schema"]

ENVS: dict[str, type[Any]] = {"density": EnvConfig, "relative": RelativeConfig, "coculture": CocultureConfig}


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
    pair: str | None = setting(
        None,
        "species of env=coculture: a preset of conf/strains, a pair.yaml of calibrate_pair, its run; null: env.pair",
    )
    env_file: str | None = setting(
        None,
        "a calibrated.yaml, or `latest`: the newest one of calibrate; replaces env. For env=coculture and "
        "coculture_preview also a run with a composition: its growth curves",
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
