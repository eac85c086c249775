"""Time as an argument: real time, device time, and a clock that moves only when somebody sleeps."""

import time
from typing import Protocol

__all__ = ["Clock", "DeviceClock", "RealClock", "VirtualClock"]


class Clock(Protocol):
    """Seconds on a monotonic clock, and a way to wait."""

    def now(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; `seconds` <= 0 returns at once."""
        ...


class RealClock:
    """Real time, for sockets, messages and processes: the machine's monotonic clock, 0 when this object was made."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Real seconds."""
        return time.monotonic() - self._start

    def sleep(self, seconds: float) -> None:
        """Wait real seconds."""
        if seconds > 0.0:
            time.sleep(seconds)


class DeviceClock:
    """Device time, for samples, doses and the run: `speed` device seconds pass in one real second.

    No other module converts between the two.

    Args: speed: 1 on the bench. real: clock that it runs on; None: the machine's.
    Raises: ValueError if speed is not positive.
    """

    def __init__(self, speed: float = 1.0, real: Clock | None = None) -> None:
        if not speed > 0.0:
            raise ValueError(f"clock speed = {speed}: allowed > 0 (1 = real time)")
        self.real, self._speed = real or RealClock(), speed

    def now(self) -> float:
        """Device seconds."""
        return self.of_real(self.real.now())

    def sleep(self, seconds: float) -> None:
        """Wait device seconds."""
        self.real.sleep(self.to_real(seconds))

    def of_real(self, real_s: float) -> float:
        """Device seconds that pass in `real_s` real seconds; device time at a real time."""
        return real_s * self._speed

    def to_real(self, device_s: float) -> float:
        """Real seconds in which `device_s` device seconds pass."""
        return device_s / self._speed


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
