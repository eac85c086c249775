"""Samples of the device: whether one is new, when it appeared, and when to look for the next sample."""

import math
from collections import deque

from conf.messages import Message
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.messages import SampleBeforeLate, SampleLate
from hardware.chibio.protocol import DeviceState
from hardware.clock import Clock
from hardware.stations import Newest

CYCLE_S = 60.07  # median of 3275 real cycles (docs/device.md, Cycle)
POLL_S = 2.0  # between two requests for an expected sample
FIRST_SAMPLE_S = 13.5  # from a cycle's start until its sample is on record


class Sampling(Newest):
    """The newest sample of one reactor.

    The device reports only the time at which a sample's cycle began, on the device's own clock. The smallest offset
    between the two clocks, among samples that the program waited for, shows how late any other sample was seen.

    Attributes: key: (record time, cycles) of the newest sample, None before the first. late_s: time from the sample's
      appearance until the program saw it, s.
    """

    def __init__(self, config: ChiBioConfig, clock: Clock) -> None:
        super().__init__(clock.now())
        self._clock, self.next_look, self.blank = clock, clock.now(), math.nan
        self.fluorescence = math.nan if config.fluorescence.measure else None
        self.key: tuple[float, int] | None = None
        self.late_s = 0.0
        self._offsets: deque[float] = deque(maxlen=3)  # arrival minus device time, of samples seen at once
        self._looked = False  # the last look found nothing new, so the next sample will be seen when it appears

    @property
    def appeared_s(self) -> float:
        """Clock time at which the newest sample appeared; -inf if it appeared before the first look."""
        return self.arrived_s - self.late_s

    def pass_over(self, state: DeviceState) -> None:
        """Ignore the sample on record, because its age is unknown."""
        if math.isfinite(state.sample_s):
            self.key = (state.sample_s, state.cycles)
        self._offsets.clear()

    def expect_first(self) -> None:
        """Expect the first cycle: the device's time starts at 0 now."""
        self._offsets.append(self._clock.now() + FIRST_SAMPLE_S)

    def look(self, state: DeviceState, now: float) -> bool:
        """Return whether `state` has a new sample; if it has none, the next look is after `poll_s`.

        `cycles` counts cycles begun, so a sample that is seen late may already carry the next cycle's number.
        """
        self.next_look = now + POLL_S
        return math.isfinite(state.sample_s) and (
            self.key is None or (state.sample_s != self.key[0] and state.cycles >= self.key[1])
        )

    def not_taken(self, is_new: bool) -> None:
        """Note a look without a usable sample: there was none, or a fault forbids the use of a new one."""
        self._looked = not is_new

    def take(self, state: DeviceState, now: float) -> Message | None:
        """Store a new sample, seen at `now`; return a note if it came very late or the board's clock was set."""
        self.key = (state.sample_s, state.cycles)
        self.arrived_s = self.at = now
        self.od, self.temperature = state.sample_od, state.sample_temperature
        self.raw, self.blank = state.raw, state.blank
        note = self._measure_lateness(now - state.sample_s)
        self.next_look = now + CYCLE_S - (2.5 if self._looked else 20.0)
        self._looked = False
        return note

    def _measure_lateness(self, offset: float) -> Message | None:
        """Set `late_s`: this sample's offset minus the smallest recent offset. Return a note on a large step.

        A step of the board's clock looks like a late sample. Only samples that the program waited for add an offset,
        and three of them replace all older offsets.
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
