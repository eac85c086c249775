"""Device time: threads of software and electronics as generators that yield the seconds they sleep."""

from __future__ import annotations

import heapq
import math
from collections.abc import Generator, Iterator
from typing import NamedTuple

__all__ = ["HARDWARE", "Event", "EventQueue", "Steps"]

Steps = Generator[float, None, None]

HARDWARE = -1  # life of what goes on without the software


class Event(NamedTuple):
    """A generator that is due. `life` is the software process it belongs to, or HARDWARE; `owner` names it."""

    at: float
    order: int  # of equal times the earlier scheduled comes first; unique, so nothing further is compared
    steps: Steps
    life: int
    owner: str


class EventQueue:
    """Events in the order of device time. `now` is the time of the event in progress, `life` the present process."""

    def __init__(self, now: float) -> None:
        self.now, self.life = now, 0
        self._events: list[Event] = []
        self._order = 0

    def add(self, delay: float, steps: Steps, life: int, owner: str) -> None:
        """Have `steps` continue after `delay` s."""
        self._order += 1
        heapq.heappush(self._events, Event(self.now + delay, self._order, steps, life, owner))

    def next_time(self) -> float:
        """When the next event is due, device s; inf if none."""
        return self._events[0].at if self._events else math.inf

    def due(self, t: float) -> Iterator[Event]:
        """Every event up to device time `t`, in order; those of earlier processes are dropped."""
        while self._events and self._events[0].at <= t:
            event = heapq.heappop(self._events)
            if event.life in (HARDWARE, self.life):
                self.now = max(self.now, event.at)
                yield event
        self.now = max(self.now, t)

    def remove(self, owner: str) -> None:
        """Drop the events of `owner` in the present process."""
        self._events = [e for e in self._events if e.owner != owner or e.life != self.life]
        heapq.heapify(self._events)
