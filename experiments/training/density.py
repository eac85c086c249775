"""The paper's task for a training run: OD and setpoint in, a pump rate out, on a model with a known mu and tau."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import GoalRelabel, Relabel
from dqn.policy import ABSOLUTE, Policy
from envs.optimum import EpisodeOptimum, solve_episode
from envs.task import MAX_OD, SCORED_OD, EnvConfig, step_factors, tracking_reward
from envs.vector_env import BioreactorVectorEnv
from experiments.reporting import charts
from experiments.training.evaluation import Rollout, rollout

__all__ = ["Density", "first_actions"]

Array = NDArray[np.float64]
COARSE = 2e-3  # of log OD: enough for a picture


class Density:
    """See `Task`; arguments and errors of every method are described there."""

    observation = ABSOLUTE
    unit = "OD"
    arrived = 0.01  # OD
    regret_unit, steady_unit = 0.5, 0.003
    """Half a per cent of cost is not seen in a recording, and 0.003 OD is the noise of the sensor."""

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.steps = config.episode_steps
        self.actions = config.pump_rates()
        self.limits = (np.full(2, -np.inf), np.full(2, np.inf))
        self._factors = step_factors(config)

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> BioreactorVectorEnv:
        """Environments."""
        env = BioreactorVectorEnv(len(seeds), self.config)
        env.seed_streams(seeds)
        return env

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """Goals of replayed transitions: the task's range of setpoints and its reward."""
        setpoints = self.config.setpoints
        return GoalRelabel(agent, (min(setpoints), max(setpoints)), tracking_reward)

    def selection_grid(self) -> tuple[Array, Array]:
        """20 start ODs x setpoints."""
        return self._grid(np.linspace(0.1125, 1.0875, 20))

    def report_grid(self) -> tuple[Array, Array]:
        """linspace(0.1, 1.1, 41) x setpoints."""
        return self._grid(np.linspace(*SCORED_OD, 41))

    def _grid(self, starts: Array) -> tuple[Array, Array]:
        od, setpoint = np.meshgrid(starts, np.unique(self.config.setpoints), indexing="ij")
        return od.ravel(), setpoint.ravel()

    def advance(self, state: Array, second: Array, action: NDArray[Any]) -> Array:
        """x <- f_a x."""
        return np.asarray(np.minimum(state * self._factors[action], MAX_OD))

    def error(self, state: Array, second: Array) -> Array:
        """x - setpoint."""
        return state - second

    def best(self, first: Array, second: Array) -> Rollout:
        """By backward induction."""
        shape = (self.steps, 1, first.size)
        best = Rollout(np.empty(shape), np.empty(shape, dtype=np.intp))
        for s in np.unique(second):
            here = second == s
            best.state[:, 0, here], best.action[:, 0, here] = _optimum(self.config, float(s)).rollout(first[here])
        return best

    def myopic(self, first: Array, second: Array) -> NDArray[np.intp]:
        """argmin_a |f_a x - s|."""
        return np.asarray(np.abs(first[..., None] * self._factors - second[..., None]).argmin(axis=-1))

    def model(self) -> dict[str, Any]:
        """Control period and the whole model."""
        return {"control_min": self.config.control_min, "model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Pump rate over OD and setpoint; OD over time from both ends of the starts."""
        env = self.config
        od, setpoint = np.linspace(0.05, 1.25, 241), np.linspace(min(env.setpoints), max(env.setpoints), 33)
        x, s = (a.ravel() for a in np.meshgrid(od, setpoint))
        learned = policy.chosen(np.stack([x, s], axis=1)).reshape(setpoint.size, od.size)
        best = self.actions[first_actions(env, x, s)].reshape(learned.shape)
        goals = np.asarray(env.setpoints)[[0, len(env.setpoints) // 2, -1]]
        starts, targets = np.repeat(env.start_od, goals.size)[None], np.tile(goals, 2)[None]
        ours = rollout(lambda a, b: policy.act(np.stack([a[0], b[0]], axis=1))[None], self, starts, targets)
        theirs = self.best(starts[0], targets[0])
        return {
            "policy_map": charts.policy_map(od, setpoint, learned, best),
            "trajectories": charts.trajectories(
                np.arange(env.episode_steps + 1, dtype=np.float64) * env.control_min,
                np.concatenate([starts, ours.state[:, 0]]),
                np.concatenate([starts, theirs.state[:, 0]]),
                targets[0],
                self.actions[ours.action[:, 0]],
                self.actions[theirs.action[:, 0]],
            ),
        }


def first_actions(env: EnvConfig, od: Array, setpoint: Array) -> NDArray[np.intp]:
    """The optimum's first action of an episode from each OD towards each setpoint, (G,), (G,) -> (G,).

    The model is linear in x, so that the best action depends on x / setpoint alone, and one solution serves all.
    """
    lowest = float(setpoint.min())
    scaled = od * lowest / setpoint
    wide = replace(env, start_od=(float(scaled.min()), float(scaled.max())))
    return solve_episode(wide, lowest, COARSE).act(scaled, env.episode_steps)


@lru_cache(maxsize=16)  # the grids of a run have the same setpoints
def _optimum(config: EnvConfig, setpoint: float) -> EpisodeOptimum:
    return solve_episode(config, setpoint)
