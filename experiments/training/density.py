"""Density tasks of a training run: the policy chooses a pump rate from OD and setpoint(s); mu and tau are known."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import GoalRelabel, ProgramRelabel, Relabel
from dqn.policy import ABSOLUTE, PREVIEW, Policy
from envs.optimum import solve_episode
from envs.preview import PreviewConfig, PreviewVectorEnv, passed, program_of
from envs.task import MAX_OD, SCORED_OD, EnvConfig, step_factors, tracking_reward
from envs.vector_env import BioreactorVectorEnv
from experiments.reporting import charts
from experiments.training.evaluation import Array, Rollout, beside_optimum, pairs

COARSE = 2e-3  # grid spacing of log OD for a figure


class DensityTask:
    """The paper's task of density control; `Task` describes the arguments and errors of every method."""

    observation: tuple[str, ...] = ABSOLUTE
    unit = "OD"
    arrived = 0.01  # OD
    provable = True
    steady_steps = 30
    regret_unit, steady_unit = 0.5, 0.003
    """Half a per cent of the cost is invisible in a recording, and 0.003 OD is the noise of the sensor."""
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
        return BioreactorVectorEnv.seeded(self.config, seeds)

    def hindsight(self, agent: DQNConfig) -> Relabel:
        setpoints = self.config.setpoints
        return GoalRelabel(agent, (min(setpoints), max(setpoints)), tracking_reward)

    def selection_grid(self) -> Array:
        """Return every pair of 20 start ODs and the setpoints, (G, 2)."""
        return self._grid(np.linspace(0.1125, 1.0875, 20))

    def report_grid(self) -> Array:
        """Return every pair of 41 start ODs from 0.1 to 1.1 and the setpoints, (G, 2)."""
        return self._grid(np.linspace(*SCORED_OD, 41))

    def _grid(self, starts: Array) -> Array:
        return pairs(starts, np.unique(self.config.setpoints))

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Advance the OD, x <- f_a x with the factor f_a of action a; return the observation and x - setpoint."""
        setpoint = observation[..., 1]
        od = np.minimum(observation[..., 0] * self._factors[action], MAX_OD)
        return np.stack([od, setpoint], axis=-1), od - setpoint

    def asked(self, start: Array) -> Array:
        return start[:, 1]

    def best(self, start: Array) -> Rollout:
        od, setpoint = start.T
        state, action = np.empty((self.steps, 1, len(start))), np.empty((self.steps, 1, len(start)), dtype=np.intp)
        for s in np.unique(setpoint):
            here = setpoint == s
            state[:, 0, here], action[:, 0, here] = _optimum(self.config, float(s)).rollout(od[here])
        return Rollout(state, state - setpoint, action)

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Return the action a that minimises |f_a x - setpoint|, with the OD factor f_a of one step."""
        after = observation[..., :1] * self._factors
        return np.asarray(np.abs(after - observation[..., 1:]).argmin(axis=-1))

    def model(self) -> dict[str, Any]:
        """Return the control period and all values of the model."""
        return {"control_min": self.config.control_min, "model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Draw the pump rate over OD and setpoint, and the OD over time from the lowest and the highest start."""
        env = self.config
        od, setpoint = np.linspace(0.05, 1.25, 241), np.linspace(min(env.setpoints), max(env.setpoints), 33)
        x, s = (a.ravel() for a in np.meshgrid(od, setpoint))
        learned = policy.chosen(np.stack([x, s], axis=1)).reshape(setpoint.size, od.size)
        best = self.actions[first_actions(env, x, s)].reshape(learned.shape)
        goals = np.asarray(env.setpoints)[[0, len(env.setpoints) // 2, -1]]
        start = pairs(np.array(env.start_od), goals)
        return {"policy_map": charts.policy_map(od, setpoint, learned, best), **self._trajectories(policy, start)}

    def _trajectories(self, policy: Policy, start: Array) -> dict[str, Figure]:
        """Draw the OD over time under the policy and under the optimum, from the given starts."""
        minutes = np.arange(self.steps + 1, dtype=np.float64) * self.config.control_min
        ours, theirs, *rates = beside_optimum(policy, self, start)
        return {"trajectories": charts.trajectories(minutes, ours, theirs, self.asked(start), *rates)}


def first_actions(env: EnvConfig, od: Array, setpoint: Array) -> NDArray[np.intp]:
    """Return the optimum's first action for each pair of start OD and setpoint, (G,), (G,) -> (G,).

    The model is linear in the OD, so the best action depends only on OD / setpoint, and one solution is enough.
    """
    lowest = float(setpoint.min())
    scaled = od * lowest / setpoint
    wide = replace(env, start_od=(float(scaled.min()), float(scaled.max())))
    return solve_episode(wide, lowest, COARSE).act(scaled, env.episode_steps)


_optimum = lru_cache(maxsize=16)(solve_episode)  # all grids of a run share the same setpoints


class Preview(DensityTask):
    """Density task in which the policy knows the next setpoint ahead."""

    config: PreviewConfig
    observation: tuple[str, ...] = PREVIEW
    provable = False
    steady_steps = 10
    tried = ""

    def __init__(self, config: PreviewConfig) -> None:
        super().__init__(config)
        self.description += f", the next setpoint known {config.preview_min:g} min ahead"
        low, high = min(config.setpoints), max(config.setpoints)
        self.limits = (
            np.array([0.5 * SCORED_OD[0], low, low, 0.0]),
            np.array([1.5 * SCORED_OD[1], high, high, config.preview_min]),
        )

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> PreviewVectorEnv:
        return PreviewVectorEnv.seeded(self.config, seeds)

    def hindsight(self, agent: DQNConfig) -> Relabel:
        c = self.config
        (least, most), (low, high) = SCORED_OD, (min(c.setpoints), max(c.setpoints))
        return ProgramRelabel(
            agent, lambda u: least * (most / least) ** u, lambda u: low + (high - low) * u, tracking_reward,
            1, c.control_min, c.preview_min, scales=True,
        )  # fmt: skip

    def selection_grid(self) -> Array:
        setpoints = np.unique(self.config.setpoints)
        return self._changes(0.5 * (setpoints[1:] + setpoints[:-1]) if setpoints.size > 2 else setpoints)

    def report_grid(self) -> Array:
        """Return starts for the changes from every setpoint to every other one, (G, 4)."""
        return self._changes(np.unique(self.config.setpoints))

    def _changes(self, setpoints: Array) -> Array:
        """Return starts of cultures at rest at a setpoint, at the time when a change is announced, (G, 4)."""
        now, following = (a.ravel() for a in np.meshgrid(setpoints, setpoints, indexing="ij"))
        differ = now != following
        time = np.full(int(differ.sum()), self.config.preview_min)
        return np.column_stack([now[differ], now[differ], following[differ], time])

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Advance OD and program by one decision; return the observation and the error, x - setpoint."""
        state, error = super().advance(observation, action)
        goal = passed(self.config.control_min, observation[..., 1:])
        return np.concatenate([state[..., :1], goal], axis=-1), error

    def asked(self, start: Array) -> Array:
        return start[:, 2]

    def best(self, start: Array) -> Rollout:
        """Solve the setpoint program of each start by backward induction."""
        programs = program_of(self.config.control_min, start[:, 1:], self.steps)
        runs = [solve_episode(self.config, p).rollout(od) for p, od in zip(programs.T, start[:, :1], strict=True)]
        state, action = (np.stack(part, axis=-1) for part in zip(*runs, strict=True))
        return Rollout(state, state - programs[:, None], action)

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        return super().myopic(observation[..., :2])

    def figures(self, policy: Policy) -> dict[str, Figure]:
        grid = self.report_grid()
        start = grid[np.unique(grid[:, 2], return_index=True)[1]][:: max(1, len(np.unique(grid[:, 2])) // 3)]
        return self._trajectories(policy, start)
