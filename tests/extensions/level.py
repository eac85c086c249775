"""Example of a task with its own config: an inflow brings the level of a leaking tank to a goal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from matplotlib.figure import Figure
from numpy.typing import NDArray

from conf.schema import check, setting
from dqn.config import DQNConfig
from dqn.hindsight import GoalRelabel, Relabel
from dqn.policy import Policy
from envs.vector_env import EpisodeVectorEnv
from experiments.training import tasks
from experiments.training.evaluation import Rollout, pairs, rollout

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LevelConfig:
    """Config of a tank whose level follows z <- (1 - leak) z + inflow, between 0 and 1."""

    kind: str = setting("level", "kind of task")
    leak: float = setting(0.1, "fraction of the level that leaks in a step", within=(0, 1))
    most: float = setting(0.2, "largest inflow of a step", above=0.0, at_most=1.0)
    levels: int = setting(5, "number of inflows, equally spaced on [0, most]", within=(2, 100))
    long: int = setting(25, "steps of an episode", at_least=1)

    def __post_init__(self) -> None:
        check(self, "env")


class LevelEnv(EpisodeVectorEnv[Any]):
    """Environment of N tanks. Observation: [level, goal]. Reward: -(level - goal)^2."""

    def __init__(self, n: int, config: LevelConfig) -> None:
        self._level = Level(config)
        super().__init__(n, _Episodes(config.long, config.levels))

    @staticmethod
    def observations(config: Any) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (2,), dtype=np.float32)

    def _begun(self, numbers: Array) -> Array:
        return numbers

    def _advance(self, actions: NDArray[np.intp]) -> Array:
        self.state, error = self._level.advance(self.state, actions)
        return -np.square(error)


@dataclass(frozen=True)
class _Episodes:
    """Values that `EpisodeVectorEnv` needs in its config."""

    episode_steps: int
    n_actions: int


class Level:
    """The task. `Task` describes its members."""

    observation: tuple[str, ...] = ("level", "goal")
    unit = "of the tank"
    arrived = 0.05
    regret_unit, steady_unit = 5.0, 0.05
    tried = ""

    def __init__(self, config: LevelConfig) -> None:
        self.config = config
        self.steps = self.episode_steps = config.long
        self.steady_steps = max(1, config.long // 3)
        self.actions = np.linspace(0.0, config.most, config.levels)
        self.limits = (np.zeros(2), np.ones(2))
        self.description = f"a tank that loses {100.0 * config.leak:g} % in a step"
        self.scalars: Mapping[str, float] = {"leak": config.leak}

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> LevelEnv:
        env = LevelEnv(len(seeds), self.config)
        env.seed_streams(seeds)
        return env

    def hindsight(self, agent: DQNConfig) -> Relabel:
        return GoalRelabel(agent, (0.0, 1.0), lambda level, goal: -((level - goal) ** 2))

    def selection_grid(self) -> Array:
        return pairs(np.linspace(0.05, 0.95, 7), np.linspace(0.15, 0.85, 4))

    def report_grid(self) -> Array:
        return pairs(np.linspace(0.0, 1.0, 9), np.linspace(0.1, 0.9, 5))

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        after = np.clip((1.0 - self.config.leak) * observation[..., 0] + self.actions[action], 0.0, 1.0)
        return np.stack([after, observation[..., 1]], axis=-1), after - observation[..., 1]

    def asked(self, start: Array) -> Array:
        return start[:, 1]

    def best(self, start: Array) -> Rollout:
        return rollout(self.myopic, self, start[None])

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        after = (1.0 - self.config.leak) * observation[..., :1] + self.actions
        return np.asarray(np.abs(after - observation[..., 1:]).argmin(axis=-1))

    def model(self) -> dict[str, Any]:
        return {"model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        return {}


tasks.add("level", LevelConfig, Level, "The level of a leaking tank.")
