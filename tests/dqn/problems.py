"""Small problems with known answers, as environments for the trainer."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dqn.agent import STREAMS


def streams(seeds: Sequence[int]) -> dict[str, list[np.random.SeedSequence]]:
    """The random streams of agents with these seeds."""
    children = [np.random.SeedSequence(seed).spawn(len(STREAMS)) for seed in seeds]
    return {name: [own[k] for own in children] for k, name in enumerate(STREAMS)}


class IdentityEnv:
    """Shows the number of the action that pays 1; all others pay 0. Episodes of `length` steps end by truncation.

    The symbols of copy i come from the seed of agent i, whatever the number of copies.
    """

    def __init__(self, seeds: Sequence[int], symbols: int = 3, length: int = 10) -> None:
        self.n, self.symbols, self.length = len(seeds), symbols, length
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._shown = np.zeros(self.n, dtype=np.int64)
        self._steps = 0

    def _draw(self) -> NDArray[np.float32]:
        self._shown = np.array([g.integers(self.symbols) for g in self._generators])
        return self._observe()

    def _observe(self) -> NDArray[np.float32]:
        return np.eye(self.symbols, dtype=np.float32)[self._shown]

    def reset(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        self._steps = 0
        return self._draw(), {}

    def step(self, actions: NDArray[np.intp]) -> tuple[Any, ...]:
        reward = (actions == self._shown).astype(np.float64)
        self._steps += 1
        observation = self._draw()
        ended = np.full(self.n, self._steps % self.length == 0)
        infos: dict[str, Any] = {}
        if ended.any():
            infos = {"final_obs": observation, "_final_obs": ended}
            observation = self._draw()
        return observation, reward, np.zeros(self.n, dtype=np.bool_), ended, infos

    def state_dict(self) -> dict[str, Any]:
        return {
            "generators": [g.bit_generator.state for g in self._generators],
            "shown": self._shown.tolist(),
            "steps": self._steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> NDArray[np.float32]:
        for generator, stored in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = stored
        self._shown = np.array(state["shown"])
        self._steps = state["steps"]
        return self._observe()
