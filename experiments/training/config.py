"""What a training run is told."""

from __future__ import annotations

from dataclasses import dataclass, field

from dqn.config import DQNConfig
from envs.task import EnvConfig

__all__ = ["TrainConfig"]


@dataclass(frozen=True)
class TrainConfig:
    """`python -m experiments.train`. Raises: ValueError naming key, value and allowed range."""

    env: EnvConfig = field(default_factory=EnvConfig)
    agent: DQNConfig = field(default_factory=DQNConfig)
    env_file: str | None = None  # a calibrated.yaml; replaces `env`
    seed: int = 0  # of the first agent
    n_agents: int = 1  # agents with seeds seed, seed + 1, ... trained in one process
    device: str = "cpu"  # cpu | cuda
    threads: int | None = None  # groups of 16 agents trained at the same time; None: one per core; no effect on results
    eval_every: int = 250  # steps between evaluations of the greedy policy
    checkpoint_every: int = 1000  # steps between checkpoints
    resume: str | None = None  # a run folder to continue

    def __post_init__(self) -> None:
        """Check every range once, where the value enters."""
        checks = (
            ("seed", self.seed, self.seed >= 0, "at least 0"),
            ("n_agents", self.n_agents, 1 <= self.n_agents <= 100_000, "1 to 100000"),
            ("device", self.device, self.device in ("cpu", "cuda"), "cpu or cuda"),
            (
                "threads",
                self.threads,
                self.threads is None or self.threads >= 1,
                "at least 1, or null",
            ),
            ("eval_every", self.eval_every, self.eval_every >= 1, "at least 1 step"),
            ("checkpoint_every", self.checkpoint_every, self.checkpoint_every >= 1, "at least 1 step"),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"{key} = {value}: allowed {allowed}")
