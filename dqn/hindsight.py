"""Hindsight: a replayed transition (x, u, x') does not depend on the goal, so it is as true under any other goal."""

import math
from collections.abc import Callable

import torch

from dqn.config import DQNConfig
from dqn.replay import Transition

__all__ = ["Relabel", "goal_relabel"]

Relabel = Callable[[Transition, torch.Tensor], Transition]
"""Replaces the goal of a minibatch: (transitions (S, B), uniform numbers (S, B, 2)) -> transitions (S, B)."""


def goal_relabel(
    config: DQNConfig, goals: tuple[float, float], reward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
) -> Relabel:
    """Replace the goal of transitions, and with it the reward (Andrychowicz 2017); observations are [x, goal].

    Two kinds of goals are drawn. A share `hindsight_near` of each batch gets x' + d or x' - d, log d uniform over the
    range `hindsight_width`, so that errors of every order of magnitude are trained on equally often. If one side lies
    outside the range of goals, the other side is taken. The rest of the batch, and transitions for which both sides lie
    outside, get a goal drawn uniformly from the range of goals.

    Args:
      config: its keys `hindsight_*`. goals: lowest and highest goal of the task.
      reward: (x', goal) -> reward, all of one shape.
    """
    low, high = goals
    smallest, largest = (math.log(width) for width in config.hindsight_width)

    def relabel(batch: Transition, uniform: torch.Tensor) -> Transition:
        x = batch.s_t[..., 0]
        goal = low + (high - low) * uniform[..., 0]
        n = round(config.hindsight_near * goal.shape[1])
        if n:
            # the second number holds both the side and the distance
            side = torch.where(uniform[:, :n, 1] < 0.5, -1.0, 1.0)
            distance = side * torch.exp(smallest + (largest - smallest) * (2.0 * uniform[:, :n, 1] % 1.0))
            for candidate in (x[:, :n] - distance, x[:, :n] + distance):
                goal[:, :n] = torch.where((candidate >= low) & (candidate <= high), candidate, goal[:, :n])
        goal = goal.to(x.dtype)
        before = torch.stack([batch.s_tm1[..., 0], goal], dim=-1)
        after = torch.stack([x, goal], dim=-1)
        return batch._replace(s_tm1=before, s_t=after, r_t=reward(x, goal))

    return relabel
