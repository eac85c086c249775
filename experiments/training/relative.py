"""The task in relative coordinates for a training run: error and growth share in, a share of the largest rate out."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import Relabel, ShiftRelabel
from dqn.policy import RELATIVE, Policy
from envs.optimum import RelativeOptimum, solve_relative
from envs.relative import RelativeConfig, RelativeVectorEnv, nearest_level, relative_reward
from experiments.reporting import charts
from experiments.training.evaluation import Rollout, rollout

__all__ = ["Relative"]

Array = NDArray[np.float64]


class Relative:
    """See `Task`; arguments and errors of every method are described there."""

    observation = RELATIVE
    unit = "periods of full pump"
    arrived = 0.1  # periods of full pump
    regret_unit, steady_unit = 0.01, 0.1
    """Its own steady error is half the spacing of the levels and hardly tells policies apart: regret does."""

    steps = 100

    def __init__(self, config: RelativeConfig) -> None:
        self.config = config
        self.actions = config.levels()
        # Beyond the largest error of training the policy sees that error: full pump or none is right there too.
        span = config.largest_error - 0.05
        low, high = config.growth_shares
        self.limits = (np.array([-span, low]), np.array([span, high]))

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> RelativeVectorEnv:
        """Environments."""
        env = RelativeVectorEnv(len(seeds), self.config)
        env.seed_streams(seeds)
        return env

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """Another setpoint shifts the error."""
        return ShiftRelabel(agent, self.config.largest_error, relative_reward)

    def selection_grid(self) -> tuple[Array, Array]:
        """20 errors x 25 growth shares."""
        return self._grid(20, 25, 0.3)

    def report_grid(self) -> tuple[Array, Array]:
        """41 errors x 48 growth shares."""
        return self._grid(41, 48, 0.5)

    def _grid(self, errors: int, shares: int, place: float) -> tuple[Array, Array]:
        """Midpoints (or other places) of equal cells, so that no two grids share a point."""
        (low, high), span = self.config.growth_shares, self.config.largest_error
        e = span * (2.0 * (np.arange(errors) + place) / errors - 1.0)
        s = low + (high - low) * (np.arange(shares) + place) / shares
        first, second = np.meshgrid(e, s, indexing="ij")
        return first.ravel(), second.ravel()

    def advance(self, state: Array, second: Array, action: NDArray[Any]) -> Array:
        """e <- e + s - v."""
        return np.asarray(state + second - self.actions[action])

    def error(self, state: Array, second: Array) -> Array:
        """e itself."""
        return state

    def best(self, first: Array, second: Array) -> Rollout:
        """By backward induction."""
        shape = (self.steps, 1, first.size)
        best = Rollout(np.empty(shape), np.empty(shape, dtype=np.intp))
        for s in np.unique(second):
            here = second == s
            optimum = _optimum(self.config, float(s), self.steps)
            best.state[:, 0, here], best.action[:, 0, here] = optimum.rollout(first[here])
        return best

    def myopic(self, first: Array, second: Array) -> NDArray[np.intp]:
        """The level nearest to e + s."""
        return nearest_level(first, second, self.actions.size)

    def model(self) -> dict[str, Any]:
        """The range of what it was trained on."""
        return {"model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Share of the largest pump rate over error and growth share; error over time."""
        (low, high), span = self.config.growth_shares, self.config.largest_error
        error, share = np.linspace(-span, span, 241), np.linspace(low, high, 97)
        e, s = (a.ravel() for a in np.meshgrid(error, share))
        learned = policy.chosen(np.stack([e, s], axis=1)).reshape(share.size, error.size)
        best = np.stack([_optimum(self.config, float(x), self.steps).act(error, self.steps) for x in share])
        shares = np.array([0.1, 0.5, 0.9])
        starts, given = np.repeat([-span, span], shares.size)[None], np.tile(shares, 2)[None]
        ours = rollout(lambda a, b: policy.act(np.stack([a[0], b[0]], axis=1))[None], self, starts, given)
        theirs = self.best(starts[0], given[0])
        return {
            "policy_map": charts.relative_map(error, share, learned, self.actions[best]),
            "trajectories": charts.relative_trajectories(
                np.concatenate([starts, ours.state[:, 0]]),
                np.concatenate([starts, theirs.state[:, 0]]),
                given[0],
                self.actions[ours.action[:, 0]],
                self.actions[theirs.action[:, 0]],
            ),
        }


@lru_cache(maxsize=256)
def _optimum(config: RelativeConfig, growth_share: float, steps: int) -> RelativeOptimum:
    return solve_relative(config, growth_share, steps)
