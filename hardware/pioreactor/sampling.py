"""From the vendor's readings to one sample per control period: the median of readings that no dose disturbed."""

import math
from collections import deque

import numpy as np

from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Reading
from hardware.stations import Newest

FEWEST = 2  # least readings of a sample
DARK = 5.0  # counts below which a light sensor has failed, for the interlock
COUNTS = 10_000.0  # counts per volt, for the interlock


class UnitSampling(Newest):
    """Readings of one unit, and its newest sample.

    Attributes: od, spread: median of the sample's readings, and its robust sd. number: number of readings. at: mean
      clock time of the readings. count: number of samples so far. read_s: clock time of the newest reading.
    """

    def __init__(self, config: PioreactorConfig, period_s: float, now: float) -> None:
        super().__init__(now)
        self._config, self._period_s, self._due = config, period_s, -math.inf
        self._readings: deque[Reading] = deque(maxlen=1000)
        self.spread, self.read_s, self.number, self.count = math.nan, now, 0, 0

    def take(self, readings: list[Reading]) -> None:
        self._readings.extend(readings)
        self.read_s = readings[-1].at if readings else self.read_s

    def look(self, now: float, undisturbed_s: float) -> bool:
        """Make a sample if it is due, from readings since undisturbed_s; return whether there is a new one."""
        begin = max(undisturbed_s, now - self._config.window_s)
        used = [r for r in self._readings if r.at >= begin] if now >= self._due else []
        if len(used) < FEWEST:
            return False
        values = np.array([r.value for r in used])
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle))) / math.sqrt(len(used))
        dark = DARK if used[-1].calibrated else 0.0  # a calibrated reading of clear medium may be 0
        self.od, self.spread = (middle - self._config.od_zero) * self._config.od_scale, spread * self._config.od_scale
        self.raw, self.number = min(max(middle * COUNTS, dark), 60_000.0), len(used)
        self.at, self.arrived_s, self.count = float(np.mean([r.at for r in used])), now, self.count + 1
        late = now - self._due > 0.5 * self._period_s
        self._due = (now if late or self.count == 1 else self._due) + self._period_s
        return True
