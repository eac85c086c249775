"""The overflow pump: a spare pump on a second waste tube, slightly above the first tube.

The tube draws air unless the level rises, so the pump may run all the time. Once it is ON with a target, the device
runs it every 63 s without a client (docs/device.md, Pumps). A start or end of an experiment and a restart of the device
switch it off. Nothing relies on it: the interlock's ledger ignores it. Plumbing: docs/device.md, The overflow pump.
"""

from dataclasses import dataclass

from conf.schema import check, setting
from hardware.chibio.connection import Connection
from hardware.chibio.messages import OverflowPumpAmiss, PutRight
from hardware.chibio.protocol import MAX_OVERFLOW_DUTY, PUMPS, SPARE, DeviceState
from hardware.logbook import Logbook

MIN_DUTY = 0.1  # at 1 mL/s, twice the largest feed that may be commanded


@dataclass(frozen=True)
class OverflowPumpConfig:
    """A second waste line against overflow of a vial (docs/device.md, The overflow pump); off by default.

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
        """Mean flow that the overflow pump can remove, mL/s; 0 without an overflow pump."""
        return self.duty * self.flow_ml_s if self.pump else 0.0

    def wrong(self, state: DeviceState) -> str:
        """Return what is wrong with the overflow pump in a read; "" if it runs as set, or there is none."""
        if not self.pump:
            return ""
        k = PUMPS.index(self.pump)
        if not state.pumps_on[k]:
            return "off"
        if abs(state.pump_targets[k] - self.duty) <= 1e-5:  # not nan
            return ""
        return f"at a duty of {state.pump_targets[k]:g}"


class OverflowPump:
    """The overflow pump of one reactor: checked with every read, corrected, read back.

    Attributes: trouble: why the pump could not be verified on, None if it was. was_on: the pump was verified on before.
    """

    def __init__(self, connection: Connection, config: OverflowPumpConfig, book: Logbook) -> None:
        self.trouble: OverflowPumpAmiss | None = None
        self.was_on = False
        self._connection, self._config, self._book = connection, config, book

    def keep_on(self, state: DeviceState) -> DeviceState:
        """Switch the pump on at its duty if needed; return the new state. Sets `trouble`. Raises: ReactorError."""
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
