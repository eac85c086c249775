"""The hand-over of a reactor to the device's own OD regulation, which feeds at most 0.02 of full power."""

import math

from hardware.chibio.connection import Connection
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.protocol import DeviceState
from hardware.errors import DeviceStateError
from hardware.logbook import Logbook

__all__ = ["OnboardRegulation", "describe", "regulates"]


def regulates(state: DeviceState, setpoint: float) -> bool:
    """Whether the device regulates at `setpoint`; False for nan."""
    return state.regulating and abs(state.regulation_target - setpoint) <= 1e-5


def describe(state: DeviceState) -> str:
    """Describe what the on-board regulation does."""
    return f"on-board OD regulation is {'on' if state.regulating else 'off'}, target {state.regulation_target:g}"


class OnboardRegulation:
    """Who controls one reactor: this program, or, once it was handed over, the device.

    Attributes: setpoint, the OD at which it was handed over; nan while this program controls.
    """

    def __init__(self, connection: Connection, overflow_pump: OverflowPumpConfig, book: Logbook) -> None:
        self._connection, self._overflow_pump, self._book = connection, overflow_pump, book
        self.setpoint = math.nan

    @property
    def active(self) -> bool:
        """Whether the reactor was handed over."""
        return math.isfinite(self.setpoint)

    def hand_over(self, setpoint: float) -> None:
        """Pumps off, then target and ON, read back.

        Written down before it is done: a run that is killed in between hands over when it is resumed.
        Raises: ReactorError.
        """
        connection = self._connection
        connection.pumps_off(pumps=self._overflow_pump.others)
        self._book.log("regulate", setpoint=setpoint)
        connection.target("OD", setpoint)
        connection.switch("OD", True)
        state = connection.read()
        if not regulates(state, setpoint):
            raise DeviceStateError(f"{connection.name}: {describe(state)} after it was switched on at {setpoint:g}")
        self.setpoint = setpoint

    def hand_over_again(self) -> None:
        """Hand over again where a restart of program or device ended it. Raises: ReactorError."""
        state = self._connection.read()
        what = "left to it"
        if not regulates(state, self.setpoint):
            self.hand_over(self.setpoint)
            what = f"handed over again, because its {describe(state)}"
        self._book.tell(f"handed over to the on-board regulation at OD {self.setpoint:g} earlier in this run: {what}")

    def take_back(self) -> None:
        """Switch it off for good, if the reactor was handed over. Raises: ReactorError."""
        if self.active:
            self._connection.switch("OD", False)
            self._book.log("regulate", setpoint=None)
            self.setpoint = math.nan
            self._book.tell("on-board regulation switched off: the reactor is given up")

    def switch_off(self) -> None:
        """Switch off what was found on, or it would switch the pumps on again. Raises: ReactorError."""
        self._connection.switch("OD", False)
        if not self.active:
            self._book.tell("the on-board OD regulation was found on and switched off: this run controls")
