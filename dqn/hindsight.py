"""Hindsight: replace the goals of replayed transitions. A transition (x, u, x') is valid with every goal."""

import math
from collections.abc import Callable
from typing import Protocol

import torch

from dqn.config import DQNConfig
from dqn.replay import Transition


class Relabel(Protocol):
    """Replacement of the goals in a minibatch, in two steps; the first step needs only random numbers.

    numbers: W, the random numbers needed per transition.
    """

    numbers: int

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """Turn uniform random numbers into goals, for many minibatches at once, (..., B, W) -> (..., B, any)."""

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Write the drawn goals, (..., B, any), and the new rewards into transitions (..., B), in place."""


class GoalRelabel:
    """Replacement of goal and reward of transitions (Andrychowicz 2017); observations are [x, goal].

    Two kinds of goals are drawn. A fraction `hindsight_near` of each batch gets the goal x' + d or x' - d. log d is
    uniform over the range `hindsight_width`, so errors of every order of magnitude are trained on equally often. If one
    of these goals lies outside the range of goals, the other is taken. The rest of the batch, and transitions for which
    both lie outside, get a goal drawn uniformly from the range of goals.

    Args:
      config: uses the keys `hindsight_*`. goals: lowest and highest goal of the task.
      reward: function (x', goal) -> reward; all three have the same shape.
    """

    numbers = 2

    def __init__(
        self,
        config: DQNConfig,
        goals: tuple[float, float],
        reward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
    ) -> None:
        self._low, self._high = goals
        self._config, self._reward = config, reward

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """Draw a goal from the whole range, and d with its sign; d is infinite where the goal may be anywhere."""
        goal = self._low + (self._high - self._low) * uniform[..., 0]
        return torch.stack([goal, _distance(self._config, uniform[..., 1])], dim=-1)

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Replace goals and rewards of a batch, in place."""
        x = batch.s_t[..., 0]
        goal, distance = drawn.unbind(-1)
        for candidate in (x - distance, x + distance):
            goal = torch.where(candidate.clamp(self._low, self._high) == candidate, candidate, goal)
        batch.s_tm1[..., 1] = goal
        batch.s_t[..., 1] = goal
        batch.r_t.copy_(self._reward(x, batch.s_t[..., 1]))


class ShiftRelabel:
    """Goal replacement for observations [error, parameter]: a new goal shifts both errors of a step equally.

    A fraction `hindsight_near` of each batch is shifted so that the error after the step is d or -d, with d drawn as in
    `GoalRelabel`. The others are shifted so that the error before the step is uniform within +-span.

    Args: config: uses the keys `hindsight_*`. span: largest error. reward: function of the reached error, any shape.
    """

    numbers = 2

    def __init__(self, config: DQNConfig, span: float, reward: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self._config, self._span, self._reward = config, span, reward

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """Draw an error before the step within +-span, and d with its sign; an infinite d is not used."""
        error = self._span * (2.0 * uniform[..., 0] - 1.0)
        return torch.stack([error, _distance(self._config, uniform[..., 1])], dim=-1)

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Replace errors and rewards of a batch, in place."""
        error, distance = drawn.unbind(-1)
        before, after = batch.s_tm1[..., 0], batch.s_t[..., 0]
        shift = torch.where(distance.isfinite(), distance - after, error - before).to(after.dtype)
        before += shift
        after += shift
        batch.r_t.copy_(self._reward(after))


class ProgramRelabel:
    """Goal replacement for observations [x, ..., setpoint] or [x, ..., setpoint, next setpoint, time to it].

    x is an integrator: the change of x in a step (a sum or a factor) depends on neither x nor the goals. So the reached
    x is drawn anew, and the setpoint is drawn as in `GoalRelabel`, near this x or anywhere. With a preview, the next
    setpoint is drawn anywhere, and its time is uniform over the periods of the preview; a fraction `unannounced` has no
    announcement. After the step the change is one period closer or has happened.

    Args:
      config: uses the keys `hindsight_*`. place, spread: uniform numbers -> x, setpoints. reward: function (x',
      setpoint) -> reward. column: index of the setpoint. period: duration of a step. preview: how long ahead a change
      is known, 0: no such columns; both in the unit of the time column. scales: whether a step multiplies x.
    """

    def __init__(
        self,
        config: DQNConfig,
        place: Callable[[torch.Tensor], torch.Tensor],
        spread: Callable[[torch.Tensor], torch.Tensor],
        reward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
        column: int,
        period: float = 1.0,
        preview: float = 0.0,
        unannounced: float = 0.2,
        scales: bool = False,
    ) -> None:
        self._config, self._place, self._spread, self._reward, self._scales = config, place, spread, reward, scales
        self._column, self._period, self._preview, self._unannounced = column, period, preview, unannounced
        self.numbers = 5 if preview else 3

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """Draw x after the step, setpoint, its distance from x (infinite: anywhere), next setpoint and its time."""
        parts = [self._place(uniform[..., 0]), self._spread(uniform[..., 1]), _distance(self._config, uniform[..., 2])]
        if self._preview:
            known = ((uniform[..., 4] - self._unannounced) / (1.0 - self._unannounced)).clamp(min=-1e-9)
            time = self._period * torch.floor(1.0 + known * (self._preview / self._period))
            parts += [self._spread(uniform[..., 3]), time]
        return torch.stack(parts, dim=-1)

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Replace x, setpoints, times and rewards of a batch, in place."""
        x, setpoint, distance, *announced = drawn.to(batch.s_t.dtype).unbind(-1)
        before, after = batch.s_tm1[..., 0], batch.s_t[..., 0]
        batch.s_tm1[..., 0] = before * (x / after) if self._scales else before + (x - after)
        batch.s_t[..., 0] = x
        low, high = self._spread(torch.tensor([0.0, 1.0])).to(x)
        near = x + distance
        setpoint = torch.where(near.clamp(low, high) == near, near, setpoint)
        batch.s_tm1[..., self._column] = batch.s_t[..., self._column] = setpoint
        if announced:
            following, time = announced
            following = torch.where(time > 0.0, following, setpoint)
            left = (time - self._period).clamp(min=0.0)
            batch.s_tm1[..., -2] = batch.s_t[..., -2] = following
            batch.s_tm1[..., -1], batch.s_t[..., -1] = time, left
            batch.s_t[..., self._column] = torch.where(left > 0.0, setpoint, following)
        batch.r_t.copy_(self._reward(x, setpoint))


def _distance(config: DQNConfig, uniform: torch.Tensor) -> torch.Tensor:
    """Draw signed distances, log-uniform over `hindsight_width`, for a fraction `hindsight_near`; else infinite.

    One random number gives both sign and distance. Args: uniform: (..., B). Returns: the same shape.
    """
    smallest, largest = (math.log(width) for width in config.hindsight_width)
    side = torch.where(uniform < 0.5, -1.0, 1.0)
    distance = side * torch.exp(smallest + (largest - smallest) * (2.0 * uniform % 1.0))
    distance[..., round(config.hindsight_near * uniform.shape[-1]) :] = math.inf
    return distance
