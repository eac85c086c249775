"""What a training run is told."""

from __future__ import annotations

from dataclasses import dataclass

from conf.schema import check, part, setting
from dqn.config import DQNConfig
from envs.task import EnvConfig

__all__ = ["TrainConfig"]


@dataclass(frozen=True)
class TrainConfig:
    """`python -m experiments.train`. Raises: ValueError naming key, value and allowed range."""

    env: EnvConfig = part(EnvConfig, "the training model and its episodes")
    agent: DQNConfig = part(DQNConfig, "the agent's hyper-parameters")
    env_file: str | None = setting(None, "a calibrated.yaml; replaces env")
    seed: int = setting(0, "of the first agent", at_least=0)
    n_agents: int = setting(1, "with seeds seed, seed + 1, ... in one process", within=(1, 100_000))
    device: str = setting("cpu", "where networks are trained", choices=("cpu", "cuda"))
    threads: int | None = setting(
        None, "groups of 16 agents trained at the same time; null: one per core. No effect on results", at_least=1
    )
    eval_every: int = setting(
        250, "between evaluations of the greedy policy on the selection grid", "steps", at_least=1
    )
    checkpoint_every: int = setting(1000, "between checkpoints", "steps", at_least=1)
    resume: str | None = setting(None, "a run folder to continue")

    def __post_init__(self) -> None:
        check(self)
