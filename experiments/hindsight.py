"""Goals for replayed transitions: (x, u, x') does not depend on the setpoint, so it is true under any other one."""

from __future__ import annotations

import math

import torch

from dqn.agent import Relabel
from dqn.config import DQNConfig
from dqn.replay import Transition
from envs.rewards import tracking_reward
from envs.task import EnvConfig

__all__ = ["goal_relabel"]


def goal_relabel(env: EnvConfig, agent: DQNConfig, device: str) -> Relabel:
    """Replace the setpoint of transitions (hindsight, Andrychowicz 2017); the reward becomes that of the new one.

    A share `relabel_near` of each batch gets a setpoint x' +- d with d log-uniform in `relabel_width`, so that every
    order of magnitude of the error is trained on equally often; where that lies outside the range of goals it goes to
    the other side, else it is drawn like the rest: uniformly in that range, which is the task's from the lowest to the
    highest setpoint, wider by `relabel_margin` so that the outermost setpoints have neighbours on both sides.
    """
    low = min(env.setpoints) * (1.0 - agent.relabel_margin)
    high = max(env.setpoints) * (1.0 + agent.relabel_margin)
    near, far = (math.log(width) for width in agent.relabel_width)

    def relabel(batch: Transition, uniform: torch.Tensor) -> Transition:
        od = batch.s_t[..., 0]
        goal = low + (high - low) * uniform[..., 0]
        n = round(agent.relabel_near * goal.shape[1])
        if n:
            # the second number holds both the side and the distance
            side = torch.where(uniform[:, :n, 1] < 0.5, -1.0, 1.0)
            distance = side * torch.exp(near + (far - near) * (2.0 * uniform[:, :n, 1] % 1.0))
            for candidate in (od[:, :n] - distance, od[:, :n] + distance):
                goal[:, :n] = torch.where((candidate >= low) & (candidate <= high), candidate, goal[:, :n])
        goal = goal.to(od.dtype)
        before = torch.stack([batch.s_tm1[..., 0], goal], dim=-1)
        after = torch.stack([od, goal], dim=-1)
        return batch._replace(s_tm1=before, s_t=after, r_t=tracking_reward(od, goal))

    return relabel
