"""The paper's task for a training run: from OD and setpoint to a pump rate, on a model with known mu and tau."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import GoalRelabel, Relabel
from dqn.policy import ABSOLUTE, Policy
from envs.optimum import solve_episode
from envs.task import MAX_OD, SCORED_OD, EnvConfig, step_factors, tracking_reward
from envs.vector_env import BioreactorVectorEnv
from experiments.reporting import charts
from experiments.training.evaluation import Rollout, each, pairs, rollout

__all__ = ["DensityTask", "first_actions"]

Array = NDArray[np.float64]
COARSE = 2e-3  # of log OD, for a figure


class DensityTask:
    """The task of density control; `Task` describes arguments and errors of every method."""

    observation: tuple[str, ...] = ABSOLUTE
    unit = "OD"
    arrived = 0.01  # OD
    provable = True
    steady_steps = 30
    regret_unit, steady_unit = 0.5, 0.003
    """Half a per cent of cost is invisible in a recording, and 0.003 OD is the noise of the sensor."""
    tried = "controller=dqn policy={}"

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.steps = self.episode_steps = config.episode_steps
        self.description = f"mu {config.mu:g} 1/min, tau {config.tau:.4g}, a decision every {config.control_min:g} min"
        self.scalars: Mapping[str, float] = {"mu": float(config.mu), "tau": float(config.tau)}
        self.actions = config.pump_rates()
        self.limits = (np.full(2, -np.inf), np.full(2, np.inf))
        self._factors = step_factors(config)

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> BioreactorVectorEnv:
        """Return the environments."""
        env = BioreactorVectorEnv(len(seeds), self.config)
        env.seed_streams(seeds)
        return env

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """Return the relabelling of replayed transitions with setpoints of the task."""
        setpoints = self.config.setpoints
        return GoalRelabel(agent, (min(setpoints), max(setpoints)), tracking_reward)

    def selection_grid(self) -> Array:
        """Return 20 start ODs x setpoints."""
        return self._grid(np.linspace(0.1125, 1.0875, 20))

    def report_grid(self) -> Array:
        """Return linspace(0.1, 1.1, 41) x setpoints."""
        return self._grid(np.linspace(*SCORED_OD, 41))

    def _grid(self, starts: Array) -> Array:
        return pairs(starts, np.unique(self.config.setpoints))

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Advance x <- f_a x; the error is x - setpoint."""
        setpoint = observation[..., 1]
        od = np.minimum(observation[..., 0] * self._factors[action], MAX_OD)
        return np.stack([od, setpoint], axis=-1), od - setpoint

    def asked(self, start: Array) -> Array:
        """Return the setpoint."""
        return start[:, 1]

    def best(self, start: Array) -> Rollout:
        """Solve by backward induction."""
        od, setpoint = start.T
        state, action = np.empty((self.steps, 1, len(start))), np.empty((self.steps, 1, len(start)), dtype=np.intp)
        for s in np.unique(setpoint):
            here = setpoint == s
            state[:, 0, here], action[:, 0, here] = _optimum(self.config, float(s)).rollout(od[here])
        return Rollout(state, state - setpoint, action)

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Return argmin_a |f_a x - s|."""
        after = observation[..., :1] * self._factors
        return np.asarray(np.abs(after - observation[..., 1:]).argmin(axis=-1))

    def model(self) -> dict[str, Any]:
        """Return the control period and the whole model."""
        return {"control_min": self.config.control_min, "model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Draw the pump rate over OD and setpoint, and the OD over time from both ends of the starts."""
        env = self.config
        od, setpoint = np.linspace(0.05, 1.25, 241), np.linspace(min(env.setpoints), max(env.setpoints), 33)
        x, s = (a.ravel() for a in np.meshgrid(od, setpoint))
        learned = policy.chosen(np.stack([x, s], axis=1)).reshape(setpoint.size, od.size)
        best = self.actions[first_actions(env, x, s)].reshape(learned.shape)
        goals = np.asarray(env.setpoints)[[0, len(env.setpoints) // 2, -1]]
        start = pairs(np.array(env.start_od), goals)
        ours, theirs = rollout(each(policy), self, start[None]), self.best(start)
        return {
            "policy_map": charts.policy_map(od, setpoint, learned, best),
            "trajectories": charts.trajectories(
                np.arange(env.episode_steps + 1, dtype=np.float64) * env.control_min,
                np.concatenate([start[:, 0][None], ours.state[:, 0]]),
                np.concatenate([start[:, 0][None], theirs.state[:, 0]]),
                start[:, 1],
                self.actions[ours.action[:, 0]],
                self.actions[theirs.action[:, 0]],
            ),
        }


def first_actions(env: EnvConfig, od: Array, setpoint: Array) -> NDArray[np.intp]:
    """Return the optimum's first action of an episode from each OD towards each setpoint, (G,), (G,) -> (G,).

    The model is linear in x, so the best action depends only on x / setpoint, and one solution is enough.
    """
    lowest = float(setpoint.min())
    scaled = od * lowest / setpoint
    wide = replace(env, start_od=(float(scaled.min()), float(scaled.max())))
    return solve_episode(wide, lowest, COARSE).act(scaled, env.episode_steps)


_optimum = lru_cache(maxsize=16)(solve_episode)  # all grids of a run have the same setpoints
