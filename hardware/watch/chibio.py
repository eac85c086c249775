"""A Chi.Bio that is only read: a GET, whose reply has the sample and the feed pump's commands since the last sample.

The device shows the reactor that is selected in its web page. A selection is a command, so this program selects none.
"""

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hardware.chibio.messages import WrongStatus
from hardware.chibio.protocol import FEED, DeviceState, parse_state
from hardware.chibio.sampling import POLL_S
from hardware.clock import Clock
from hardware.errors import ReactorError
from hardware.link.transport import Reply
from hardware.messages import Fault
from hardware.reactor import Measurement, Vitals
from hardware.watch import messages
from hardware.watched import Watched

AGAIN_S = 20.0  # from one `measure` without a sample to the next
CYCLE_S = 56.0  # shortest time between two samples


class WatchedChiBio(Watched):
    """One reactor that something else regulates, read by `get` every POLL_S. Args: flow_ml_s: flow of the feed pump."""

    def __init__(self, get: Callable[[str], Reply], clock: Clock, name: str, flow_ml_s: float) -> None:
        super().__init__((name,))
        self._get, self._clock, self._flow_ml_s = get, clock, flow_ml_s
        self._began_s = self._arrived_s = clock.now()
        self._sample_s, self._device_id = math.nan, ""
        self._newest = np.full(5, math.nan)  # at, OD, temperature, raw, blank

    def elapsed(self) -> float:
        return self._clock.now() - self._began_s

    def measure(self) -> Measurement:
        self._clock.sleep(max(self._arrived_s + CYCLE_S - self._clock.now(), 0.0))
        until_s, fault, fresh = self._clock.now() + AGAIN_S, None, False
        while not fresh and self._clock.now() < until_s:
            self._clock.sleep(POLL_S)
            try:
                fresh, fault = self._look()
            except ReactorError as error:
                fault = messages.NotHeardOf(error=error)
        at, od, warm, raw, blank = self._newest[:, None]
        age = np.full(1, self._clock.now() - self._arrived_s)
        return Measurement(at, od, warm, np.full(1, fresh), Vitals(age, raw, (fault,), blank))

    def _look(self) -> tuple[bool, Fault | None]:
        reply = self._get("/getSysdata/")
        if reply.status != 200:
            raise WrongStatus(request="GET /getSysdata/", status=reply.status, expected=200)
        state, (name,) = parse_state(reply.body), self.names
        if state.selected != name:
            return False, messages.OtherShown(shown=state.selected, reactor=name)
        if self._device_id not in ("", state.device_id):
            return False, messages.OtherUnit(unit=state.device_id)
        self._device_id = state.device_id
        if not state.running:
            return False, messages.NotRunning()
        if not math.isfinite(state.sample_s) or state.sample_s == self._sample_s:
            return False, None
        if not math.isnan(self._sample_s):
            self.seen(float(self._newest[0]), np.full(1, self._fed_ml(json.loads(reply.body), state)))
        self._sample_s, self._arrived_s = state.sample_s, self._clock.now()
        self._newest[:] = self.elapsed(), state.sample_od, state.sample_temperature, state.raw, state.blank
        return True, None

    def _fed_ml(self, data: dict[str, Any], state: DeviceState) -> float:
        """Return the volume commanded since the last sample; the duty of a record is valid until the next record."""
        times, duties = (data[key].get("record", []) for key in ("time", FEED))
        n = min(len(times), len(duties))
        time, duty = np.array(times[len(times) - n :], dtype=float), np.array(duties[len(duties) - n :], dtype=float)
        since = time >= self._sample_s if state.sample_s > self._sample_s else time >= state.sample_s
        return float(self._flow_ml_s * np.sum((duty[:-1] * np.diff(time))[since[:-1]]))
