"""The density and the relative task as single Gymnasium environments, which can also report the exact optimum."""

from abc import abstractmethod
from functools import lru_cache
from typing import Any

from envs.gym_adapter import EpisodeEnv
from envs.integrators import Array
from envs.optimum import EpisodeOptimum, solve_episode, solve_relative
from envs.relative import RelativeVectorEnv
from envs.vector_env import BioreactorVectorEnv


class SolvedEnv(EpisodeEnv):
    """Environment that observes two numbers, of which the second is constant within an episode.

    Args: optimum: whether `info` also contains the optimal "optimal_action" (index) and "optimal_rate" (its pump rate).
    """

    def __init__(self, config: Any = None, *, optimum: bool = False, **given: Any) -> None:
        super().__init__(config, **given)
        self._optimum = lru_cache(32)(self._solve) if optimum else None

    @abstractmethod
    def _solve(self, held: float) -> tuple[EpisodeOptimum, Array]:
        """Solve the episode with this second number; return the optimum and the pump rate of each action."""

    def _info(self) -> dict[str, Any]:
        info, (first, held) = super()._info(), self._batch.state[0, :2]
        if self._optimum is not None:
            left = self.config.episode_steps - self._batch._steps[0]
            optimum, rates = self._optimum(float(held))
            best = int(optimum.act(first[None], left)[0])
            info |= {"optimal_action": best, "optimal_rate": float(rates[best])}
        return info


class BioreactorEnv(SolvedEnv):
    """`BioreactorVectorEnv` as a single environment; "optimal_rate" in mL/s. Version history: v0, the paper's task."""

    batch = BioreactorVectorEnv

    def _solve(self, held: float) -> tuple[EpisodeOptimum, Array]:
        return solve_episode(self.config, held), self.config.pump_rates()


class RelativeEnv(SolvedEnv):
    """`RelativeVectorEnv` as a single environment; "optimal_rate" is a fraction of full pump. Version history: v0."""

    batch = RelativeVectorEnv

    def _solve(self, held: float) -> tuple[EpisodeOptimum, Array]:
        return solve_relative(self.config, held, self.config.episode_steps), self.config.levels()
