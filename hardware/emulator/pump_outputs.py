"""The device's pump threads: a pump that is on repeats its dose every 63 s."""

from __future__ import annotations

import math

from hardware.emulator.computer import AppError
from hardware.emulator.events import Steps
from hardware.emulator.position import Position
from hardware.emulator.sysdata import PUMPS
from hardware.emulator.vial_config import VialConfig

__all__ = ["PERIOD_FACTOR", "PumpOutputs"]

PERIOD_FACTOR = 1.05  # pump period over cycle time: 63 s
OFF_SHARE, QUIET_SHARE = 0.2, 0.8  # of a pump's start delay: until a running motor stops, until the pause is counted


class PumpOutputs:
    """The threads of the four pumps of one reactor."""

    def __init__(self, position: Position) -> None:
        self._position = position
        self.forget()

    def forget(self) -> None:
        """No thread counted; threads of before stay alive, as they do on the device."""
        self._threads = dict.fromkeys(PUMPS, 0)

    def start(self, item: str) -> None:
        """A thread that makes the motor do what `ON` and `target` say."""
        self._position.computer.spawn(self._period(item), f"{self._position.name}/{item}")

    def _period(self, item: str) -> Steps:
        """`PumpModulation`: one period of 63 s; a newer thread of the same pump takes over.

        Five registers are written one after another: In1, In2, In1, In2 to off, then the one that drives to on.
        """
        pump, computer = self._position.data[item], self._position.computer
        mine = self._threads[item] = (self._threads[item] + 1) % 100
        config = self._position.vial.config if self._position.vial is not None else VialConfig()
        delay = computer.uniform(config.pump_start_low_s, config.pump_start_high_s)
        yield OFF_SHARE * delay
        if abs(pump["target"] * pump["ON"]) != 1 and mine == self._threads[item]:
            self._position.hardware().drive(item, 0, computer.now())
        yield (QUIET_SHARE - OFF_SHARE) * delay
        if pump["ON"] == 0:
            return
        began = computer.wall()
        period = PERIOD_FACTOR * self._position.data["Experiment"]["cycleTime"]
        on_s = period * abs(pump["target"])
        if math.isnan(on_s):
            raise AppError("sleep length is not a number")
        yield (1.0 - QUIET_SHARE) * delay
        vial = self._position.hardware()
        if mine == self._threads[item] and pump["target"] != 0:
            vial.drive(item, 1 if pump["target"] > 0 else -1, computer.now())
        yield on_s + computer.uniform(vial.config.on_time_bias_low_s, vial.config.on_time_bias_high_s)
        if abs(pump["target"]) != 1 and mine == self._threads[item]:
            self._position.hardware().drive(item, 0, computer.now())
        pause = period - round(computer.wall() - began, 2)
        if pause > 0.0:
            yield pause
        if pump["ON"] == 1 and mine == self._threads[item]:
            self.start(item)
