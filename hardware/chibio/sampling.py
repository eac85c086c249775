"""What a sample of the device is: whether it is new, when it appeared, and when to look for the next one."""

import math
from collections import deque

from conf.messages import Message
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.messages import SampleBeforeLate, SampleLate
from hardware.chibio.protocol import DeviceState
from hardware.clock import Clock
from hardware.stations import Newest

CYCLE_S = 60.07  # median of 3275 real cycles (docs/device.md, Cycle)
FIRST_SAMPLE_S = 13.5  # from a cycle's start until its sample is on record


class Sampling(Newest):
    """The newest sample of one reactor.

    The device does not say when a sample appeared, only the time at which its cycle began, on a clock of its own. The
    smallest offset between the two clocks among samples that were waited for shows how late any other one was seen.

    Attributes: key, (record time, cycles) of the newest sample, None before the first; late_s, how long after it
      appeared it was seen.
    """

    def __init__(self, config: ChiBioConfig, clock: Clock) -> None:
        super().__init__(clock.now())
        self._config, self._clock, self.next_look, self.blank = config, clock, clock.now(), math.nan
        self.fluorescence = math.nan if config.fluorescence.measure else None
        self.key: tuple[float, int] | None = None
        self.late_s = 0.0
        self._offsets: deque[float] = deque(maxlen=3)  # arrival minus the device's own time, samples seen at once
        self._looked = False  # the last look found nothing new, so the next sample will be seen when it appears

    @property
    def appeared_s(self) -> float:
        """Clock time at which the newest sample appeared; -inf if it was there already at the first look."""
        return self.arrived_s - self.late_s

    def pass_over(self, state: DeviceState) -> None:
        """Deliver the next new sample only: the one on record is of unknown age."""
        if math.isfinite(state.sample_s):
            self.key = (state.sample_s, state.cycles)
        self._offsets.clear()

    def expect_first(self) -> None:
        """Expect the first cycle: the device's own time begins now."""
        self._offsets.append(self._clock.now() + FIRST_SAMPLE_S)

    def look(self, state: DeviceState, now: float) -> bool:
        """Whether `state` brings a new sample; plans the look after one that brings none.

        `cycles` counts cycles begun: a sample that was seen late may carry the number of the next one already.
        """
        self.next_look = now + self._config.poll_s
        return math.isfinite(state.sample_s) and (
            self.key is None or (state.sample_s != self.key[0] and state.cycles >= self.key[1])
        )

    def not_taken(self, is_new: bool) -> None:
        """Note a look without a sample to act on: there was none, or a new one that a fault forbids to use."""
        self._looked = not is_new

    def take(self, state: DeviceState, now: float) -> Message | None:
        """Make a new sample, seen at `now`, the newest one; return what it shows of the board's clock, or None."""
        self.key = (state.sample_s, state.cycles)
        self.arrived_s = self.at = now
        self.od, self.temperature = state.sample_od, state.sample_temperature
        self.raw, self.blank = state.raw, state.blank
        note = self._measure_lateness(now - state.sample_s)
        self.next_look = now + CYCLE_S - (2.5 if self._looked else 20.0)
        self._looked = False
        return note

    def _measure_lateness(self, offset: float) -> Message | None:
        """How much later than possible this sample was seen: its offset against the smallest of recent ones.

        A step of the board's clock looks like lateness. Only samples that were waited for enter the measure, so three
        of them replace the offsets of before.
        """
        note: Message | None = None
        if self._offsets and not -30.0 < offset - min(self._offsets) < 65.0:
            late_s = offset - min(self._offsets)
            note = SampleLate(late_s=late_s) if late_s > 0.0 else SampleBeforeLate(late_s=-late_s)
            self._offsets.clear()
        if self._looked or (self._offsets and offset < min(self._offsets)):
            self._offsets.append(offset)
        self.late_s = offset - min(self._offsets) if self._offsets else math.inf
        return note
