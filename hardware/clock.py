"""Time as an argument: the real monotonic clock, a scaled one, and one that only moves when told to."""

import time
from typing import Protocol

__all__ = ["Clock", "RealClock", "ScaledClock", "VirtualClock"]


class Clock(Protocol):
    """Seconds on a monotonic clock, and a way to wait."""

    def now(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; `seconds` <= 0 returns at once."""
        ...


class RealClock:
    """The machine's monotonic clock; `speed` device seconds pass in one real second (1 on the bench).

    Raises: ValueError if speed is not positive.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not speed > 0.0:
            raise ValueError(f"clock speed = {speed}: allowed > 0 (1 = real time)")
        self.speed = speed
        self._start = time.monotonic()

    def now(self) -> float:
        """Device seconds since this clock was made."""
        return (time.monotonic() - self._start) * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` device seconds."""
        if seconds > 0.0:
            time.sleep(seconds / self.speed)


class ScaledClock:
    """Another clock, `speed` times as fast."""

    def __init__(self, clock: Clock, speed: float) -> None:
        self._clock, self.speed = clock, speed

    def now(self) -> float:
        """Its seconds."""
        return self._clock.now() * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` of its own."""
        self._clock.sleep(seconds / self.speed)


class VirtualClock:
    """Time that passes only in `sleep`: a simulated day takes as long as its arithmetic."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Virtual seconds."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Advance virtual time."""
        if seconds > 0.0:
            self._now += seconds
