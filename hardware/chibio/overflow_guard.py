"""The overflow guard: a second waste tube a little above the first, on a spare pump that the device runs by itself.

It sucks air unless the level rises, so it may run all the time: `target` = duty and ON, and the pump repeats that every
63 s without a client (chibio.md section 5.1), whatever becomes of doses, trips and this program. The experiment cycle
does not look at Pump3 and Pump4 (section 3); a start or end of an experiment and a restart of the device switch them
off. Nothing relies on it: the interlock's ledger does not know of it. Plumbing: docs/chibio.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from conf.schema import check, setting
from hardware.chibio.connection import Log, Unit
from hardware.chibio.protocol import MAX_GUARD_DUTY, PUMPS, SPARE, DeviceState

__all__ = ["Guard", "GuardConfig"]

MIN_DUTY = 0.1  # with a pump of 1 mL/s twice as much as the feed pump may ever be told to deliver


@dataclass(frozen=True)
class GuardConfig:
    """A second waste line that keeps a vial from overflowing (docs/chibio.md); none as a rule.

    Raises: ValueError naming key, value and allowed range.
    """

    pump: str = setting("", "of the second line; '': there is none, the standard hardware", choices=(*SPARE, ""))
    duty: float = setting(0.1, "share of every 63 s in which it runs", within=(MIN_DUTY, MAX_GUARD_DUTY))
    flow_ml_s: float = setting(
        1.0, "at full power, as weighed; only for what the preflight says", "mL/s", within=(0.05, 5)
    )

    def __post_init__(self) -> None:
        check(self, "guard")

    @property
    def others(self) -> tuple[str, ...]:
        """The pumps that are not the guard's: what is switched off wherever a run goes on."""
        return tuple(p for p in PUMPS if p != self.pump)

    @property
    def removes_ml_s(self) -> float:
        """Mean flow it can take off above its tube, mL/s; 0 without a guard."""
        return self.duty * self.flow_ml_s if self.pump else 0.0

    def astray(self, state: DeviceState) -> str:
        """What a read shows of the guard that is not as it must be; "" if all is well, or there is none."""
        if not self.pump:
            return ""
        k = PUMPS.index(self.pump)
        if not state.pumps_on[k]:
            return "off"
        wrong = not abs(state.pump_targets[k] - self.duty) <= 1e-5  # also nan
        return f"at a duty of {state.pump_targets[k]:g}" if wrong else ""


class Guard:
    """The guard of one reactor: looked at with every read, put right, read back.

    Args:
      unit: the reactor's verified conversation. config: of the guard.
      log: told of every time it was switched on and verified. tell: takes a note, if it had been on before.
    Attributes: trouble, why it could not be verified on, "" if it was; was_on, whether it was known to be on; tried,
      whether it may have been switched on here.
    """

    def __init__(self, unit: Unit, config: GuardConfig, log: Log, tell: Callable[[str], None]) -> None:
        self.config = config
        self.trouble, self.was_on, self.tried = "", False, False
        self._unit, self._log, self._tell = unit, log, tell

    def keep(self, state: DeviceState) -> DeviceState:
        """Have the guard on with its duty; the reactor's state then. What cannot be had becomes `trouble`.

        Args: state: just read. Raises: as `Unit.post` and `Unit.read`.
        """
        config, unit = self.config, self._unit
        if not (found := config.astray(state)):
            self.trouble, self.was_on = "", self.was_on or bool(config.pump)
            return state
        self.tried = True
        if found != "off" or state.pump_targets[PUMPS.index(config.pump)] != config.duty:
            unit.target(config.pump, config.duty)
        if found == "off":
            unit.switch(config.pump, True)
        state = unit.read()
        if still := config.astray(state):
            self.trouble = f"the overflow guard, {config.pump}, is {still} after it was set to {config.duty:g} and on"
            return state
        known, self.trouble, self.was_on = self.was_on, "", True
        self._log("guard", {"reactor": unit.name, "pump": config.pump, "duty": config.duty, "found": found})
        if known:
            self._tell(f"the overflow guard was found {found} and put right: {config.pump} at {config.duty:g}")
        return state
