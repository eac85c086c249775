"""The best possible controller of the training model, by dynamic programming: the yardstick of every learned one.

For each setpoint s the discounted problem V(x) = min_a [(f_a x - s)^2 + gamma V(f_a x)] is solved on a fine grid of
log x by policy iteration (Howard 1960): on that grid an action is a shift by log f_a, so evaluating a policy is one
sparse linear system. V is linear between grid points.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import spsolve

from envs.task import EnvConfig, step_factors

__all__ = ["OptimalPolicy", "solve"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OptimalPolicy:
    """Greedy policy with respect to the optimal value function.

    log_od: uniform grid of log OD, shape (G,). setpoints: shape (M,), sorted.
    value: discounted cost-to-go V, shape (M, G). factors: x(t+1) = factors[a] x(t), shape (A,).
    gamma: discount per step.
    """

    log_od: Array
    setpoints: Array
    value: Array
    factors: Array
    gamma: float

    def cost_to_go(self, od: Array, row: NDArray[np.intp]) -> Array:
        """V(od) of the setpoint with index `row`; `od` and `row` broadcast to one shape, which is returned."""
        spacing = self.log_od[1] - self.log_od[0]
        position = np.clip((np.log(od) - self.log_od[0]) / spacing, 0.0, self.log_od.size - 1.000001)
        left = position.astype(np.intp)
        weight = position - left
        return np.asarray((1.0 - weight) * self.value[row, left] + weight * self.value[row, left + 1])

    def act(self, od: Array, setpoint: Array) -> NDArray[np.intp]:
        """Index of the best action by one exact look-ahead from `od`.

        Args: od: shape (N,), > 0; setpoint: shape (N,), each one of `setpoints`.
        Raises: ValueError for a setpoint the policy was not solved for.
        """
        row = np.searchsorted(self.setpoints, setpoint - 1e-9)
        row = np.minimum(row, self.setpoints.size - 1)
        unknown = np.abs(self.setpoints[row] - setpoint) > 1e-6
        if unknown.any():
            raise ValueError(
                f"setpoint {float(np.asarray(setpoint)[unknown][0])}: the optimum was solved for "
                f"{self.setpoints.tolist()}; solve it for this setpoint too"
            )
        after = np.maximum(od, 1e-6)[:, None] * self.factors
        cost = (after - setpoint[:, None]) ** 2 + self.gamma * self.cost_to_go(after, row[:, None])
        return np.asarray(np.argmin(cost, axis=1), dtype=np.intp)


def _solve_one(
    setpoint: float, od: Array, left: NDArray[np.intp], weight: Array, factors: Array, gamma: float
) -> Array:
    """V of one setpoint on the grid `od`; action a moves grid point g to between left[g, a] and left[g, a] + 1."""
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
    """Solve the task for every setpoint.

    Args:
      config: the task; its 17 actions and its integrator are used as they are.
      gamma: discount per control step. setpoints: OD values, shape (M,); None takes the config's.
      grid: number of points of log OD between a third of the lowest and twice the highest OD that can matter.
    Returns: the optimal policy. Raises: nothing beyond NumPy's own for absurd sizes.
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
