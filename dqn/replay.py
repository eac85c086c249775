"""Replay memory: a preallocated ring buffer of transitions for S agents that step together."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[Any]


class Transition(NamedTuple):
    """One or more minibatches of B transitions for each of S agents; "..." is an axis for several minibatches.

    s_tm1, s_t: observation before and after the step, (S, ..., B, O) float32. a_tm1: action, (S, ..., B) int64.
    r_t: reward, (S, ..., B) float32. continues: (S, ..., B) float32, 0 where the episode terminated (no bootstrapping),
    else 1, also where it was truncated.
    """

    s_tm1: torch.Tensor
    a_tm1: torch.Tensor
    r_t: torch.Tensor
    s_t: torch.Tensor
    continues: torch.Tensor


class Replay:
    """Memory of the last `capacity` transitions of each of S agents.

    A transition is one row of 2 O + 3 float32 numbers, so storing it is one copy and drawing minibatches is one gather.

    Args: agents: S. capacity: transitions per agent. observations: O. device: where the memory is, e.g. "cpu".
    """

    def __init__(self, agents: int, capacity: int, observations: int, device: torch.device) -> None:
        self._widths = [observations, observations, 1, 1, 1]
        self._rows = torch.zeros(agents, capacity, sum(self._widths), device=device)
        self._flat = self._rows.view(-1, self._rows.shape[-1])
        self._first = np.arange(agents)[:, None] * capacity
        self._new = np.zeros((agents, sum(self._widths)), dtype=np.float32)
        self._added = torch.from_numpy(self._new)
        self.capacity = capacity
        self.added = 0  # transitions ever added, per agent

    @property
    def size(self) -> int:
        """Number of stored transitions per agent."""
        return min(self.added, self.capacity)

    def add(self, s_tm1: Array, a_tm1: Array, r_t: Array, s_t: Array, continues: Array) -> None:
        """Append one transition per agent; a full memory replaces its oldest transition.

        Args: the fields of `Transition` as NumPy arrays without the axis B.
        """
        o = self._widths[0]
        self._new[:, :o] = s_tm1
        self._new[:, o : 2 * o] = s_t
        self._new[:, 2 * o] = a_tm1
        self._new[:, 2 * o + 1] = r_t
        self._new[:, 2 * o + 2] = continues
        self._rows[:, self.added % self.capacity].copy_(self._added)
        self.added += 1

    def sample(self, uniform: Array) -> Transition:
        """Draw transitions uniformly with replacement.

        Args: uniform: float64 in [0, 1), shape (S, ..., B); number v selects row floor(v * size).
        Returns: copies of the transitions. Raises: ValueError if the memory is empty.
        """
        if self.added == 0:
            raise ValueError("replay memory is empty: add transitions before sampling")
        index = (uniform * self.size).astype(np.int64).reshape(len(self._first), -1) + self._first
        rows = self._flat.index_select(0, torch.from_numpy(index.ravel()).to(self._flat.device))
        s_tm1, s_t, a_tm1, r_t, continues = rows.view(*uniform.shape, -1).split_with_sizes(self._widths, dim=-1)
        return Transition(s_tm1, a_tm1.squeeze(-1).long(), r_t.squeeze(-1), s_t, continues.squeeze(-1))

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self._rows[:, : self.size].cpu(), "added": self.added}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.added = state["added"]
        self._rows[:, : self.size] = state["rows"].to(self._rows.device)
