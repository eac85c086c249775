"""The exported DQN policy as a controller: a map from (OD, setpoint) to a pump rate, without memory."""

from dataclasses import dataclass

import numpy as np

from conf.schema import setting
from dqn.policy import Policy
from experiments.controllers.base import Array, Mask

__all__ = ["LearnedConfig", "LearnedController"]


@dataclass(frozen=True)
class LearnedConfig:
    """Everything about a policy is in its file."""

    kind: str = setting("dqn", "which controller")


class LearnedController:
    """u = rates[argmax_a Q([od, setpoint], a)] (paper, section 3).

    Args: policy: as read by `dqn.policy.load`.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._q = np.zeros((0, policy.pump_rates.size), dtype=np.float32)

    def reset(self, n: int) -> None:
        """There is nothing to forget but the last explanation."""
        self._q = np.full((n, self.policy.pump_rates.size), np.nan, dtype=np.float32)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Greedy pump rate, mL/s, shape (N,); 0 where the reading is no number."""
        seen = rows & np.isfinite(od)
        observation = np.stack([np.where(seen, od, 0.0), setpoint], axis=1)
        q = self.policy.q_values(observation)
        self._q[rows] = q[rows]
        return np.where(seen, self.policy.pump_rates[q.argmax(axis=1)], 0.0)

    def explain(self) -> dict[str, Array]:
        """Q value of the chosen pump rate and its lead over the second best, each (N,)."""
        ranked = np.sort(self._q.astype(np.float64), axis=1)
        return {"q_best": ranked[:, -1], "q_lead": ranked[:, -1] - ranked[:, -2]}
