"""The paper's task as a single Gymnasium environment, which can also report the exact optimum."""

from functools import cache, partial
from typing import Any

from envs.gym_adapter import EpisodeEnv
from envs.optimum import solve_episode
from envs.vector_env import BioreactorVectorEnv


class BioreactorEnv(EpisodeEnv):
    """`BioreactorVectorEnv` as a single environment. Version history: v0, the task of the paper.

    Args: optimum: whether `info` also contains the optimal "optimal_action" (index) and "optimal_rate" (mL/s).
    """

    batch = BioreactorVectorEnv

    def __init__(self, config: Any = None, *, optimum: bool = False, **given: Any) -> None:
        super().__init__(config, **given)
        self._optimum = cache(partial(solve_episode, self.config)) if optimum else None

    def _info(self) -> dict[str, Any]:
        info = super()._info()
        if self._optimum is not None:
            left = self.config.episode_steps - self._batch._steps[0]
            best = self._optimum(info["setpoint"]).act(self._batch.state[:, 0], left)
            info |= {"optimal_action": int(best[0]), "optimal_rate": float(self.config.pump_rates()[best[0]])}
        return info
