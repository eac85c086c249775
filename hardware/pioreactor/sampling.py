"""From the vendor's readings to one sample per control period: the median of those that no dose disturbed."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Reading

__all__ = ["OdSample", "UnitSampling"]

FEWEST = 2  # readings of a sample
DARK = 5.0  # counts, below which the interlock calls a light sensor failed
COUNTS = 10_000.0  # the interlock's counts: tenths of a millivolt


@dataclass(frozen=True)
class OdSample:
    """Median of the readings of one sample.

    at: clock time of their middle. od, spread: median and its robust sd. raw: as the interlock's counts. number: of
    readings.
    """

    at: float
    od: float
    spread: float
    raw: float
    number: int


class UnitSampling:
    """Readings of one unit; its newest sample, when that was made (arrived_s), and of the newest reading (read_s)."""

    def __init__(self, config: PioreactorConfig, period_s: float, now: float) -> None:
        self._config, self._period_s = config, period_s
        self._readings: deque[Reading] = deque(maxlen=1000)
        self.newest = OdSample(math.nan, math.nan, math.nan, math.nan, 0)
        self.arrived_s, self.read_s, self.count = now, now, 0
        self._due = -math.inf

    def take(self, readings: list[Reading]) -> None:
        """Take readings that arrived, at clock times."""
        self._readings.extend(readings)
        self.read_s = readings[-1].at if readings else self.read_s

    def look(self, now: float, undisturbed_s: float) -> OdSample | None:
        """Return the sample that is due, None without one or without readings, which count from undisturbed_s."""
        begin = max(undisturbed_s, now - self._config.window_s)
        used = [r for r in self._readings if r.at >= begin] if now >= self._due else []
        if len(used) < FEWEST:
            return None
        values = np.array([r.value for r in used])
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle))) / math.sqrt(len(used))
        dark = DARK if used[-1].calibrated else 0.0  # of clear medium it may be 0
        scale, zero = self._config.od_scale, self._config.od_zero
        self.newest = OdSample(
            float(np.mean([r.at for r in used])), (middle - zero) * scale, spread * scale,
            min(max(middle * COUNTS, dark), 60_000.0), len(used),
        )  # fmt: skip
        self.arrived_s, self.count = now, self.count + 1
        late = now - self._due > 0.5 * self._period_s
        self._due = (now if late or self.count == 1 else self._due) + self._period_s
        return self.newest
