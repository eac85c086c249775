"""Clocks for real time, device time and virtual time, and the time of a run."""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

STEP_S = 30.0
"""Difference of the wall clock from the known time above which a warning is given, real s."""


class Clock(Protocol):
    """Seconds on a monotonic clock, and a way to wait."""

    def now(self) -> float:
        """Return the seconds since an arbitrary start; they never decrease."""

    def sleep(self, seconds: float) -> None:
        """Wait; `seconds` <= 0 returns at once."""


class RealClock:
    """Real time, for devices, sockets, messages and processes: `uptime` since this object was made."""

    def __init__(self) -> None:
        self._start = uptime()

    def now(self) -> float:
        return uptime() - self._start

    def sleep(self, seconds: float) -> None:
        if seconds > 0.0:
            time.sleep(seconds)


class DeviceClock:
    """Device time, for samples, doses and the run: `speed` device seconds pass in one real second, 1 on the bench.

    No other module converts between the two. Args: real: clock of real time; None: the computer's.
    Raises: ValueError if speed is not positive.
    """

    def __init__(self, speed: float = 1.0, real: Clock | None = None) -> None:
        if not speed > 0.0:
            raise ValueError(f"clock speed = {speed}: allowed > 0 (1 = real time)")
        self.real, self._speed = real or RealClock(), speed

    def now(self) -> float:
        return self.of_real(self.real.now())

    def sleep(self, seconds: float) -> None:
        self.real.sleep(self.to_real(seconds))

    def of_real(self, real_s: float) -> float:
        """Convert real seconds, or a real time, to device seconds."""
        return real_s * self._speed

    def to_real(self, device_s: float) -> float:
        """Convert device seconds to real seconds."""
        return device_s / self._speed


class VirtualClock:
    """Time that passes only in `sleep`: a simulated day takes as long as its arithmetic."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        if seconds > 0.0:
            self._now += seconds


def boot() -> str:
    """Return the id of this computer's current boot, "" if the system has none."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


def uptime() -> float:
    """Return real seconds on the monotonic clock; it counts the computer's sleep where the system allows."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class RunTime(NamedTuple):
    """Run time, s, at least low_s and at most high_s; step_s: real seconds by which the wall clock is off."""

    s: float
    low_s: float
    high_s: float
    step_s: float = 0.0


def run_time(
    rows: Sequence[Mapping[str, Any]], speed: float = 1.0, low_s: float = 0.0, high_s: float = math.inf
) -> RunTime:
    """Return the current time of a run: that of the newest journal row plus the time since.

    If the computer was not rebooted since that row, its monotonic clock gives the time since; otherwise only its wall
    clock does, which may have been set. A clock with a result outside the bounds is not used; the result is limited to
    the bounds and never before that row.

    Args: rows: rows of the journal. speed: device seconds per real second; 0: virtual time, which stops while no
      program runs. low_s, high_s: bounds on the run time, from the devices, s.
    """
    last = max(rows, key=lambda row: float(row.get("time_s") or 0.0), default={})
    known_s = float(last.get("time_s") or 0.0)
    if not last or not speed:
        return RunTime(known_s, known_s, known_s)
    passed = {"wall": time.time() - float(last["wall"])}
    if [row.get("boot") for row in rows if row["kind"] == "start"][-1:] == [boot()] != [""]:
        passed = {"mono": uptime() - float(last["mono"]), **passed}
    clock, low_s = DeviceClock(speed), max(known_s, low_s)
    found = [known_s + clock.of_real(real_s) for real_s in passed.values()]
    s = next((s for s in found if low_s <= s <= high_s), max(min(found[0], high_s), low_s))
    exact = "mono" in passed and s == found[0]
    step_s = passed["wall"] - clock.to_real(s - known_s)
    return RunTime(s, s if exact else low_s, s if exact else high_s, step_s if abs(step_s) > STEP_S else 0.0)
