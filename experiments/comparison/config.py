"""The typed schema behind conf/benchmark.yaml: what `python -m experiments.benchmark` can be given."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dqn.config import DQNConfig
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig

__all__ = ["BenchmarkConfig", "StudyConfig"]


@dataclass(frozen=True)
class StudyConfig:
    """Every controller on every plant in every scenario; the names are keys of the config's groups."""

    scenarios: tuple[str, ...] = ("setpoint_steps",)
    plants: tuple[str, ...] = ("nominal_noise",)
    controllers: tuple[str, ...] = ("dqn", "pi", "mpc")


@dataclass(frozen=True)
class BenchmarkConfig:
    """The closed loops to compare. Raises: ValueError naming key, value and what is allowed."""

    replicates: int = 3  # vials per controller, plant and scenario, run as one batch
    seed: int = 0  # of plants, noise, training and calibration; every controller meets the same draws
    env: EnvConfig = field(default_factory=EnvConfig)  # what model-based controllers believe, and agents are trained on
    agents: dict[str, DQNConfig] = field(default_factory=dict)  # learned controllers by name
    train_seeds: int = 4  # seeds each agent is trained with; the best on the selection grid controls
    workers: int = 0  # processes for the closed loops; 0 = one per core, 1 = none but this one
    policy: str | None = None  # a policy.npz or run folder for `dqn` in place of training
    calibration: bool = False  # simulate the open-loop protocol and fit it (Fig. 2a)
    training: bool = False  # train all agents even if no study needs them (Fig. 2b)
    plants: dict[str, PlantConfig] = field(default_factory=dict)
    scenarios: dict[str, Scenario] = field(default_factory=dict)
    controllers: dict[str, Any] = field(default_factory=dict)
    studies: dict[str, StudyConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check ranges and names once, where they enter."""
        checks = (
            ("replicates", self.replicates, 1 <= self.replicates <= 10_000, "1 to 10000"),
            ("seed", self.seed, self.seed >= 0, "at least 0"),
            ("workers", self.workers, 0 <= self.workers <= 256, "0 (one per core) to 256"),
            ("train_seeds", self.train_seeds, 1 <= self.train_seeds <= 1000, "1 to 1000"),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"{key} = {value}: allowed {allowed}")
        for name, study in self.studies.items():
            for key in ("scenarios", "plants", "controllers"):
                known = getattr(self, key)
                for given in getattr(study, key):
                    if given not in known:
                        raise ValueError(f"studies.{name}.{key}: {given} is none of {', '.join(known)}")
