"""What is wrong with a reactor, from what was read of it: pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.onboard_regulation import describe, regulates
from hardware.chibio.protocol import DeviceState
from hardware.errors import DeviceStateError, IdentityError, ReactorError
from hardware.reactor import Fault

__all__ = ["Expected", "diagnose", "fault_of"]


@dataclass(frozen=True)
class Expected:
    """How a reactor should be found.

    start_time: of its experiment. blank: counts. setpoint: OD at which it was handed over to the on-board regulation,
    nan if this program controls. dosing: its pumps may be on. stuck: why its pumps could not be verified off, ""
    if they were. overflow_trouble: why its overflow pump could not be verified on, "" if it was.
    """

    start_time: str
    blank: float
    setpoint: float
    dosing: bool
    stuck: str
    overflow_trouble: str


def diagnose(state: DeviceState, expected: Expected, age_s: float, config: ChiBioConfig) -> Fault | None:
    """The gravest fault that a verified state shows; `age_s` is the age of the newest sample, s."""
    if state.start_time != expected.start_time or not state.started:
        return Fault(
            "restarted",
            f"the experiment of {expected.start_time} is gone, cycles {state.cycles}, blank {state.blank:.0f}",
            "blank and targets are restored and the experiment is started again; check the board's power",
        )
    if not state.running:
        return Fault("stopped", "the experiment was stopped by someone", "start it in the device's web page")
    if abs(state.blank - expected.blank) > 0.5:
        return Fault(
            "blank",
            f"the blank was changed from {expected.blank:.1f} to {state.blank:.1f}",
            f"set it back (raw {expected.blank:.1f}, OD 0) or start a new run",
        )
    if expected.stuck:
        return Fault("pump", expected.stuck, "switch the pump board off by hand")
    handed_over = math.isfinite(expected.setpoint)
    on = config.overflow_pump.others_on(state)
    if on and not expected.dosing and not handed_over:
        return Fault("pump", f"pumps on: {on}, not by this program", "close the device's web page everywhere")
    if state.pumping_modes or (not regulates(state, expected.setpoint) if handed_over else state.regulating):
        what = ", ".join(state.pumping_modes) or describe(state)
        return Fault("mode", f"{what}: not as this program left it", "set it back in the device's web page")
    if age_s > config.stale_s:
        return Fault(
            "stalled",
            f"no new sample for {age_s:.0f} s, cycles {state.cycles}",
            f"after {config.lost_s:.0f} s its experiment is restarted; look at the device's terminal",
        )
    if trouble := expected.overflow_trouble:
        return Fault("overflow_pump", trouble, "close the device's web page everywhere; restart the device")
    return None


def fault_of(error: ReactorError, present: bool) -> Fault:
    """What an error of a request or a read means; `present`: the reactor was there when it was last looked at."""
    if isinstance(error, IdentityError):
        return Fault("identity", str(error), "reactors were exchanged: start a new run")
    if not isinstance(error, DeviceStateError):
        return Fault("link", str(error), "check cable, network and server")
    if present:
        return Fault("selection", str(error), "close the device's web page everywhere")
    return Fault("absent", str(error), "plug it in with the server stopped")
