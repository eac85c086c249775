"""How good a policy is on the training model: noise-free rollouts on a grid, compared with the optimum."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.optimum import solve
from envs.task import EnvConfig, step_factors

__all__ = ["Evaluation", "Rollout", "Score", "report_grid", "rollout", "selection_grid"]

Array = NDArray[np.float64]
Act = Callable[[Array, Array], NDArray[np.intp]]
"""(od (S, G), setpoint (S, G)) -> action indices (S, G)."""

STEADY_STEPS = 30  # the last steps of an evaluation rollout, over which the steady error is taken


@dataclass(frozen=True, eq=False)
class Rollout:
    """od: after each step, shape (K, S, G); action: taken in each step, (K, S, G)."""

    od: Array
    action: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Score:
    """Per agent, shape (S,): cost J, regret in per cent of the optimum's, median steady |x - setpoint|."""

    cost: Array
    regret_pct: Array
    steady_abs_error: Array


def report_grid(config: EnvConfig) -> tuple[Array, Array]:
    """Start OD and setpoint of the reported grid: linspace(0.1, 1.1, 41) x setpoints, each of shape (G,)."""
    return _grid(np.linspace(0.1, 1.1, 41), config)


def selection_grid(config: EnvConfig) -> tuple[Array, Array]:
    """The grid on which policies are compared during training; shares no point with `report_grid`."""
    return _grid(np.linspace(0.1125, 1.0875, 20), config)


def _grid(starts: Array, config: EnvConfig) -> tuple[Array, Array]:
    od, setpoint = np.meshgrid(starts, np.asarray(config.setpoints), indexing="ij")
    return od.ravel(), setpoint.ravel()


def rollout(act: Act, factors: Array, od: Array, setpoint: Array, steps: int) -> Rollout:
    """Noise-free closed loop x <- factors[a] x of S policies from G starts.

    Args: act: the policies. factors: of `step_factors`, shape (A,). od, setpoint: starts, shape (S, G). steps: K.
    """
    ods = np.empty((steps, *od.shape))
    actions = np.empty((steps, *od.shape), dtype=np.intp)
    for k in range(steps):
        actions[k] = act(od, setpoint)
        od = od * factors[actions[k]]
        ods[k] = od
    return Rollout(ods, actions)


class Evaluation:
    """Scores policies on one grid against the optimum of the same model, actions and discount.

    J = mean over the grid of sum over the steps of (x - setpoint)^2 taken after each step (the start's own error is
    not counted); regret_pct = 100 (J / J* - 1); steady_abs_error = median over grid and last 30 steps of
    |x - setpoint|.

    Args: config: the task. gamma: discount of the optimum. grid: start OD and setpoint, each (G,).
    """

    def __init__(self, config: EnvConfig, gamma: float, grid: tuple[Array, Array]) -> None:
        self.od, self.setpoint = grid
        self.steps = config.episode_steps
        self.factors = step_factors(config)
        best = solve(config, gamma)
        run = rollout(
            lambda x, s: best.act(x[0], s[0])[None], self.factors, self.od[None], self.setpoint[None], self.steps
        )
        self.optimum_cost = float(self._cost(run)[0])
        self.optimum_steady = float(self._steady(run)[0])

    def _cost(self, run: Rollout) -> Array:
        return np.asarray(np.square(run.od - self.setpoint).sum(axis=0).mean(axis=-1))

    def _steady(self, run: Rollout) -> Array:
        last = np.abs(run.od[-STEADY_STEPS:] - self.setpoint)
        return np.asarray(np.median(np.moveaxis(last, 1, 0).reshape(last.shape[1], -1), axis=-1))

    def __call__(self, act: Act, agents: int = 1) -> Score:
        """Score S = `agents` policies."""
        shape = (agents, self.od.size)
        run = rollout(
            act, self.factors, np.broadcast_to(self.od, shape), np.broadcast_to(self.setpoint, shape), self.steps
        )
        cost = self._cost(run)
        return Score(cost, 100.0 * (cost / self.optimum_cost - 1.0), self._steady(run))
