"""How good a policy is on its task: noise-free rollouts on a grid, compared with the optimum."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Act", "Evaluated", "Evaluation", "Rollout", "Score", "rollout"]

Array = NDArray[np.float64]
Act = Callable[[Array, Array], NDArray[np.intp]]
"""(first, second observation), each (S, G) -> action indices (S, G)."""

STEADY_STEPS = 30  # the last steps of an evaluation rollout, over which the steady error is taken


@dataclass(frozen=True, eq=False)
class Rollout:
    """state: first observation after each step, shape (K, S, G); action: taken in each step, (K, S, G)."""

    state: Array
    action: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Score:
    """Per agent, shape (S,): cost J, regret in per cent of the optimum's, steady error at the worst setpoint.

    steady_by_setpoint: the same at each setpoint (or whatever the second observation is), shape (S, M).
    """

    cost: Array
    regret_pct: Array
    steady_by_setpoint: Array

    @property
    def steady_abs_error(self) -> Array:
        """Largest over the setpoints, shape (S,): an offset at one of them is an offset that a lab sees."""
        return np.asarray(self.steady_by_setpoint.max(axis=-1))


class Evaluated(Protocol):
    """What an evaluation needs of a task. steps: of a rollout. arrived: error within which the optimum is at rest."""

    steps: int
    arrived: float

    def advance(self, state: Array, second: Array, action: NDArray[Any]) -> Array:
        """The first observation after one step, shape of all three."""
        ...

    def error(self, state: Array, second: Array) -> Array:
        """Whose square is the cost of a step."""
        ...

    def best(self, first: Array, second: Array) -> Rollout:
        """The optimum of each episode from starts of shape (G,), as the only policy (S = 1) of a rollout."""
        ...


def rollout(act: Act, task: Evaluated, first: Array, second: Array) -> Rollout:
    """Noise-free closed loop of S policies from G starts. Args: act: the policies. first, second: starts, (S, G)."""
    states = np.empty((task.steps, *first.shape))
    actions = np.empty((task.steps, *first.shape), dtype=np.intp)
    state = first
    for k in range(task.steps):
        actions[k] = act(state, second)
        states[k] = state = task.advance(state, second, actions[k])
    return Rollout(states, actions)


class Evaluation:
    """Scores policies on one grid against the optimum of the same model, actions, starts and number of steps.

    J = mean over the grid of sum over the steps of error^2 taken after each step (the start's own error is not
    counted); regret_pct = 100 (J / J* - 1); steady_abs_error = the largest over the setpoints of the median over starts
    and last 30 steps of |error|. Starts are left out from which the optimum is still on its way then, further than
    `arrived` (and than from the best start) from the setpoint: a slow pump does not thin 1.1 to 0.2 in time.

    Args: task: what is scored. grid: first and second observation at the start, each (G,).
    """

    def __init__(self, task: Evaluated, grid: tuple[Array, Array]) -> None:
        self.task = task
        self.first, self.second = grid
        run = task.best(self.first, self.second)
        furthest = np.abs(task.error(run.state[-STEADY_STEPS:, 0], self.second)).max(axis=0)
        at = [self.second == s for s in np.unique(self.second)]
        self._resting = [here & (furthest <= max(task.arrived, furthest[here].min())) for here in at]
        self.optimum_cost = float(self._cost(run)[0])
        self.optimum_steady = float(self._steady(run)[0].max())

    def _cost(self, run: Rollout) -> Array:
        return np.asarray(np.square(self.task.error(run.state, self.second)).sum(axis=0).mean(axis=-1))

    def _steady(self, run: Rollout) -> Array:
        """Median of each setpoint, shape (S, M)."""
        last = np.abs(self.task.error(run.state[-STEADY_STEPS:], self.second))
        return np.stack([np.median(last[..., there], axis=(0, 2)) for there in self._resting], axis=-1)

    def __call__(self, act: Act, agents: int = 1) -> Score:
        """Score S = `agents` policies."""
        shape = (agents, self.first.size)
        first, second = np.broadcast_to(self.first, shape), np.broadcast_to(self.second, shape)
        run = rollout(act, self.task, first, second)
        cost = self._cost(run)
        return Score(cost, 100.0 * (cost / self.optimum_cost - 1.0), self._steady(run))
