"""What a training run needs to know of a task; `of` finds it from the config of an environment."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from conf import presets
from dqn.config import DQNConfig
from dqn.hindsight import Relabel
from dqn.policy import Policy
from dqn.trainer import TrainingEnv
from envs.coculture.task import CocultureConfig
from envs.preview import PreviewConfig
from envs.relative import RelativeConfig
from envs.task import EnvConfig
from experiments.training.coculture import Coculture
from experiments.training.config import ENVS
from experiments.training.density import DensityTask
from experiments.training.evaluation import Evaluated
from experiments.training.preview import Preview
from experiments.training.relative import Relative

__all__ = ["Task", "add", "kind", "of"]

Array = NDArray[np.float64]


class Task(Evaluated, Protocol):
    """What an agent acts in, is scored on and exports.

    config: of the environment, of any class. observation: O names, as in the policy file. actions: the grid, (A,).
    limits: of the observation in the policy file, low and high, each (O,). regret_unit, steady_unit: per cent of cost
    and steady error that weigh alike when policies are compared. episode_steps: of a training episode.
    description: numbers that say which model it is, for the log. scalars: the same for TensorBoard's table of runs.
    provable: whether `certify` can prove its closed loop.
    tried: the words with which `deploy` runs a policy of this task, {} for its file; "" where it cannot.
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
        """One copy of the environment per seed."""

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """How replayed transitions are given another goal."""

    def selection_grid(self) -> Array:
        """Return the starts, (G, O), on which policies are compared during training."""

    def report_grid(self) -> Array:
        """Return the reported grid; it shares no point with `selection_grid`."""

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Choose the action whose next error is smallest (one-line law), (..., O) -> (...)."""

    def model(self) -> dict[str, Any]:
        """Describe the model that a policy was trained on, for its file."""

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Policy map and example trajectories beside the optimum's."""


TASKS: dict[type[Any], Callable[[Any], Task]] = {
    EnvConfig: DensityTask,
    RelativeConfig: Relative,
    PreviewConfig: Preview,
    CocultureConfig: Coculture,
}


def add(kind: str, config: type[Any], task: Callable[[Any], Task], what: str) -> None:
    """Make a task known as `train env=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`.
      task: called with the config. what: the sentence that the help shows.
    Raises: ValueError for a kind that exists.
    """
    if kind in ENVS:
        raise ValueError(f"env {kind}: there is one of this name already; choose another")
    presets.add(f"env/{kind}", {"kind": kind}, what)
    ENVS[kind], TASKS[config] = config, task


def kind(config: Any) -> str:
    """Return the name under which the config of an environment is known."""
    return next(name for name, known in ENVS.items() if known is type(config))


def of(config: Any) -> Task:
    """Return the task of an environment's config."""
    return TASKS[type(config)](config)
