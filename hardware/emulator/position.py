"""One position M0 to M7: its sysData, and the reactor that hangs on its cable."""

from __future__ import annotations

from typing import Any

from hardware.emulator.computer import AppError, Computer, ProcessDied
from hardware.emulator.sysdata import add_terminal, fresh_sysdata
from hardware.emulator.vial import Vial

__all__ = ["Position"]


class Position:
    """What outputs, optics and experiment of one reactor share; `data` is its sysData.

    Args:
      name: M0 to M7; computer: the board; vial: what hangs on the cable, None for an empty position;
      device_id: what its IR thermometer answers as identity; selected: reactor shown on the web page.
    """

    def __init__(self, name: str, computer: Computer, vial: Vial | None, device_id: str, selected: str) -> None:
        self.name, self.computer, self.vial, self.device_id = name, computer, vial, device_id
        self.forget(selected)

    @property
    def answers(self) -> bool:
        """Does a reactor hang on the cable?"""
        return self.vial is not None and not self.vial.faults.unplugged

    def forget(self, selected: str) -> None:
        """sysData as after power-on. A thread that runs keeps the parts of the old one it holds, as on the device."""
        self.data: dict[str, Any] = fresh_sysdata(self.device_id if self.answers else "", selected)
        self.terminal("System Initialised")

    def terminal(self, text: str) -> None:
        """One line in the web page's log."""
        add_terminal(self.data, self.computer.stamp(), text)

    def hardware(self) -> Vial:
        """The reactor behind the bus. Raises: BusStuck, ProcessDied (absent or unplugged reactor)."""
        self.computer.bus(self.name)
        if self.data["present"] == 0 or self.vial is None or self.vial.faults.unplugged:
            raise ProcessDied(f"access to absent reactor {self.name}")
        return self.vial

    def measure_temperature(self, which: str) -> None:
        """`MeasureTemp`. Raises: AppError for another name, or an internal thermometer that does not answer."""
        if which not in ("IR", "Internal", "External"):
            raise AppError(f"no thermometer {which}")
        meter = self.data[f"Thermometer{which}"]
        self.computer.bus(self.name)
        if which == "Internal" and self.data["present"] and not self.answers:
            self.data["present"] = 0
            raise AppError("internal thermometer does not answer")
        value = self.hardware().temperature(which, self.computer.now())
        meter["current"] = value if value <= 100.0 else meter["current"]
