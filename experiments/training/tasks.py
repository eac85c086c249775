"""Tasks of a training run; `of` returns the task of an environment's config."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import Relabel
from dqn.policy import Policy
from dqn.trainer import TrainingEnv
from envs.preview import PreviewConfig
from envs.relative import RelativeConfig
from envs.task import EnvConfig
from experiments.training.config import ENVS, TASKS, TaskKind
from experiments.training.config import add as add
from experiments.training.density import DensityTask, Preview
from experiments.training.evaluation import Array, Evaluated
from experiments.training.relative import Relative


class Task(Evaluated, Protocol):
    """Task of an agent: environment, scores, export.

    config: of the environment, of any class. observation: O names, as in the policy file. actions: the grid, (A,).
    limits: of the observation in the policy file, low and high, each (O,). regret_unit, steady_unit: per cent of cost
    and steady error of equal weight in a comparison of policies. episode_steps: of a training episode.
    description: numbers of the model, for the log. scalars: the same for TensorBoard's table of runs.
    provable: whether `certify` can prove its closed loop.
    tried: arguments with which `deploy` runs a policy of this task, {} for its file; "" if it cannot.
    """

    config: Any
    episode_steps: int
    description: str
    scalars: Mapping[str, float]
    provable: bool
    tried: str
    observation: tuple[str, ...]
    actions: Array
    limits: tuple[Array, Array]
    unit: str
    regret_unit: float
    steady_unit: float

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> TrainingEnv:
        """Return one copy of the environment per seed."""

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """Return the relabelling of replayed transitions with new goals."""

    def selection_grid(self) -> Array:
        """Return the starts, (G, O), for the comparison of policies during training."""

    def report_grid(self) -> Array:
        """Return the reported grid; it shares no point with `selection_grid`."""

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Choose the action with the smallest next error (one-line controller), (..., O) -> (...)."""

    def model(self) -> dict[str, Any]:
        """Describe the model of the training, for the policy's file."""

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Draw the policy map and example trajectories beside the optimum's."""


TASKS |= {
    EnvConfig: TaskKind(DensityTask), RelativeConfig: TaskKind(Relative), PreviewConfig: TaskKind(Preview),
}  # fmt: skip


def kind(config: Any) -> str:
    """Return the registered name of an environment's config."""
    return next(name for name, known in ENVS.items() if known is type(config))


def of(config: Any) -> Task:
    """Return the task of an environment's config."""
    task: Task = TASKS[type(config)].make(config)
    return task
