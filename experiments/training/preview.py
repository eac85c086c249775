"""The density with the next setpoint known ahead for a training run: OD and program in, a pump rate out."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import ProgramRelabel, Relabel
from dqn.policy import PREVIEW, Policy
from envs.optimum import solve_episode
from envs.preview import PreviewConfig, PreviewVectorEnv, passed, program_of
from envs.task import SCORED_OD, tracking_reward
from experiments.reporting import charts
from experiments.training.density import DensityTask
from experiments.training.evaluation import Rollout, each, rollout

__all__ = ["Preview"]

Array = NDArray[np.float64]


class Preview(DensityTask):
    """See `Task`; arguments and errors of every method are described there."""

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
        """Environments."""
        env = PreviewVectorEnv(len(seeds), self.config)
        env.seed_streams(seeds)
        return env

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """Another OD, other setpoints, another time of the change."""
        c = self.config
        (least, most), (low, high) = SCORED_OD, (min(c.setpoints), max(c.setpoints))
        return ProgramRelabel(
            agent, lambda u: least * (most / least) ** u, lambda u: low + (high - low) * u, tracking_reward,
            1, c.control_min, c.preview_min, scales=True,
        )  # fmt: skip

    def selection_grid(self) -> Array:
        """List changes between each two of the middles between neighbouring setpoints."""
        setpoints = np.unique(self.config.setpoints)
        return self._changes(0.5 * (setpoints[1:] + setpoints[:-1]) if setpoints.size > 2 else setpoints)

    def report_grid(self) -> Array:
        """List changes between each two of the setpoints."""
        return self._changes(np.unique(self.config.setpoints))

    def _changes(self, setpoints: Array) -> Array:
        """Cultures at rest when the change is announced."""
        now, following = (a.ravel() for a in np.meshgrid(setpoints, setpoints, indexing="ij"))
        differ = now != following
        time = np.full(int(differ.sum()), self.config.preview_min)
        return np.column_stack([now[differ], now[differ], following[differ], time])

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Advance OD and program by one decision; x - setpoint."""
        state, error = super().advance(observation, action)
        goal = passed(self.config.control_min, observation[..., 1:])
        return np.concatenate([state[..., :1], goal], axis=-1), error

    def asked(self, start: Array) -> Array:
        """Return the last setpoint of the episode."""
        return start[:, 2]

    def best(self, start: Array) -> Rollout:
        """By backward induction over the program of each start."""
        programs = program_of(self.config.control_min, start[:, 1:], self.steps)
        runs = [solve_episode(self.config, p).rollout(od) for p, od in zip(programs.T, start[:, :1], strict=True)]
        state, action = (np.stack(part, axis=-1) for part in zip(*runs, strict=True))
        return Rollout(state, state - programs[:, None], action)

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """argmin_a |f_a x - s|."""
        return super().myopic(observation[..., :2])

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """OD over time of a few changes, beside the optimum's."""
        grid = self.report_grid()
        start = grid[np.unique(grid[:, 2], return_index=True)[1]][:: max(1, len(np.unique(grid[:, 2])) // 3)]
        ours, theirs = rollout(each(policy), self, start[None]), self.best(start)
        minutes = np.arange(self.steps + 1, dtype=np.float64) * self.config.control_min
        od, best = (np.concatenate([start[:, 0][None], run.state[:, 0]]) for run in (ours, theirs))
        rates, best_rates = (self.actions[run.action[:, 0]] for run in (ours, theirs))
        return {"trajectories": charts.trajectories(minutes, od, best, start[:, 2], rates, best_rates)}
