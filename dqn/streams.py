"""Random numbers for a population: agent i draws the same ones whether it is trained alone or among others."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

__all__ = ["UniformStream"]

CALLS_PER_BLOCK = 128


class UniformStream:
    """Uniform numbers in [0, 1), `width` per agent and call, each agent from a generator of its own.

    Each generator draws the numbers of CALLS_PER_BLOCK calls at once, a block, so that most calls need no Python loop
    over agents. What is saved is the place in the block and the generators as they were before they drew it, from which
    the block is drawn again. Once the block is used up, the generators are saved as they are.

    Args:
      seeds: one per agent, S. width: numbers per agent and call.
      device: where the numbers go; a block at a time travels there.
    """

    def __init__(self, seeds: Sequence[np.random.SeedSequence], width: int, device: torch.device) -> None:
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._width = width
        self._device = device
        self._position = CALLS_PER_BLOCK
        self._states = [g.bit_generator.state for g in self._generators]
        self._block = torch.empty(0)

    def _refill(self) -> None:
        self._states = [g.bit_generator.state for g in self._generators]
        numbers = np.stack([g.random((CALLS_PER_BLOCK, self._width)) for g in self._generators], axis=1)
        self._block = torch.from_numpy(numbers).to(self._device)
        self._position = 0

    def next(self) -> torch.Tensor:
        """The next numbers, shape (S, width), float64."""
        if self._position == CALLS_PER_BLOCK:
            self._refill()
        numbers = self._block[self._position]
        self._position += 1
        return numbers

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue; plain numbers."""
        used_up = self._position == CALLS_PER_BLOCK
        states = [g.bit_generator.state for g in self._generators] if used_up else self._states
        return {"generators": states, "position": self._position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue as saved."""
        for generator, stored in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = stored
        if state["position"] < CALLS_PER_BLOCK:
            self._refill()
        self._position = state["position"]
