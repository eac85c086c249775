"""Diagnosis of a reactor from its state, as pure functions."""

import math

from hardware.chibio import messages
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.protocol import DeviceState
from hardware.errors import DeviceStateError, IdentityError, ReactorError
from hardware.messages import Fault


def regulates(state: DeviceState, setpoint: float) -> bool:
    """Return whether the device regulates at `setpoint`; False for nan."""
    return state.regulating and abs(state.regulation_target - setpoint) <= 1e-5


def describe(state: DeviceState) -> str:
    return f"on-board OD regulation is {'on' if state.regulating else 'off'}, target {state.regulation_target:g}"


def diagnose(
    state: DeviceState, config: ChiBioConfig, *, age_s: float, start_time: str, blank: float, setpoint: float,
    dosing: bool, stuck: str, ended: str, overflow_trouble: Fault | None,
) -> Fault | None:  # fmt: skip
    """Find the most serious fault that a verified state shows; None if the reactor is as the run expects.

    Args: age_s: age of the newest sample, s. start_time: start of the run's experiment. blank: the run's blank, counts.
      setpoint: OD of the hand-over to the on-board regulation, nan if this program controls. dosing: pumps may be on.
      stuck: why the pumps could not be verified off, or "". ended: why this program ended the experiment, or "".
      overflow_trouble: fault of the overflow pump.
    """
    if state.start_time != start_time or not state.started:
        return messages.ExperimentGone(start_time=start_time, cycles=state.cycles, blank=state.blank)
    if not state.running:
        return messages.EndedByUs(why=ended) if ended else messages.EndedBySomebody()
    if not abs(state.blank - blank) <= 0.5:  # also nan
        return messages.BlankChanged(before=blank, now=state.blank)
    if stuck:
        return messages.PumpStaysOn(why=stuck)
    handed_over = math.isfinite(setpoint)
    on = config.overflow_pump.others_on(state)
    if on and not dosing and not handed_over:
        return messages.StrayPump(pumps=on)
    if state.pumping_modes or (not regulates(state, setpoint) if handed_over else state.regulating):
        return messages.ForeignMode(mode=", ".join(state.pumping_modes) or describe(state))
    if age_s > config.stale_s and state.spoilt:
        return messages.NoNumber(age_s=age_s, cycles=state.cycles, items=", ".join(state.spoilt))
    if age_s > config.stale_s:
        return messages.NoSamples(age_s=age_s, cycles=state.cycles, lost_s=config.lost_s)
    return overflow_trouble


def fault_of(error: ReactorError, present: bool) -> Fault:
    """Translate an error of a request into a fault. Args: present: the reactor was present at the last read."""
    if isinstance(error, IdentityError):
        return messages.ReactorsExchanged(error=error)
    if not isinstance(error, DeviceStateError):
        return messages.NoAnswer(error=error)
    return messages.SelectedElsewhere(error=error) if present else messages.ReactorMissing(error=error)
