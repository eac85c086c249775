"""The emulated Chi.Bio as a family: the driver of the real device, and an emulator that the run starts."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from envs.bench import Bench
from envs.plant.plant import OPTIONS, PlantConfig, with_options
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.chibio.family import ChiBioFamily, Link, linked
from hardware.clock import VirtualClock
from hardware.emulator.device import plant_preset
from hardware.emulator.process import EmulatorProcess
from hardware.emulator.server import build, parser
from hardware.emulator.transport import EmulatorTransport

log = logging.getLogger(__name__)
EMULATED = ("speed", "seed", "od", "plant")  # settings of backend=emulator that become options of its process


def _words(backend: EmulatorConfig, bench: Bench) -> list[str]:
    arguments = {"reactors": ",".join(backend.reactors), **{k: getattr(backend, k) for k in EMULATED}, **_told(backend)}
    arguments["volume"] = ",".join(f"{ml:g}" for ml in bench.volumes(backend.reactors))
    if (overflow := backend.overflow_pump).pump:
        arguments |= {"overflow-pump": overflow.pump, "overflow-flow": overflow.flow_ml_s}
    arguments |= {f"{pump.lower()}-flow": backend.supply.flow_ml_s(pump) for pump in backend.supply.pumps}
    return [word for k, v in arguments.items() for word in (f"--{k}", str(v))]


def _told(backend: EmulatorConfig) -> dict[str, str]:
    return {key: getattr(backend, key, usual) for key, (usual, _, _) in OPTIONS.items()}


class EmulatorFamily(ChiBioFamily):
    """An emulated device that a run starts, and that ends with the run."""

    config = EmulatorConfig
    called = "the emulated device"
    at_stake = False

    @contextmanager
    def linked(self, backend: ChiBioConfig, bench: Bench) -> Iterator[Link]:
        """Start a device that ends with the run: a process, or at speed 0 an object on a virtual clock."""
        assert isinstance(backend, EmulatorConfig)
        if not backend.speed:
            log.info("emulated device inside this program, in virtual time")
            clock = VirtualClock()
            yield EmulatorTransport(build(parser().parse_args(_words(backend, bench)), clock)), clock
            return
        with EmulatorProcess(_words(backend, bench)) as device:
            url, control = device.url, device.control
            log.info("emulated device at %s, %g times real time; faults at %s", url, backend.speed, control)
            with linked(backend, url) as link:
                yield link

    def holding(self, backend: EmulatorConfig, preset: str, **values: Any) -> EmulatorConfig:
        plant = preset if backend.plant == EmulatorConfig().plant else backend.plant
        return replace(backend, plant=plant, **values)

    def vials(self, backend: EmulatorConfig, plant: PlantConfig) -> tuple[str, PlantConfig]:
        return "backend.plant", with_options(plant_preset(backend.plant), _told(backend))

    def address(self, backend: ChiBioConfig) -> str:
        return "in this computer"

    def start_od(self, backend: EmulatorConfig, plant: PlantConfig) -> float:
        return backend.od


FAMILY = EmulatorFamily()
