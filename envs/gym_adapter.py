"""The single-environment view of the vector environment, for libraries that expect `gymnasium.Env`."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.task import EnvConfig
from envs.vector_env import (
    BioreactorVectorEnv,
    EpisodeSpec,
    action_space,
    checked_actions,
    observation_space,
)  # fmt: skip

__all__ = ["BioreactorEnv", "register"]

ENV_ID = "Bioreactor-v0"


class BioreactorEnv(EpisodeSpec, gymnasium.Env[Any, Any]):
    """`BioreactorVectorEnv` with N = 1 and no autoreset; observation, action and reward are specified there.

    Version history: v0, the task of the paper.

    Args: config: the task; overrides: values of it. render_mode: None, there is nothing to draw.
    Raises: ValueError naming what is not allowed.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's contract)

    def __init__(self, config: EnvConfig | None = None, *, render_mode: str | None = None, **overrides: Any) -> None:
        self._batch = BioreactorVectorEnv(1, config, render_mode=render_mode, **overrides)
        self.render_mode = None
        self.config = self._batch.config
        self.observation_space = observation_space()
        self.action_space = action_space(self.config.n_actions)
        self._next: NDArray[np.float32] | None = None  # start of the episode the batch has already begun

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; with a seed the same one every time."""
        super().reset(seed=seed)
        if seed is not None or self._next is None:
            self._next = self._batch.reset(seed=seed)[0][0]
        observation, self._next = self._next, None
        return observation, {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One control period; `truncated` after `episode_steps`, after which `reset` must follow.

        Raises: ValueError for an action outside the grid, or that is not one integer; RuntimeError before a reset.
        """
        index = checked_actions(action, (), self.config.n_actions)
        observation, reward, _, truncated, infos = self._batch.step(index[None])
        if truncated[0]:
            self._next, observation = observation[0], infos["final_obs"]
        return observation[0], float(reward[0]), False, bool(truncated[0]), {}


def register() -> None:
    """Make `gymnasium.make("Bioreactor-v0")` and `gymnasium.make_vec(...)` work; called on import of `envs`."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENV_ID,
            entry_point="envs.gym_adapter:BioreactorEnv",
            vector_entry_point="envs.vector_env:BioreactorVectorEnv",
        )
