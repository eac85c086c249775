"""The overflow pump: a second waste tube a little above the first, on a spare pump that the device runs by itself.

It sucks air unless the level rises, so it may run all the time: `target` = duty and ON, and the pump repeats that every
63 s without a client (docs/device.md, Pumps), whatever becomes of doses, trips and this program. The experiment cycle
does not look at Pump3 and Pump4; a start or end of an experiment and a restart of the device switch them
off. Nothing relies on it: the interlock's ledger does not know of it. Plumbing: docs/device.md, The overflow pump.
"""

from dataclasses import dataclass

from conf.schema import check, setting
from hardware.chibio.connection import Connection
from hardware.chibio.messages import OverflowPumpAmiss, PutRight
from hardware.chibio.protocol import MAX_OVERFLOW_DUTY, PUMPS, SPARE, DeviceState
from hardware.logbook import Logbook

MIN_DUTY = 0.1  # with a pump of 1 mL/s twice as much as the feed pump may ever be told to deliver


@dataclass(frozen=True)
class OverflowPumpConfig:
    """A second waste line that keeps a vial from overflowing (docs/device.md, The overflow pump); none as a rule.

    Raises: ValueError naming key, value and allowed range.
    """

    pump: str = setting("", "overflow pump; '': none (standard hardware)", choices=(*SPARE, ""))
    duty: float = setting(0.1, "fraction of every 63 s for which it runs", within=(MIN_DUTY, MAX_OVERFLOW_DUTY))
    flow_ml_s: float = setting(
        1.0, "weighed flow at full power; only for the preflight report", "mL/s", within=(0.05, 5)
    )

    def __post_init__(self) -> None:
        check(self, "overflow_pump")

    @property
    def others(self) -> tuple[str, ...]:
        """All pumps except the overflow pump: those to switch off while the run continues."""
        return tuple(p for p in PUMPS if p != self.pump)

    def others_on(self, state: DeviceState) -> str:
        return ", ".join(p for p in state.running_pumps if p in self.others)

    @property
    def removes_ml_s(self) -> float:
        """Mean flow it can take off above its tube, mL/s; 0 if there is none."""
        return self.duty * self.flow_ml_s if self.pump else 0.0

    def wrong(self, state: DeviceState) -> str:
        """Say what is wrong with the overflow pump in a read; "" if all is well, or there is none."""
        if not self.pump:
            return ""
        k = PUMPS.index(self.pump)
        if not state.pumps_on[k]:
            return "off"
        if abs(state.pump_targets[k] - self.duty) <= 1e-5:  # not nan
            return ""
        return f"at a duty of {state.pump_targets[k]:g}"


class OverflowPump:
    """The overflow pump of one reactor: looked at with every read, put right, read back.

    Attributes: trouble, why it could not be verified on, None if it was; was_on, whether it was known to be on.
    """

    def __init__(self, connection: Connection, config: OverflowPumpConfig, book: Logbook) -> None:
        self.trouble: OverflowPumpAmiss | None = None
        self.was_on = False
        self._connection, self._config, self._book = connection, config, book

    def keep_on(self, state: DeviceState) -> DeviceState:
        """Have it on with its duty; return the state then. What cannot be had is `trouble`. Raises: ReactorError."""
        config, connection = self._config, self._connection
        if not (found := config.wrong(state)):
            self.trouble, self.was_on = None, self.was_on or bool(config.pump)
            return state
        if found != "off" or state.pump_targets[PUMPS.index(config.pump)] != config.duty:
            connection.target(config.pump, config.duty)
        if found == "off":
            connection.switch(config.pump, True)
        state = connection.read()
        if still := config.wrong(state):
            self.trouble = OverflowPumpAmiss(pump=config.pump, found=still, duty=config.duty)
            return state
        known, self.trouble, self.was_on = self.was_on, None, True
        self._book.log("overflow_pump", pump=config.pump, duty=config.duty, found=found)
        if known:
            done = f"set to {config.duty:g} and on"
            self._book.tell(PutRight(item=f"overflow pump {config.pump}", found=found, done=done))
        return state
