"""What `python -m experiments.benchmark` can be told."""

from dataclasses import dataclass
from typing import Any

from conf.schema import check, part, setting
from dqn.config import DQNConfig
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig

__all__ = ["BenchmarkConfig", "StudyConfig"]


@dataclass(frozen=True)
class StudyConfig:
    """Every controller on every plant in every scenario; the names are keys of the config's groups."""

    scenarios: tuple[str, ...] = setting(("setpoint_steps",), "names of scenarios")
    plants: tuple[str, ...] = setting(("nominal_noise",), "names of plants")
    controllers: tuple[str, ...] = setting(("dqn", "pi", "mpc"), "names of controllers")


@dataclass(frozen=True)
class BenchmarkConfig:
    """The closed loops to compare. Raises: ValueError naming key, value and what is allowed."""

    replicates: int = setting(
        3, "vials per controller, plant and scenario (paper: 3), run as one batch", within=(1, 10_000)
    )
    seed: int = setting(
        0, "of plants, noise, training and calibration; every controller meets the same draws", at_least=0
    )
    env: EnvConfig = part(EnvConfig, "what model-based controllers believe, and agents are trained on")
    agents: dict[str, DQNConfig] = setting({}, "learned controllers by name")
    train_seeds: int = setting(
        4, "seeds an agent is trained with; the best policy on the selection grid controls", within=(1, 1000)
    )
    workers: int = setting(
        0, "processes for the closed loops; 0: one per core, 1: this one only. No effect on results", within=(0, 256)
    )
    policy: str | None = setting(None, "a policy.npz or a training's run folder for `dqn`, in place of training here")
    calibration: bool = setting(False, "simulate the open-loop protocol and fit it (Fig. 2a)")
    training: bool = setting(False, "train all agents even if no study needs them (Fig. 2b)")
    plants: dict[str, PlantConfig] = setting({}, "plants by name")
    scenarios: dict[str, Scenario] = setting({}, "scenarios by name")
    controllers: dict[str, Any] = setting({}, "controllers by name")
    studies: dict[str, StudyConfig] = setting({}, "what is compared, by name; the recipes of experiment/ fill it")

    def __post_init__(self) -> None:
        check(self)
        for name, study in self.studies.items():
            for key in ("scenarios", "plants", "controllers"):
                known = getattr(self, key)
                for given in getattr(study, key):
                    if given not in known:
                        raise ValueError(f"studies.{name}.{key}: {given} is none of {', '.join(known)}")
