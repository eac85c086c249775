"""What the device's software does for one reactor.

Every activity that the device runs in a thread, or that makes a caller wait, is a generator that yields the seconds it
sleeps; `ChiBioDevice` runs them on device time. Races between threads of the real software are therefore the same races
between generators. Source: docs/device.md, checked against runs of the real software described there.
"""

from __future__ import annotations

from hardware.emulator.computer import Computer
from hardware.emulator.experiment import Experiment
from hardware.emulator.optics import Optics
from hardware.emulator.outputs import Outputs
from hardware.emulator.position import Position
from hardware.emulator.vial import Vial

__all__ = ["ReactorApp"]


class ReactorApp(Position):
    """A position with its outputs, its optics and its experiment; arguments as `Position`."""

    def __init__(self, name: str, computer: Computer, vial: Vial | None, device_id: str, selected: str) -> None:
        super().__init__(name, computer, vial, device_id, selected)
        self.outputs = Outputs(self)
        self.optics = Optics(self, self.outputs)
        self.experiment = Experiment(self, self.outputs, self.optics)

    def initialise(self, selected: str) -> None:
        """`initialise()`: everything forgotten. Threads of before stay alive, as they do on the device."""
        self.forget(selected)
        self.outputs.forget()
        self.experiment.forget()
