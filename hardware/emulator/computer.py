"""The board computer as the device's software sees it: clocks, threads, the bus to the reactors."""

from __future__ import annotations

from collections import deque
from datetime import UTC, datetime
from email.utils import format_datetime

import numpy as np

from hardware.emulator.events import EventQueue, Steps
from hardware.emulator.link_faults import LinkFaults

__all__ = ["AppError", "BusStuck", "Computer", "ProcessDied"]

EPOCH = 1_767_225_600.0  # the board's clock at device second 0: 2026-01-01 00:00:00


class AppError(Exception):
    """An exception inside the device's software: a route answers 500, a thread ends."""


class BusStuck(Exception):
    """The global bus lock is never released: the caller waits for ever."""


class ProcessDied(Exception):
    """The software ended itself (exit code 4)."""


class Computer:
    """Clocks, threads and bus.

    Args: events: device time; faults: of the board; rng: how busy it happens to be.
    `wall_offset_s` is by how much the board's clock was set forward; `errors` holds what the software did not catch.
    """

    def __init__(self, events: EventQueue, faults: LinkFaults, rng: np.random.Generator) -> None:
        self.events, self.faults, self.rng = events, faults, rng
        self.wall_offset_s = 0.0
        self.errors: deque[str] = deque(maxlen=200)

    def now(self) -> float:
        """Device time of the event in progress, s."""
        return self.events.now

    def wall(self) -> float:
        """The board's clock, s since 1970."""
        return EPOCH + self.events.now + self.wall_offset_s

    def stamp(self) -> str:
        """The board's clock as in the web page."""
        return datetime.fromtimestamp(self.wall(), UTC).strftime("%Y-%m-%d %H:%M:%S")

    def http_date(self) -> str:
        """The board's clock as Flask writes a datetime."""
        return format_datetime(datetime.fromtimestamp(int(self.wall()), UTC), usegmt=True)

    def uniform(self, low: float, high: float) -> float:
        """A random number from the computer's own stream."""
        return float(self.rng.uniform(low, high))

    def bus(self, name: str) -> None:
        """One bus access. Raises: BusStuck."""
        if self.faults.bus_stuck:
            raise BusStuck(name)

    def write_row(self, name: str) -> None:
        """One line of a data file, written under the bus lock. Raises: BusStuck, also for a full disk."""
        self.faults.bus_stuck = self.faults.bus_stuck or self.faults.disk_full
        self.bus(name)

    def spawn(self, steps: Steps, owner: str) -> None:
        """Start a thread of the software; it runs at the present device time, after what is already due."""
        self.events.add(0.0, steps, self.events.life, owner)

    def note(self, text: str) -> None:
        """Remember an error or an end of the software."""
        self.errors.append(f"{self.now():.2f} {text}")
