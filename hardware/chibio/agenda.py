"""Timed tasks: a queue of small tasks on a clock, run by one thread."""

import heapq
import itertools
from collections.abc import Generator

from hardware.clock import Clock

Task = Generator[float, None, None]
"""A generator that works in steps; it yields the pause until its next step, s."""


class Agenda:
    """Tasks ordered by the time of their next step; steps due at one time run in the order they were added.

    A task that raises is removed and its error is handed to the caller of `run_due`; the others stay.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._queue: list[tuple[float, int, Task]] = []
        self._order = itertools.count()

    def add(self, task: Task, delay_s: float = 0.0) -> None:
        """Run the first step of `task` in `delay_s` seconds."""
        heapq.heappush(self._queue, (self._clock.now() + delay_s, next(self._order), task))

    def run_due(self, until: float | None = None) -> None:
        """Run every step that is due at clock time `until`, by default now; steps that become due meanwhile wait.

        Raises: what a step raises; call again with the same `until` for the rest.
        """
        until = self._clock.now() if until is None else until
        while self._queue and self._queue[0][0] <= until:
            _, _, task = heapq.heappop(self._queue)
            pause = next(task, None)
            if pause is not None:
                self.add(task, pause)

    def next_due(self) -> float:
        """Return the clock time of the next step, inf if there is none."""
        return self._queue[0][0] if self._queue else float("inf")

    def clear(self) -> None:
        for _, _, task in self._queue:
            task.close()
        self._queue.clear()
