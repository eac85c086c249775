"""What is wrong with a reactor, from what was read of it: pure functions."""

import math

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.protocol import DeviceState
from hardware.errors import DeviceStateError, IdentityError, ReactorError
from hardware.reactor import Fault

__all__ = ["describe", "diagnose", "fault_of", "regulates"]


def regulates(state: DeviceState, setpoint: float) -> bool:
    """Whether the device regulates at `setpoint`; False for nan."""
    return state.regulating and abs(state.regulation_target - setpoint) <= 1e-5


def describe(state: DeviceState) -> str:
    """Describe what the on-board regulation does."""
    return f"on-board OD regulation is {'on' if state.regulating else 'off'}, target {state.regulation_target:g}"


def diagnose(
    state: DeviceState, config: ChiBioConfig, *, age_s: float, start_time: str, blank: float, setpoint: float,
    dosing: bool, stuck: str, ended: str, overflow_trouble: str,
) -> Fault | None:  # fmt: skip
    """Find the gravest fault that a verified state shows, against how the reactor should be found.

    Args:
      age_s: of the newest sample, s. start_time: of its experiment. blank: counts.
      setpoint: OD at which it was handed over to the on-board regulation, nan if this program controls.
      dosing: its pumps may be on. stuck: why its pumps could not be verified off, "" if they were.
      ended: why this program ended its experiment, "" if it did not.
      overflow_trouble: why its overflow pump could not be verified on, "" if it was.
    """
    if state.start_time != start_time or not state.started:
        return Fault(
            "restarted",
            f"the experiment of {start_time} is gone, cycles {state.cycles}, blank {state.blank:.0f}",
            "blank and targets are restored and the experiment is started again; check the board's power",
        )
    if not state.running and ended:
        return Fault("stopped", f"this program ended the experiment: {ended}", "it is started again")
    if not state.running:
        return Fault("stopped", "the experiment was stopped by someone", "start it in the device's web page")
    if not abs(state.blank - blank) <= 0.5:  # also nan
        changed = f"the blank was changed from {blank:.1f} to {state.blank:.1f}"
        return Fault("blank", changed, f"set it back (raw {blank:.1f}, OD 0) or start a new run")
    if stuck:
        return Fault("pump", stuck, "switch the pump board off by hand")
    handed_over = math.isfinite(setpoint)
    on = config.overflow_pump.others_on(state)
    if on and not dosing and not handed_over:
        page = "close the device's web page everywhere; look for a proxy that repeats requests"
        return Fault("pump", f"pumps on: {on}, and no dose has them", page)
    if state.pumping_modes or (not regulates(state, setpoint) if handed_over else state.regulating):
        what = ", ".join(state.pumping_modes) or describe(state)
        return Fault("mode", f"{what}: not as this program left it", "set it back in the device's web page")
    if age_s > config.stale_s:
        remedy = f"after {config.lost_s:.0f} s its experiment is restarted; look at the device's terminal"
        if state.spoilt:
            remedy = f"{', '.join(state.spoilt)} holds no number: only a restart of the device's software helps"
        return Fault("stalled", f"no new sample for {age_s:.0f} s, cycles {state.cycles}", remedy)
    if overflow_trouble:
        return Fault("overflow_pump", overflow_trouble, "close the device's web page everywhere; restart the device")
    return None


def fault_of(error: ReactorError, present: bool) -> Fault:
    """Translate an error of a request or a read; `present`: the reactor was there when it was last looked at."""
    if isinstance(error, IdentityError):
        return Fault("identity", str(error), "reactors were exchanged: start a new run")
    if not isinstance(error, DeviceStateError):
        return Fault("link", str(error), "asks again every few seconds")
    if present:
        return Fault("selection", str(error), "close the device's web page everywhere")
    return Fault("absent", str(error), "plug it in with the server stopped")
