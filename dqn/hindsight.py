"""Hindsight: a replayed transition (x, u, x') does not depend on the goal, so it is as true under any other goal."""

import math
from collections.abc import Callable
from typing import Protocol

import torch

from dqn.config import DQNConfig
from dqn.replay import Transition

__all__ = ["GoalRelabel", "Relabel", "ShiftRelabel"]


class Relabel(Protocol):
    """Another goal for the transitions of a minibatch, in two parts: what needs only random numbers, and the rest."""

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """What the random numbers say, (..., B, 2) -> (..., B, 2). Drawn for many minibatches at once."""
        ...

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Give transitions (..., B) the goals that were drawn, (..., B, 2), in place."""
        ...


class GoalRelabel:
    """Replaces the goal of transitions, and with it the reward (Andrychowicz 2017); observations are [x, goal].

    Two kinds of goals are drawn. A share `hindsight_near` of each batch gets x' + d or x' - d, log d uniform over the
    range `hindsight_width`, so that errors of every order of magnitude are trained on equally often. If one side lies
    outside the range of goals, the other side is taken. The rest of the batch, and transitions for which both sides lie
    outside, get a goal drawn uniformly from the range of goals.

    Args:
      config: its keys `hindsight_*`. goals: lowest and highest goal of the task.
      reward: (x', goal) -> reward, all of one shape.
    """

    def __init__(
        self,
        config: DQNConfig,
        goals: tuple[float, float],
        reward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
    ) -> None:
        self._low, self._high = goals
        self._config, self._reward = config, reward

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """A goal from the whole range, and d with the sign of its side, infinite where the goal need not be near."""
        goal = self._low + (self._high - self._low) * uniform[..., 0]
        return torch.stack([goal, _distance(self._config, uniform[..., 1])], dim=-1)

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Goals and rewards of a batch, in place."""
        x = batch.s_t[..., 0]
        goal, distance = drawn.unbind(-1)
        for candidate in (x - distance, x + distance):
            goal = torch.where(candidate.clamp(self._low, self._high) == candidate, candidate, goal)
        batch.s_tm1[..., 1] = goal
        batch.s_t[..., 1] = goal
        batch.r_t.copy_(self._reward(x, batch.s_t[..., 1]))


class ShiftRelabel:
    """The same where the observation is [error, parameter]: another goal shifts the error before and after alike.

    A share `hindsight_near` of each batch is shifted so that the error after the step is d or -d, as above; the rest so
    that the error before it is uniform within +-span.

    Args: config: its keys `hindsight_*`. span: of errors. reward: of the error reached, any shape.
    """

    def __init__(self, config: DQNConfig, span: float, reward: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self._config, self._span, self._reward = config, span, reward

    def drawn(self, uniform: torch.Tensor) -> torch.Tensor:
        """An error before the step from the whole range, and d with its sign, infinite where it need not be near."""
        error = self._span * (2.0 * uniform[..., 0] - 1.0)
        return torch.stack([error, _distance(self._config, uniform[..., 1])], dim=-1)

    def replace(self, batch: Transition, drawn: torch.Tensor) -> None:
        """Errors and rewards of a batch, in place."""
        error, distance = drawn.unbind(-1)
        before, after = batch.s_tm1[..., 0], batch.s_t[..., 0]
        shift = torch.where(distance.isfinite(), distance - after, error - before).to(after.dtype)
        before += shift
        after += shift
        batch.r_t.copy_(self._reward(after))


def _distance(config: DQNConfig, uniform: torch.Tensor) -> torch.Tensor:
    """Signed distances whose logarithm is uniform over `hindsight_width`; infinite beyond the share `hindsight_near`.

    One number holds both the side and the distance. Args: uniform: (..., B). Returns: the same shape.
    """
    smallest, largest = (math.log(width) for width in config.hindsight_width)
    side = torch.where(uniform < 0.5, -1.0, 1.0)
    distance = side * torch.exp(smallest + (largest - smallest) * (2.0 * uniform % 1.0))
    distance[..., round(config.hindsight_near * uniform.shape[-1]) :] = math.inf
    return distance
