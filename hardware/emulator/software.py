"""The device's software between two starts: one app per position, and the position that the web page shows.

Every activity that the device runs in a thread, or that makes a caller wait, is a generator that yields the seconds it
sleeps; `ChiBioDevice` runs the generators on device time. They race as the threads of the real software do. Source:
docs/device.md, checked against runs of the real software described there.
"""

import json
import re
from collections.abc import Mapping

from hardware.emulator.computer import Computer
from hardware.emulator.experiment import Experiment
from hardware.emulator.optics import Optics
from hardware.emulator.outputs import Outputs, Position
from hardware.emulator.sysdata import ALL_REACTORS
from hardware.emulator.vial import Vial


class ReactorApp(Position):
    """A position with its outputs, its optics and its experiment; arguments as `Position`."""

    def __init__(self, name: str, computer: Computer, vial: Vial | None, device_id: str, selected: str) -> None:
        super().__init__(name, computer, vial, device_id, selected)
        self.outputs = Outputs(self)
        self.optics = Optics(self, self.outputs)
        self.experiment = Experiment(self, self.outputs, self.optics)

    def initialise(self, selected: str) -> None:
        """Reset everything, as `initialise()` does. Earlier threads stay alive, as on the device."""
        self.forget(selected)
        self.outputs.forget()
        self.experiment.forget()


class Software:
    """Memory of one process; at first every position is as after `initialise()`. Args: vials: by position."""

    def __init__(self, computer: Computer, vials: Mapping[str, Vial]) -> None:
        self.computer, self.selected = computer, "M0"
        self._reactors = tuple(vials)
        self.apps = {
            name: ReactorApp(name, computer, vials.get(name), device_id(name, computer.unit), self.selected)
            for name in ALL_REACTORS
        }

    def app(self, name: str) -> ReactorApp:
        """Return the app of a position in a route; "0" is the selected position. Raises: KeyError."""
        return self.apps[self.selected if name == "0" else name]

    def select(self, name: str) -> None:
        self.selected = name
        for app in self.apps.values():
            app.data["UIDevice"] = name

    def foreign_select(self) -> None:
        """Select another reactor, as another client's page does, with the probability of the fault foreign_selects."""
        rng, faults = self.computer.rng, self.computer.faults
        if len(self._reactors) > 1 and rng.random() < faults.foreign_selects:
            self.select(str(rng.choice([m for m in self._reactors if m != self.selected])))

    def shown(self, name: str) -> None:
        """Note that a client received all records of reactor `name`."""
        app = self.apps[name]
        if app.vial is not None and app.data["time"]["record"]:
            app.vial.reads.append(self.computer.now())

    def sysdata(self) -> bytes:
        """Return the body of getSysdata: state of the selected reactor, sorted keys, NaN as a bare token."""
        data, faults = self.apps[self.selected].data, self.computer.faults
        data["presentDevices"] = {name: app.data["present"] for name, app in self.apps.items()}
        if faults.terminal_as_list or faults.terminal_named or faults.extra_fields:
            data = dict(data)
        if faults.terminal_named:
            text = re.sub(
                r" - (Experiment|Terminal|Cycle \d+) (St|C)",
                rf" - \1 on {self.selected} ({data['DeviceID']}) \2",
                data["Terminal"]["text"],
            )
            data["Terminal"] = {"text": text}
        if faults.terminal_as_list:
            data["Terminal"] = {"text": [line for line in data["Terminal"]["text"].split("</br>") if line]}
        if faults.extra_fields:
            data |= {"DeviceName": "", "Pump5": {"ON": 0, "target": 0.0}}
        return json.dumps(data, sort_keys=True, separators=(",", ":")).encode() + b"\n"


def device_id(name: str, unit: int) -> str:
    """Return the four ID words of a position's IR thermometer, as joined decimals; unique for unit and position."""
    k = int(name[1])
    return f"{1000 + k}{2000 + 7 * k}{3000 + 11 * k + 100 * (unit // 40000)}{4000 + 13 * k + unit % 40000}"
