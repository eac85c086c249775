"""Score of a policy on its task: noise-free rollouts on a grid, compared with the optimum."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dqn.policy import Policy

Array = NDArray[np.float64]
Act = Callable[[Array], NDArray[np.intp]]
"""Observations (S, G, O) -> action indices (S, G)."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """Values of each step, shape (K, S, G): `action`, and after it `state` (the first observation) and `error`."""

    state: Array
    error: Array
    action: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Score:
    """Per agent, shape (S,): cost J, regret in per cent of the optimum's, steady error at the worst setpoint.

    steady_by_setpoint: the same at each setpoint (value of `asked`), shape (S, M).
    mean_abs_error: over all steps and starts, shape (S,).
    """

    cost: Array
    regret_pct: Array
    steady_by_setpoint: Array
    mean_abs_error: Array

    @property
    def steady_abs_error(self) -> Array:
        """Largest steady error over the setpoints, shape (S,): a lab sees an offset at a single setpoint."""
        return np.asarray(self.steady_by_setpoint.max(axis=-1))


class Evaluated(Protocol):
    """Task as an evaluation needs it.

    steps: of a rollout; steady_steps: last steps, used for the steady error. arrived: error below which the optimum is
    at rest.
    """

    steps: int
    steady_steps: int
    arrived: float

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Return the observation after one step, (..., O), and the error whose square is its cost, (...)."""

    def asked(self, start: Array) -> Array:
        """Return the value by which steady errors are grouped, e.g. the setpoint, (G,), for starts (G, O)."""

    def best(self, start: Array) -> Rollout:
        """Solve each episode from starts (G, O); the optimum is the only policy (S = 1) of the rollout."""


def pairs(first: Array, second: Array) -> Array:
    """Return every pair of two lists of numbers, the first slowest, (A B, 2)."""
    return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)


def each(policy: Policy) -> Act:
    """Use a policy file as the only policy (S = 1) of a rollout."""
    return lambda observation: policy.act(observation[0])[None]


def beside_optimum(policy: Policy, task: Any, start: Array) -> tuple[Array, Array, Array, Array]:
    """Run a policy file and the optimum from starts (G, O).

    Returns: the first number observed, with the start, (K + 1, G), and the value of the action, (K, G), of both each.
    """
    runs = rollout(each(policy), task, start[None]), task.best(start)
    ours, theirs = (np.concatenate([start[:, 0][None], run.state[:, 0]]) for run in runs)
    return ours, theirs, *(task.actions[run.action[:, 0]] for run in runs)


def rollout(act: Act, task: Evaluated, start: Array) -> Rollout:
    """Run the noise-free closed loop of S policies from G starts. Args: act: the policies. start: (S, G, O)."""
    shape = (task.steps, *start.shape[:-1])
    run = Rollout(np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.intp))
    observation = start
    for k in range(task.steps):
        run.action[k] = act(observation)
        observation, run.error[k] = task.advance(observation, run.action[k])
        run.state[k] = observation[..., 0]
    return run


class Evaluation:
    """Score of policies on one grid against the optimum of the same model, actions, starts and steps.

    J = mean over the grid of sum over the steps of error^2 taken after each step (without the error of the start);
    regret_pct = 100 (J / J* - 1); steady_abs_error = the largest over the setpoints of the median over starts and last
    `steady_steps` of |error|. A start is ignored if the optimum has not arrived by then: its error exceeds `arrived`
    and that from the best start. E.g. a slow pump does not dilute 1.1 to 0.2 in time.

    Args: task: to score. start: observations at the start, (G, O).
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
