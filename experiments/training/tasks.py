"""Tasks of a training run. `of` returns the task for the config of an environment."""

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

    config: config of the environment, of any class. observation: names of the O inputs, as in the policy file.
    actions: values of the A actions, (A,). limits: lowest and highest observation for the policy file, (O,) each.
    unit: unit of the error. regret_unit, steady_unit: limits of regret (per cent) and steady error for a good policy.
    episode_steps: steps of a training episode. description: the model's numbers, for the log. scalars: the same for
    TensorBoard's table of runs. provable: whether `certify` can prove the closed loop of a policy of this task.
    tried: arguments with which `deploy` runs such a policy, {} for the file; "" if `deploy` cannot run it.
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
        """Return the relabelling that gives replayed transitions new goals."""

    def selection_grid(self) -> Array:
        """Return the starts, (G, O), for the comparison of policies during training."""

    def report_grid(self) -> Array:
        """Return the starts, (G, O), for the reported scores; they share no point with `selection_grid`."""

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Return the action with the smallest next error (the one-line controller), (..., O) -> (...)."""

    def model(self) -> dict[str, Any]:
        """Return the training model, for the metadata of the policy file."""

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Draw the policy map, and example trajectories of the policy and of the optimum."""


TASKS |= {
    EnvConfig: TaskKind(DensityTask), RelativeConfig: TaskKind(Relative), PreviewConfig: TaskKind(Preview),
}  # fmt: skip


def kind(config: Any) -> str:
    """Return the registered kind of an environment's config."""
    return next(name for name, known in ENVS.items() if known is type(config))


def of(config: Any) -> Task:
    """Return the task of an environment's config."""
    task: Task = TASKS[type(config)].make(config)
    return task
