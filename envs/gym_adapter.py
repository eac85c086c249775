"""Single environment made from a vector environment, for libraries that expect `gymnasium.Env`."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.vector_env import EpisodeSpec, EpisodeVectorEnv

REGISTERED: dict[str, tuple[str, str, dict[str, float]]] = {
    "Bioreactor-v0": ("envs.density:BioreactorEnv", "envs.vector_env:BioreactorVectorEnv", {}),
    "Relative-v0": ("envs.density:RelativeEnv", "envs.relative:RelativeVectorEnv", {}),
    "BioreactorPreview-v0": ("envs.preview:PreviewEnv", "envs.preview:PreviewVectorEnv", {}),
}
"""Name -> class of the single and of the vector environment, changes to the task's defaults. Guests add entries."""


class EpisodeEnv(EpisodeSpec, gymnasium.Env[Any, Any]):
    """Single environment: N = 1, no autoreset. The vector environment `batch` defines observation, action and reward.

    `info` contains the state by the observation's names, in full precision: {"od": ...}.
    Args: config: the task; overrides: values to change in it. render_mode: only None, as nothing is drawn.
    Raises: ValueError with the invalid value; TypeError for a `render_mode`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's contract)
    batch: type[EpisodeVectorEnv[Any]]

    def __init__(self, config: Any = None, *, render_mode: str | None = None, **overrides: Any) -> None:
        self._batch = self.batch(1, config, render_mode=render_mode, **overrides)
        self.render_mode = None
        self.config = self._batch.config
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space
        self._next: NDArray[np.float32] | None = None  # start of the episode that the batch has already begun

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes it reproducible. Args: options: as for the vector environment.

        Raises: ValueError for an unknown option or a value out of range.
        """
        super().reset(seed=seed)
        if seed is not None or self._next is None or options:
            self._next = self._batch.reset(seed=seed, options=options)[0][0]
        observation, self._next = self._next, None
        return observation, self._info()

    def _info(self) -> dict[str, Any]:
        return dict(zip(self._batch.names, self._batch.state[0].tolist(), strict=False))

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one control period. After `episode_steps` steps `truncated` is true; then call `reset`.

        Raises: ValueError if the action is not a single index of the grid; RuntimeError before the first reset.
        """
        index = self._batch.checked(action, ())
        observation, reward, _, truncated, infos = self._batch.step(index.reshape(self._batch.action_space.shape))
        info = self._info()
        if truncated[0]:
            self._next, observation = observation[0], infos["final_obs"]
            info = dict(zip(self._batch.names, observation[0].tolist(), strict=False))
        return observation[0], float(reward[0]), False, bool(truncated[0]), info


def register() -> None:
    """Register all environments for `gymnasium.make("Bioreactor-v0")` and `make_vec`; called on import of `envs`."""
    for name, (single, vector, values) in REGISTERED.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=single, vector_entry_point=vector, kwargs=dict(values))
