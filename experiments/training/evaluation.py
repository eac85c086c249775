"""Scores of policies on a task: noise-free rollouts from a grid of starts, compared with the optimum."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dqn.policy import Policy

Array = NDArray[np.float64]
Act = Callable[[Array], NDArray[np.intp]]
"""Function of observations, (S, G, O), that returns action indices, (S, G)."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """Rollout of K steps, arrays (K, S, G): `action`, and after it `state` (the first number observed) and `error`."""

    state: Array
    error: Array
    action: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Score:
    """Score of S agents. cost: J, (S,). regret_pct: cost above the optimum's cost, per cent, (S,).

    steady_by_setpoint: steady error at each of M setpoints (values of `asked`), (S, M).
    mean_abs_error: mean |error| over all steps and starts, (S,).
    """

    cost: Array
    regret_pct: Array
    steady_by_setpoint: Array
    mean_abs_error: Array

    @property
    def steady_abs_error(self) -> Array:
        """Largest steady error over the setpoints, (S,), because an offset at a single setpoint matters in a lab."""
        return np.asarray(self.steady_by_setpoint.max(axis=-1))


class Evaluated(Protocol):
    """Part of a task that an evaluation needs.

    steps: number of steps of a rollout. steady_steps: number of last steps that give the steady error.
    arrived: error below which the optimum counts as at rest.
    """

    steps: int
    steady_steps: int
    arrived: float

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Return the observation after one step, (..., O), and the error, (...); the step's cost is its square."""

    def asked(self, start: Array) -> Array:
        """Return the value that groups steady errors, e.g. the setpoint, (G,), of starts (G, O)."""

    def best(self, start: Array) -> Rollout:
        """Return the optimum's rollout from starts (G, O), with S = 1."""


def pairs(first: Array, second: Array) -> Array:
    """Return every pair of numbers of two lists, (A B, 2); the second number changes fastest."""
    return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)


def each(policy: Policy) -> Act:
    """Return a policy file as a function for `rollout`, with S = 1."""
    return lambda observation: policy.act(observation[0])[None]


def beside_optimum(policy: Policy, task: Any, start: Array) -> tuple[Array, Array, Array, Array]:
    """Run a policy file and the optimum from starts (G, O).

    Returns: first observed number under the policy and under the optimum, from the start on, (K + 1, G) each; action
      values of the policy and of the optimum, (K, G) each.
    """
    runs = rollout(each(policy), task, start[None]), task.best(start)
    ours, theirs = (np.concatenate([start[:, 0][None], run.state[:, 0]]) for run in runs)
    return ours, theirs, *(task.actions[run.action[:, 0]] for run in runs)


def rollout(act: Act, task: Evaluated, start: Array) -> Rollout:
    """Run S policies without noise from G starts. Args: act: the policies. start: first observations, (S, G, O)."""
    shape = (task.steps, *start.shape[:-1])
    run = Rollout(np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.intp))
    observation = start
    for k in range(task.steps):
        run.action[k] = act(observation)
        observation, run.error[k] = task.advance(observation, run.action[k])
        run.state[k] = observation[..., 0]
    return run


class Evaluation:
    """Scorer of policies on one grid, against the optimum of the same model, actions, starts and steps.

    J = mean over the grid of the sum over the steps of error^2 after each step (without the error at the start).
    regret_pct = 100 (J / J* - 1). The steady error of a setpoint is the median of |error| over its starts and the last
    `steady_steps` steps. A start does not count if the optimum is not at rest by then: its largest error in these steps
    exceeds `arrived` and that of the best start of this setpoint. E.g. a slow pump cannot dilute 1.1 to 0.2 in time.
    Args: task: task to score. start: observations at the start, (G, O).
    """

    def __init__(self, task: Evaluated, start: Array) -> None:
        self.task, self.start = task, start
        run = task.best(start)
        furthest = np.abs(run.error[-task.steady_steps :, 0]).max(axis=0)
        asked = task.asked(start)
        at = [asked == s for s in np.unique(asked)]
        self._resting = [here & (furthest <= max(task.arrived, furthest[here].min())) for here in at]
        self.optimum_cost = float(self._cost(run)[0])
        self.optimum_steady = float(self._steady(run)[0].max())
        self.optimum_abs_error = float(np.abs(run.error).mean())

    def _cost(self, run: Rollout) -> Array:
        return np.asarray(np.square(run.error).sum(axis=0).mean(axis=-1))

    def _steady(self, run: Rollout) -> Array:
        last = np.abs(run.error[-self.task.steady_steps :])
        return np.stack([np.median(last[..., there], axis=(0, 2)) for there in self._resting], axis=-1)

    def __call__(self, act: Act, agents: int = 1) -> Score:
        run = rollout(act, self.task, np.broadcast_to(self.start, (agents, *self.start.shape)))
        cost = self._cost(run)
        regret = 100.0 * (cost / self.optimum_cost - 1.0)
        return Score(cost, regret, self._steady(run), np.abs(run.error).mean(axis=(0, 2)))
