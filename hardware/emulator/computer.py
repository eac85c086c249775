"""The board computer as the device's software sees it: device time, clocks, threads, the bus to the reactors.

Threads of software and electronics are generators that yield the seconds they sleep.
"""

import heapq
import math
from collections import deque
from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from hardware.emulator.faults import Switches

Steps = Generator[float, None, None]

EPOCH = 1_767_225_600.0  # the board's clock at device second 0: 2026-01-01 00:00:00
HARDWARE = -1  # `life` of events that continue without the software


class AppError(Exception):
    """An exception inside the device's software: the route answers 500, or the thread ends."""


class BusStuck(Exception):
    """The global bus lock is never released: the caller waits for ever."""


class ProcessDied(Exception):
    """The software ended itself (exit code 4)."""


class Due(NamedTuple):
    """The next step of a generator. `life`: number of its software process, or HARDWARE. `owner`: its name."""

    at: float
    order: int  # unique; at equal times the event that was scheduled first comes first
    steps: Steps
    life: int
    owner: str


class EventQueue:
    """Events in the order of device time. `now`: time of the current event. `life`: number of the current process."""

    def __init__(self, now: float) -> None:
        self.now, self.life = now, 0
        self._events: list[Due] = []
        self._order = 0

    def add(self, delay: float, steps: Steps, life: int, owner: str) -> None:
        self._order += 1
        heapq.heappush(self._events, Due(self.now + delay, self._order, steps, life, owner))

    def next_time(self) -> float:
        """Return when the next event is due, device s; inf if there is none."""
        return self._events[0].at if self._events else math.inf

    def due(self, t: float) -> Iterator[Due]:
        """Yield every event up to device time `t`, in order; drop those of earlier processes."""
        while self._events and self._events[0].at <= t:
            event = heapq.heappop(self._events)
            if event.life in (HARDWARE, self.life):
                self.now = max(self.now, event.at)
                yield event
        self.now = max(self.now, t)

    def remove(self, owner: str) -> None:
        """Drop the events of `owner` in the current process."""
        self._events = [e for e in self._events if e.owner != owner or e.life != self.life]
        heapq.heapify(self._events)


class Computer:
    """Clocks, threads and bus. Args: now: device time at the start, s. unit: number of the device.

    wall_offset_s: time by which the board's clock was set forward, s. errors: exceptions not caught by the software.
    """

    def __init__(self, now: float, rng: np.random.Generator, unit: int = 0) -> None:
        self.unit = unit
        self.events, self.faults, self.rng = EventQueue(now), Switches("board"), rng
        self.wall_offset_s = 0.0
        self.errors: deque[str] = deque(maxlen=200)

    def now(self) -> float:
        return self.events.now

    def wall(self) -> float:
        """Return the board's clock, s since 1970."""
        return EPOCH + self.events.now + self.wall_offset_s

    def stamp(self) -> str:
        """Format the board's clock as in the web page."""
        return datetime.fromtimestamp(self.wall(), UTC).strftime("%Y-%m-%d %H:%M:%S")

    def bus(self, name: str) -> None:
        if self.faults.bus_stuck:
            raise BusStuck(name)

    def spawn(self, steps: Steps, owner: str) -> None:
        """Start a thread of the software at the current device time, after the events that are already due."""
        self.events.add(0.0, steps, self.events.life, owner)

    def note(self, text: str) -> None:
        """Record an error or an end of the software."""
        self.errors.append(f"{self.now():.2f} {text}")
