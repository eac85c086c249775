"""The whole device on device time: computer, software and reactors, and how requests reach it.

`ChiBioDevice` needs no thread and no socket. Requests are submitted, and answered while events run: by `run_until` on a
virtual clock, by `hardware/emulator/server.py` in real time. Source: docs/device.md, Hardware, Routes and Failures.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from conf.presets import load
from conf.schema import build, check, part, setting
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from hardware.clock import Clock
from hardware.emulator.computer import HARDWARE, AppError, BusStuck, Computer, Due, ProcessDied, Steps
from hardware.emulator.routes import Exchange
from hardware.emulator.software import ReactorApp
from hardware.emulator.supervisor import REQUEST, Supervisor
from hardware.emulator.sysdata import ALL_REACTORS
from hardware.emulator.vial import FEED, Vial, VialConfig


@functools.cache
def plant_preset(name: str) -> PlantConfig:
    """Load the preset `conf/plant/NAME.yaml` with pulse dosing, the only dosing of the device. Raises: ValueError.

    A vial uses only the noise-free value of the preset's sensor; noise, misreadings and counts are in `VialConfig`.
    """
    plant = build(PlantConfig(), load(f"plant/{name}"), "plant")
    return replace(plant, pump=replace(plant.pump, dosing="pulse"))


@dataclass(frozen=True)
class DeviceOptions:
    unit: int = setting(0, "number of the device; different devices have different identities", at_least=0)
    vial: VialConfig = part(VialConfig, "optics and electronics")
    plant: PlantConfig = part(lambda: plant_preset("healthy"), "cultures and pumps, with pulse dosing")

    def __post_init__(self) -> None:
        check(self, "emulator")
        if self.plant.pump.dosing != "pulse":
            raise ValueError("emulator.plant.pump.dosing = continuous: allowed pulse, as the device's pumps work")


def _each(what: str, given: float | Sequence[float], n: int) -> list[float]:
    values = [float(given)] * n if isinstance(given, (int, float)) else [float(x) for x in given]
    if len(values) != n:
        raise ValueError(f"{what} has {len(values)} values: allowed 1 or {n}, one per reactor")
    return values


class ChiBioDevice:
    """A Chi.Bio control computer with reactors.

    Args: reactors: positions with a reactor plugged in. clock: device seconds; `handle` sleeps on it. rng: source of
      all noise, a stream per reactor. od: initial OD. volumes_ml: culture volume up to the waste tube. Each is one
      value for all reactors or one per reactor. temperature: of the vials, degC. blanked: start with the blanks of
      clear medium; False: 65000, as after power-on.
    Raises: ValueError for an unknown or repeated position or a wrong number of ODs.
    """

    def __init__(
        self,
        reactors: Sequence[str],
        clock: Clock,
        rng: np.random.Generator,
        options: DeviceOptions | None = None,
        od: float | Sequence[float] = 0.3,
        temperature: float = 24.0,
        blanked: bool = False,
        volumes_ml: float | Sequence[float] = Bench.volume_ml,
    ) -> None:
        if not reactors or len(set(reactors)) != len(reactors) or not set(reactors) <= set(ALL_REACTORS):
            raise ValueError(f"reactors = {','.join(reactors)}: allowed a list of different names from M0 to M7")
        ods, tubes_ml = _each("od", od, len(reactors)), _each("volume", volumes_ml, len(reactors))
        self.clock, self.options = clock, options or DeviceOptions()
        o = self.options
        noise, *streams = rng.spawn(1 + len(reactors))
        self.computer = Computer(clock.now(), noise, o.unit)
        self.faults, self._events = self.computer.faults, self.computer.events
        self.vials: dict[str, Vial] = {}
        for name, stream, start_od, tube_ml in zip(reactors, streams, ods, tubes_ml, strict=True):
            plant_stream, vial_stream = stream.spawn(2)
            plant = Plant(o.plant, 1, [plant_stream], tube_ml)
            plant.reset(start_od, temperature)
            self.vials[name] = Vial(plant, o.vial, vial_stream, clock.now())
        self.supervisor = Supervisor(self.computer, self.vials)
        for name, vial in self.vials.items() if blanked else ():
            self.apps[name].data["OD0"]["target"] = round(vial.spectrometer.blank)

    @property
    def apps(self) -> dict[str, ReactorApp]:
        """The apps of the positions M0 to M7 in the current, or last, software process."""
        return self.supervisor.software.apps

    def next_time(self) -> float:
        return self._events.next_time()

    def run_until(self, t: float) -> None:
        """Run every event due up to device time `t`."""
        for event in self._events.due(t):
            self._resume(event)

    def _resume(self, event: Due) -> None:
        events, computer = self._events, self.computer
        try:
            pause = next(event.steps)
        except StopIteration:
            return
        except BusStuck:
            pause = math.inf
        except ProcessDied as problem:
            computer.note(f"{event.owner}: {problem}")
            self.supervisor.exit()
            return
        except (AppError, ArithmeticError, LookupError, TypeError, ValueError) as problem:
            computer.note(f"{event.owner}: {type(problem).__name__}: {problem}")  # the thread ends silently
            return
        deadline = self.supervisor.deadline
        if event.owner == REQUEST and events.now + pause > deadline:
            events.add(deadline - events.now, self._time_out(), event.life, event.owner)
        elif pause < math.inf:
            events.add(pause, event.steps, event.life, event.owner)
        if self.faults.bus_stuck_when_pumping and any(vial.motor(FEED) for vial in self.vials.values()):
            self.faults.bus_stuck, self.faults.bus_stuck_when_pumping = True, False

    def _time_out(self) -> Steps:
        self.supervisor.kill_worker()
        yield from ()

    def submit(self, method: str, path: str, headers: Mapping[str, str] | None = None) -> Exchange:
        """Submit a request to the server; its answer is there when events have run until it is `done`."""
        exchange = Exchange(method, path, headers or {})
        if not self.supervisor.alive:
            exchange.fate = "refused"
        elif self.faults.take("lost_request"):
            exchange.fate = "lost"
        elif self.faults.take("reset_before"):
            exchange.fate = "reset"
        else:
            self._events.add(self.faults.slow_s, self._arrive(exchange), HARDWARE, "network")
            self.run_until(self._events.now)
        return exchange

    def _arrive(self, exchange: Exchange) -> Steps:
        if self.supervisor.alive:
            self.supervisor.accept(exchange)
        else:
            exchange.fate = "refused"
        yield from ()

    def handle(self, method: str, path: str, headers: Mapping[str, str] | None = None) -> tuple[int, bytes]:
        """Submit a request, wait on the clock, return status and body. Raises: ConnectionError if no answer comes."""
        self.run_until(self.clock.now())
        exchange = self.submit(method, path, headers)
        while not exchange.done:
            self.clock.sleep(self.next_time() - self.clock.now())
            self.run_until(self.clock.now())
        if exchange.answer is None:
            raise ConnectionError(exchange.fate)
        return exchange.answer[:2]

    def truth(self, name: str) -> dict[str, Any]:
        """Return the true state of one reactor. Raises: KeyError for a position without a reactor."""
        return {"device_s": self._events.now} | self.vials[name].truth(self._events.now)
