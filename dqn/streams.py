"""Random numbers for a population: an agent draws the same numbers whether it trains alone or with others."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

CALLS_PER_BLOCK = 128


class UniformStream:
    """Uniform numbers in [0, 1), `width` per agent and call; each agent has a separate generator.

    Each generator draws a block at once, the numbers of CALLS_PER_BLOCK calls. So most calls need no Python loop over
    agents, and values that depend only on the numbers are computed once per block. The saved state is the position in
    the block and the generators before the block, with which the block is drawn again. If the block is used up, the
    current generators are saved.

    Args:
      seeds: one per agent, S. width: numbers per agent and call.
      into: conversion of a block, float64 (S, calls, width) -> an array or tensor (S, calls, ...).
    """

    def __init__(
        self,
        seeds: Sequence[np.random.SeedSequence],
        width: int,
        into: Callable[[NDArray[np.float64]], Any] = lambda block: block,
    ) -> None:
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._width = width
        self._into = into
        self._position = CALLS_PER_BLOCK
        self._states = [g.bit_generator.state for g in self._generators]
        self._block: Any = None

    def _refill(self) -> None:
        self._states = [g.bit_generator.state for g in self._generators]
        self._block = self._into(np.stack([g.random((CALLS_PER_BLOCK, self._width)) for g in self._generators]))
        self._position = 0

    def take(self, calls: int) -> Any:
        """Return the numbers of the next n calls, (S, n, ...); n is `calls`, or less at the end of the block."""
        if self._position == CALLS_PER_BLOCK:
            self._refill()
        start, self._position = self._position, min(self._position + calls, CALLS_PER_BLOCK)
        return self._block[:, start : self._position]

    def state_dict(self) -> dict[str, Any]:
        """Return the state needed to continue, as plain numbers."""
        used_up = self._position == CALLS_PER_BLOCK
        states = [g.bit_generator.state for g in self._generators] if used_up else self._states
        return {"generators": states, "position": self._position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for generator, stored in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = stored
        if state["position"] < CALLS_PER_BLOCK:
            self._refill()
        self._position = state["position"]
