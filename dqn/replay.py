"""Replay memory: a preallocated ring of transitions for S agents that step together."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

__all__ = ["Replay", "Transition"]


class Transition(NamedTuple):
    """One step of S agents, or a minibatch of B steps of each: observation before, action, reward, observation after.

    s_tm1, s_t: (S, B, O) float32. a_tm1: (S, B) int64. r_t: (S, B) float32.
    continues: (S, B) float32, 0 where the episode terminated (no bootstrapping), 1 also where it was truncated.
    """

    s_tm1: torch.Tensor
    a_tm1: torch.Tensor
    r_t: torch.Tensor
    s_t: torch.Tensor
    continues: torch.Tensor


class Replay:
    """The last `capacity` transitions of each of S agents.

    A transition is one row of 2 O + 3 float32 numbers, so that drawing a minibatch is one gather.

    Args:
      agents: S. capacity: transitions per agent. observations: O. device: where they are kept.
    """

    def __init__(self, agents: int, capacity: int, observations: int, device: torch.device) -> None:
        self._rows = torch.zeros(agents, capacity, 2 * observations + 3, device=device)
        self._o = observations
        self._agent = (torch.arange(agents, device=device) * capacity)[:, None]
        self.capacity = capacity
        self.added = 0  # transitions ever added, per agent

    @property
    def size(self) -> int:
        """Transitions held per agent."""
        return min(self.added, self.capacity)

    def add(self, step: Transition) -> None:
        """Append one transition per agent (B = 1), replacing the oldest when full."""
        scalars = torch.stack([step.a_tm1.to(torch.float32), step.r_t, step.continues], dim=-1)
        self._rows[:, self.added % self.capacity] = torch.cat([step.s_tm1, step.s_t, scalars], dim=-1)[:, 0]
        self.added += 1

    def sample(self, uniform: torch.Tensor) -> Transition:
        """Uniform draws with replacement.

        Args:
          uniform: numbers in [0, 1), shape (S, B); number v picks row floor(v * size).
        Returns: a minibatch, copies. Raises: ValueError while the memory is empty.
        """
        if self.added == 0:
            raise ValueError("replay memory is empty: add transitions before sampling")
        index = (uniform * self.size).long() + self._agent
        flat = self._rows.view(-1, self._rows.shape[-1]).index_select(0, index.view(-1))
        rows = flat.view(*uniform.shape, -1)
        o = self._o
        return Transition(
            s_tm1=rows[..., :o],
            s_t=rows[..., o : 2 * o],
            a_tm1=rows[..., 2 * o].long(),
            r_t=rows[..., 2 * o + 1],
            continues=rows[..., 2 * o + 2],
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue."""
        return {"rows": self._rows[:, : self.size].cpu(), "added": self.added}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue as saved."""
        self.added = state["added"]
        self._rows[:, : self.size] = state["rows"].to(self._rows.device)
