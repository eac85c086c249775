"""Optimal controllers of the training model by dynamic programming, the reference for every learned policy.

On a fine grid of log x, action a is a shift by log f_a, and V is linear between grid points. The two problems:

- `solve_episode`: the scored problem, V_k(x) = min_a [(f_a x - s)^2 + V_{k-1}(f_a x)] with V_0 = 0. V_k is the least
sum of squared errors over the remaining k steps. Backward induction (Bellman 1957) needs k sweeps over the grid.
- `solve`: the discounted problem without an end, V(x) = min_a [(f_a x - s)^2 + gamma V(f_a x)]. Networks learn these
values. Policy iteration (Howard 1960) solves one sparse linear system for each policy.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from envs.integrators import Array
from envs.relative import RelativeConfig
from envs.task import MAX_OD, SCORED_OD, EnvConfig, step_factors

SPACING = 4.7e-4  # grid spacing of log OD: eight points per action of the nominal model


@dataclass(frozen=True, eq=False)
class EpisodeOptimum:
    """Optimal controller of an episode of K steps whose targets are all known in advance.

    target: target of each step, (K,). grid: uniform grid, (G,). value: V_k, (K + 1, G): the smallest sum of squared
    distances from the targets over the last k steps, each taken after the step.
    after: function of states (N,) -> states after each action, (N, A). place: states -> their coordinates on the grid.
    """

    target: Array
    grid: Array
    value: Array
    after: Callable[[Array], Array]
    place: Callable[[Array], Array]

    def act(self, state: Array, left: int) -> NDArray[np.intp]:
        """Return the best action with `left` steps remaining, 1 <= left <= K, by an exact one-step lookahead, (N,)."""
        after = self.after(state)
        ahead = np.interp(self.place(after), self.grid, self.value[left - 1])
        return np.asarray(np.argmin((after - self.target[-left]) ** 2 + ahead, axis=1), dtype=np.intp)

    def rollout(self, state: Array) -> tuple[Array, NDArray[np.intp]]:
        """Run K steps from the states (N,); return the state after each step and the action, each (K, N)."""
        shape, rows = (self.target.size, state.size), np.arange(state.size)
        states, actions = np.empty(shape), np.empty(shape, dtype=np.intp)
        for k in range(self.target.size):
            actions[k] = self.act(state, self.target.size - k)
            states[k] = state = self.after(state)[rows, actions[k]]
        return states, actions


def solve_episode(config: EnvConfig, setpoint: float | Array, spacing: float = SPACING) -> EpisodeOptimum:
    """Solve an episode for its smallest undiscounted cost; states are ODs.

    Args: config: the task, its actions and integrator. setpoint: OD, one for all `config.episode_steps` steps or one
      per step, (K,). spacing: grid spacing of log OD.
    """
    factors, program = step_factors(config), np.broadcast_to(setpoint, config.episode_steps)
    log_od = _reach(config, program, factors, spacing)
    shift = np.log(np.maximum(factors, 1e-12)) / (log_od[1] - log_od[0])
    after = np.minimum(np.exp(log_od) * factors[:, None], MAX_OD)
    value = _backward([(after - s) ** 2 for s in program[::-1]], shift)
    return EpisodeOptimum(
        program, log_od, value, lambda od: np.minimum(np.maximum(od, 1e-6)[:, None] * factors, MAX_OD),
        lambda od: np.log(np.maximum(od, 1e-12)),
    )  # fmt: skip


def _backward(stages: Sequence[Array], shift: Array) -> Array:
    """Compute V_k = min_a [stage_k,a + V_{k-1} shifted by shift_a] with V_0 = 0, shape (K + 1, G).

    Args: stages: cost of each step from each grid point, the last step first, each (A, G). shift: shift by each
      action, in grid points, (A,).
    """
    points = stages[0].shape[1]
    whole = np.floor(shift)
    part = (shift - whole)[:, None]
    whole = np.clip(whole, -points, points).astype(np.intp)
    pad = int(np.abs(whole).max()) + 1  # V is constant beyond the grid
    value = np.zeros((len(stages) + 1, points))
    for (before, now), stage in zip(pairwise(value), stages, strict=True):
        ahead = np.pad(before, pad, mode="edge")
        now[:] = np.inf
        for i, w, cost in zip(pad + whole, part, stage, strict=True):
            reached = (1.0 - w) * ahead[i : i + points] + w * ahead[i + 1 : i + 1 + points]
            np.minimum(now, cost + reached, out=now)
    return value


def solve_relative(config: RelativeConfig, growth_share: float, steps: int, spacing: float = 1 / 256) -> EpisodeOptimum:
    """Minimise the sum of e^2 over `steps` steps at one growth share; states are errors e on a grid of `spacing`."""
    levels = config.levels()
    reach = config.largest_error + 1.0
    error = np.linspace(-reach, reach, round(2.0 * reach / spacing) + 1)
    moved = growth_share - levels
    value = _backward([(error + moved[:, None]) ** 2] * steps, moved / (error[1] - error[0]))
    return EpisodeOptimum(np.zeros(steps), error, value, lambda e: e[:, None] + growth_share - levels, np.asarray)


def _reach(config: EnvConfig, program: Array, factors: Array, spacing: float) -> Array:
    """Return a grid of log OD, shape (G,), that covers every optimal episode from the scored starts.

    If growth exceeds the dilution at the largest pump rate, the OD rises up to the limit of the environment.
    """
    low = min(config.start_od[0], SCORED_OD[0], program.min()) * 0.8
    outgrown = config.episode_steps * max(0.0, np.log(np.maximum(factors, 1e-12)).min())
    high = np.log(max(config.start_od[1], SCORED_OD[1], program.max()) * 1.25) + outgrown
    high = min(high, np.log(MAX_OD))
    return np.linspace(np.log(low), high, int((high - np.log(low)) / spacing) + 2)


@dataclass(frozen=True, eq=False)
class OptimalPolicy:
    """Greedy policy with respect to the optimal value function of the discounted problem.

    log_od: uniform grid of log OD, (G,). setpoints: solved setpoints, sorted, (M,). value: discounted cost-to-go V,
    (M, G). factors: x(t+1) = factors[a] x(t), (A,). gamma: discount factor per step.
    """

    log_od: Array
    setpoints: Array
    value: Array
    factors: Array
    gamma: float

    def cost_to_go(self, od: Array, row: NDArray[np.intp]) -> Array:
        """Return V(od) for the setpoint with index `row`; `od` and `row` broadcast."""
        spacing = self.log_od[1] - self.log_od[0]
        position = np.clip((np.log(od) - self.log_od[0]) / spacing, 0.0, self.log_od.size - 1.000001)
        left = position.astype(np.intp)
        weight = position - left
        return np.asarray((1.0 - weight) * self.value[row, left] + weight * self.value[row, left + 1])

    def act(self, od: Array, setpoint: Array) -> NDArray[np.intp]:
        """Return the best action at `od` by an exact one-step lookahead.

        Args: od: shape (N,), > 0; setpoint: shape (N,), each contained in `setpoints`.
        Raises: ValueError for a setpoint that is not in `setpoints`.
        """
        row = np.searchsorted(self.setpoints, setpoint - 1e-9)
        row = np.minimum(row, self.setpoints.size - 1)
        unknown = np.abs(self.setpoints[row] - setpoint) > 1e-6
        if unknown.any():
            raise ValueError(
                f"setpoint {float(np.asarray(setpoint)[unknown][0])}: the optimum was solved for "
                f"{self.setpoints.tolist()}; solve for this setpoint too"
            )
        after = np.maximum(od, 1e-6)[:, None] * self.factors
        cost = (after - setpoint[:, None]) ** 2 + self.gamma * self.cost_to_go(after, row[:, None])
        return np.asarray(np.argmin(cost, axis=1), dtype=np.intp)


def _solve_one(
    setpoint: float, od: Array, left: NDArray[np.intp], weight: Array, factors: Array, gamma: float
) -> Array:
    """Return V of one setpoint on the grid `od`; action a leads from point g to the point left[g, a] + weight[g, a]."""
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import spsolve

    n = od.size
    rows = np.arange(n)
    stage = (od[:, None] * factors - setpoint) ** 2
    policy = np.argmin(stage, axis=1)
    while True:
        columns = left[rows, policy]
        w = weight[rows, policy]
        transition = csr_array(
            (np.concatenate([1.0 - w, w]), (np.concatenate([rows, rows]), np.concatenate([columns, columns + 1]))),
            shape=(n, n),
        )
        value = np.asarray(spsolve((eye_array(n, format="csr") - gamma * transition).tocsc(), stage[rows, policy]))
        cost = stage + gamma * ((1.0 - weight) * value[left] + weight * value[left + 1])
        better = np.argmin(cost, axis=1)
        gain = cost[rows, policy] - cost[rows, better]
        if np.all(gain <= 1e-13):
            return value
        policy = np.where(gain > 1e-13, better, policy)


def solve(config: EnvConfig, gamma: float = 0.99, setpoints: Array | None = None, grid: int = 6001) -> OptimalPolicy:
    """Solve the discounted task without an end for every setpoint; return the optimal policy.

    Args:
      config: the task, its actions and integrator.
      gamma: discount factor per control step. setpoints: ODs, (M,); None: those of the config.
      grid: number of grid points of log OD, from 0.8 times the lowest to 1.25 times the highest start or setpoint.
    """
    targets = np.unique(np.asarray(config.setpoints if setpoints is None else setpoints, dtype=np.float64))
    low = min(config.start_od[0], targets[0]) * 0.8
    high = max(config.start_od[1], targets[-1]) * 1.25
    log_od = np.linspace(np.log(low), np.log(high), grid)
    factors = step_factors(config)
    spacing = log_od[1] - log_od[0]
    position = np.arange(grid)[:, None] + np.log(np.maximum(factors, 1e-12)) / spacing
    position = np.clip(position, 0.0, grid - 1.000001)
    left = position.astype(np.intp)
    od = np.exp(log_od)
    value = np.stack([_solve_one(float(s), od, left, position - left, factors, gamma) for s in targets])
    return OptimalPolicy(log_od, targets, value, factors, gamma)
