"""What each entry point can be told: the typed schema behind conf/*.yaml. Light to import: no torch, no matplotlib."""

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
    threads: int = 0  # CPU threads of torch; 0: one for a few agents, all for many
    eval_every: int = 500  # steps between evaluations of the greedy policy
    checkpoint_every: int = 1000  # steps between checkpoints
    resume: str | None = None  # a run folder to continue

    def __post_init__(self) -> None:
        """Check every range once, where the value enters."""
        checks = (
            ("seed", self.seed, self.seed >= 0, "at least 0"),
            ("n_agents", self.n_agents, 1 <= self.n_agents <= 100_000, "1 to 100000"),
            ("device", self.device, self.device in ("cpu", "cuda"), "cpu or cuda"),
            ("threads", self.threads, self.threads >= 0, "at least 0 (0 = automatic)"),
            ("eval_every", self.eval_every, self.eval_every >= 1, "at least 1 step"),
            ("checkpoint_every", self.checkpoint_every, self.checkpoint_every >= 1, "at least 1 step"),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"{key} = {value}: allowed {allowed}")
