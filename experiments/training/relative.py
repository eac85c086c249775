"""Relative task of a training run: the policy chooses a fraction of full pump from error and growth share."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import Relabel, ShiftRelabel
from dqn.policy import RELATIVE, Policy
from envs.optimum import solve_relative
from envs.relative import RelativeConfig, RelativeVectorEnv, nearest_level, relative_reward
from experiments.reporting import charts
from experiments.training.evaluation import Array, Rollout, beside_optimum, pairs


class Relative:
    """The relative task; `Task` describes the arguments and errors of every method."""

    observation: tuple[str, ...] = RELATIVE
    unit = "periods of full pump"
    arrived = 0.1  # periods of full pump
    provable = True
    regret_unit, steady_unit = 0.01, 0.1
    """The steady error, half the spacing of the levels, hardly differs between policies; the regret does."""

    steps, steady_steps = 100, 30
    scalars: Mapping[str, float] = {}
    tried = "controller=dqn policy={}"

    def __init__(self, config: RelativeConfig) -> None:
        self.config = config
        self.episode_steps = config.episode_steps
        self.description = "growth takes {:g} to {:g} of the largest pump rate".format(*config.growth_shares)
        self.actions = config.levels()
        # Larger errors than in training are shown to the policy as the largest one: full pump or none is right there.
        span = config.largest_error - 0.05
        low, high = config.growth_shares
        self.limits = (np.array([-span, low]), np.array([span, high]))

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> RelativeVectorEnv:
        return RelativeVectorEnv.seeded(self.config, seeds)

    def hindsight(self, agent: DQNConfig) -> Relabel:
        return ShiftRelabel(agent, self.config.largest_error, relative_reward)

    def selection_grid(self) -> Array:
        """Return every pair of 20 errors and 25 growth shares, (G, 2)."""
        return self._grid(20, 25, 0.3)

    def report_grid(self) -> Array:
        """Return every pair of 41 errors and 48 growth shares, (G, 2)."""
        return self._grid(41, 48, 0.5)

    def _grid(self, errors: int, shares: int, place: float) -> Array:
        """Return a point in each cell of a grid, at the fraction `place` of the cell. Two grids then share no point."""
        (low, high), span = self.config.growth_shares, self.config.largest_error
        e = span * (2.0 * (np.arange(errors) + place) / errors - 1.0)
        return pairs(e, low + (high - low) * (np.arange(shares) + place) / shares)

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Advance the error, e <- e + s - v with growth share s and pump level v; return the observation and e."""
        s = observation[..., 1]
        error = observation[..., 0] + s - self.actions[action]
        return np.stack([error, s], axis=-1), error

    def asked(self, start: Array) -> Array:
        return start[:, 1]

    def best(self, start: Array) -> Rollout:
        error, action = np.empty((self.steps, 1, len(start))), np.empty((self.steps, 1, len(start)), dtype=np.intp)
        for s in np.unique(start[:, 1]):
            here = start[:, 1] == s
            optimum = _optimum(self.config, float(s), self.steps)
            error[:, 0, here], action[:, 0, here] = optimum.rollout(start[here, 0])
        return Rollout(error, error, action)

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Return the index of the pump level nearest to e + s."""
        return nearest_level(observation[..., 0], observation[..., 1], self.actions.size)

    def model(self) -> dict[str, Any]:
        """Return the config of the training, with its range of growth shares."""
        return {"model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Draw the pump level over error and growth share, and the error over time."""
        (low, high), span = self.config.growth_shares, self.config.largest_error
        error, share = np.linspace(-span, span, 241), np.linspace(low, high, 97)
        e, s = (a.ravel() for a in np.meshgrid(error, share))
        learned = policy.chosen(np.stack([e, s], axis=1)).reshape(share.size, error.size)
        best = np.stack([_optimum(self.config, float(x), self.steps).act(error, self.steps) for x in share])
        shares = np.array([0.1, 0.5, 0.9])
        start = pairs(np.array([-span, span]), shares)
        ours, theirs, *levels = beside_optimum(policy, self, start)
        return {
            "policy_map": charts.relative_map(error, share, learned, self.actions[best]),
            "trajectories": charts.relative_trajectories(ours, theirs, start[:, 1], *levels),
        }


_optimum = lru_cache(maxsize=256)(solve_relative)
