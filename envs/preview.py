"""Density task with an announced setpoint change, so that a controller can start to move before the change."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from conf.schema import require, setting
from envs.gym_adapter import EpisodeEnv
from envs.integrators import Array
from envs.task import MAX_OD, EnvConfig
from envs.vector_env import BioreactorVectorEnv

FAR = 1e6  # periods to the change if no change is known


@dataclass(frozen=True)
class PreviewConfig(EnvConfig):
    """`env=preview`: the task of the paper with one change of the setpoint, which is announced.

    With the defaults the announcement comes six decisions before the change.
    """

    kind: str = setting("preview", "task")
    control_min: float = setting(5.0, "control period", "min", above=0.0, at_most=60.0)
    episode_steps: int = setting(12, "control steps per episode, ended by truncation", at_least=1)
    preview_min: float = setting(30.0, "time between announcement and change", "min", above=0.0, at_most=1440.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(set(self.setpoints)) > 1, "env.setpoints", self.setpoints, "two or more different values")
        even = self.preview_min % self.control_min == 0.0
        require(even, "env.preview_min", self.preview_min, f"a multiple of env.control_min = {self.control_min:g}")


def passed(control_min: float, goal: Array) -> Array:
    """Advance (setpoint, next setpoint, minutes to the change), (..., 3), by one decision.

    Without an announcement, or after the change, the next setpoint equals the setpoint and the time is 0.
    """
    now, following, time = (goal[..., k] for k in range(3))
    left = np.maximum(time - control_min, 0.0)
    return np.stack([np.where(left > 0.0, now, following), following, left], axis=-1)


def program_of(control_min: float, goal: Array, steps: int) -> Array:
    """Return the setpoint during each of the next decisions, (steps, ...), from the announcement `goal`, (..., 3)."""
    program = np.empty((steps, *goal.shape[:-1]))
    for k in range(steps):
        program[k], goal = goal[..., 0], passed(control_min, goal)
    return program


def minutes_ahead(control_min: float, preview_min: float, uniform: Array) -> Array:
    """Turn uniform numbers into times to a change, min: 1, 2, ... decisions up to the preview, equally likely."""
    return np.asarray(control_min * (1.0 + np.floor(uniform * (preview_min / control_min))))


def half_way(now: Array, following: Array, left: Array, full: Array | float, share: Array | float) -> Array:
    """Return the OD on the best path to the next setpoint, `left` periods before the change (negative: after it).

    The path is pure growth or full pump and passes the mean of both setpoints at the change. Reason: on an exponential,
    the time spent at x is proportional to dx / x. If the OD m at the change increases by dm, the sum of squared errors
    before the change grows by (m - now)^2 dm / m and the sum after it falls by (following - m)^2 dm / m.

    Args: full: decrease of ln OD in one period of full pump. share: growth in one period, as a fraction of `full`.
    """
    direction = np.sign(following - now)
    speed = full * np.where(direction > 0.0, share, 1.0 - np.asarray(share))
    way = 0.5 * (now + following) * np.exp(np.clip(-direction * speed * np.minimum(left, FAR), -20.0, 20.0))
    return np.asarray(np.clip(way, np.minimum(now, following), np.maximum(now, following)))


class PreviewVectorEnv(BioreactorVectorEnv):
    """Task: hold a culture at a setpoint that changes once. Time and value of the change are announced.

    Dynamics, action and reward: as in `BioreactorVectorEnv`; the reward uses the setpoint at the start of the step.

    | observation | meaning                                             | range              | unit |
    |-------------|-----------------------------------------------------|--------------------|------|
    | 0           | optical density x                                   | [0, 1000]          | -    |
    | 1           | setpoint                                            | (0, 2]             | -    |
    | 2           | next setpoint; equals the setpoint after the change | (0, 2]             | -    |
    | 3           | time to the change; 0 after the change              | 0 to `preview_min` | min  |

    Start: x, both setpoints and the time of the change are drawn from the stream of the copy.
    """

    default = PreviewConfig
    config: PreviewConfig
    names = ("od", "setpoint", "next_setpoint", "minutes_to_change")
    numbers = 4

    @staticmethod
    def observations(config: Any) -> spaces.Box:
        """Return the space of the observations in the table, float32."""
        high = np.array([MAX_OD, 2.0, 2.0, config.preview_min], dtype=np.float32)
        return spaces.Box(low=0.0, high=high, dtype=np.float32)

    def _begun(self, numbers: Array) -> Array:
        following = super()._begun(numbers[:, [0, 2]])[:, 1]
        time = minutes_ahead(self.config.control_min, self.config.preview_min, numbers[:, 3])
        return np.column_stack([super()._begun(numbers), following, time])

    def _advance(self, actions: NDArray[np.intp]) -> Array:
        reward = super()._advance(actions)
        self.state[:, 1:] = passed(self.config.control_min, self.state[:, 1:])
        return reward


class PreviewEnv(EpisodeEnv):
    """`PreviewVectorEnv` as a single environment. Version history: v0."""

    batch = PreviewVectorEnv
