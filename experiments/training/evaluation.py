"""How good a policy is on the training model: noise-free rollouts on a grid, compared with the optimum."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.optimum import solve_episode
from envs.task import MAX_OD, SCORED_OD, EnvConfig, step_factors

__all__ = ["Evaluation", "Rollout", "Score", "best_rollout", "report_grid", "rollout", "selection_grid"]

Array = NDArray[np.float64]
Act = Callable[[Array, Array], NDArray[np.intp]]
"""(od (S, G), setpoint (S, G)) -> action indices (S, G)."""

STEADY_STEPS = 30  # the last steps of an evaluation rollout, over which the steady error is taken
ARRIVED = 0.01  # OD, within which the optimum counts as at rest


@dataclass(frozen=True, eq=False)
class Rollout:
    """od: after each step, shape (K, S, G); action: taken in each step, (K, S, G)."""

    od: Array
    action: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Score:
    """Per agent, shape (S,): cost J, regret in per cent of the optimum's, steady |x - setpoint| at the worst setpoint.

    steady_by_setpoint: the same at each setpoint, shape (S, M).
    """

    cost: Array
    regret_pct: Array
    steady_by_setpoint: Array

    @property
    def steady_abs_error(self) -> Array:
        """Largest over the setpoints, shape (S,): an offset at one of them is an offset that a lab sees."""
        return np.asarray(self.steady_by_setpoint.max(axis=-1))


def report_grid(config: EnvConfig) -> tuple[Array, Array]:
    """Start OD and setpoint of the reported grid: linspace(0.1, 1.1, 41) x setpoints, each of shape (G,)."""
    return _grid(np.linspace(*SCORED_OD, 41), config)


def selection_grid(config: EnvConfig) -> tuple[Array, Array]:
    """The grid on which policies are compared during training; shares no point with `report_grid`."""
    return _grid(np.linspace(0.1125, 1.0875, 20), config)


def _grid(starts: Array, config: EnvConfig) -> tuple[Array, Array]:
    od, setpoint = np.meshgrid(starts, np.unique(config.setpoints), indexing="ij")
    return od.ravel(), setpoint.ravel()


def rollout(act: Act, factors: Array, od: Array, setpoint: Array, steps: int) -> Rollout:
    """Noise-free closed loop x <- factors[a] x of S policies from G starts.

    Args: act: the policies. factors: of `step_factors`, shape (A,). od, setpoint: starts, shape (S, G). steps: K.
    """
    ods = np.empty((steps, *od.shape))
    actions = np.empty((steps, *od.shape), dtype=np.intp)
    for k in range(steps):
        actions[k] = act(od, setpoint)
        ods[k] = od = np.minimum(od * factors[actions[k]], MAX_OD)
    return Rollout(ods, actions)


def best_rollout(config: EnvConfig, od: Array, setpoint: Array) -> Rollout:
    """The optimum of each episode from starts of shape (G,), as the only policy (S = 1) of a rollout."""
    shape = (config.episode_steps, 1, od.size)
    best = Rollout(np.empty(shape), np.empty(shape, dtype=np.intp))
    for s in np.unique(setpoint):
        here = setpoint == s
        best.od[:, 0, here], best.action[:, 0, here] = solve_episode(config, float(s)).rollout(od[here])
    return best


class Evaluation:
    """Scores policies on one grid against the optimum of the same model, actions, starts and number of steps.

    J = mean over the grid of sum over the steps of (x - setpoint)^2 taken after each step (the start's own error is
    not counted); regret_pct = 100 (J / J* - 1); steady_abs_error = the largest over the setpoints of the median over
    starts and last 30 steps of |x - setpoint|. Starts are left out from which the optimum is still on its way then,
    further than 0.01 OD (and than from the best start) from the setpoint: a slow pump does not thin 1.1 to 0.2 in time.

    Args: config: the task. grid: start OD and setpoint, each (G,).
    """

    def __init__(self, config: EnvConfig, grid: tuple[Array, Array]) -> None:
        self.od, self.setpoint = grid
        self.steps = config.episode_steps
        self.factors = step_factors(config)
        run = best_rollout(config, self.od, self.setpoint)
        furthest = np.abs(run.od[-STEADY_STEPS:, 0] - self.setpoint).max(axis=0)
        at = [self.setpoint == s for s in np.unique(self.setpoint)]
        self._resting = [here & (furthest <= max(ARRIVED, furthest[here].min())) for here in at]
        self.optimum_cost = float(self._cost(run)[0])
        self.optimum_steady = float(self._steady(run)[0].max())

    def _cost(self, run: Rollout) -> Array:
        return np.asarray(np.square(run.od - self.setpoint).sum(axis=0).mean(axis=-1))

    def _steady(self, run: Rollout) -> Array:
        """Median of each setpoint, shape (S, M)."""
        last = np.abs(run.od[-STEADY_STEPS:] - self.setpoint)
        return np.stack([np.median(last[..., there], axis=(0, 2)) for there in self._resting], axis=-1)

    def __call__(self, act: Act, agents: int = 1) -> Score:
        """Score S = `agents` policies."""
        shape = (agents, self.od.size)
        run = rollout(
            act, self.factors, np.broadcast_to(self.od, shape), np.broadcast_to(self.setpoint, shape), self.steps
        )
        cost = self._cost(run)
        return Score(cost, 100.0 * (cost / self.optimum_cost - 1.0), self._steady(run))
