"""Chi.Bio reactors as a family: the link to the device, its preflight, its calibrations, its spare pumps."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

from envs.bench import VIAL_ML, Bench
from hardware.chibio.calibrations import load_calibrations
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import identity
from hardware.chibio.preflight import preflight
from hardware.chibio.protocol import CONTROL_S, LEAST_ML
from hardware.chibio.reactors import ChiBioReactors
from hardware.chibio.resume import replay
from hardware.clock import Clock, DeviceClock
from hardware.errors import UnfitError
from hardware.family import Can, Check, Family, Opening, not_looked_at, report
from hardware.link.open import DeviceLock, open_transport
from hardware.link.transport import Transport
from hardware.reactor import Array, Reactor, left_off

Link = tuple[Transport, Clock]


@contextmanager
def linked(backend: ChiBioConfig, own_url: str = "") -> Iterator[Link]:
    """Open the link to a device, for this client alone, and the device's clock.

    Args: own_url: address of a device that was started for this run; replaces the config's address.
    Raises: ReactorError if nothing answers, or another client on this computer uses the device, under any name.
    """
    with ExitStack() as stack:
        url = own_url or backend.url
        transport = stack.enter_context(open_transport(backend.transport, url, backend.speed))
        clock = DeviceClock(backend.speed)
        if not own_url:
            where = backend.transport.port if backend.transport.kind == "serial" else url
            stack.enter_context(closing(DeviceLock(f"the device with reactor {identity(transport, clock, where)}")))
        yield transport, clock


class ChiBioFamily(Family):
    """One device with up to eight reactors."""

    config = ChiBioConfig
    can = Can(fluorescence=True, spare_pumps=(3, 4), thermostat=True, regulation=True, resume=True)
    called = "the Chi.Bio"

    def linked(self, backend: ChiBioConfig, bench: Bench) -> AbstractContextManager[Link]:
        """Open the device of a config: its link and its clock. Raises: ReactorError."""
        return linked(backend)

    @contextmanager
    def open(self, opening: Opening) -> Iterator[Reactor]:
        backend, earlier = opening.backend, opening.earlier()
        with ExitStack() as stack:
            with not_looked_at(opening.resumed):
                transport, clock = stack.enter_context(self.linked(backend, opening.bench))
                calibrations = load_calibrations(Path(backend.calibration), backend.reactors)
                if not earlier:
                    report(preflight(transport, clock, backend, calibrations, opening.folder, opening.bench))
                reactors = ChiBioReactors(
                    transport, clock, backend, calibrations, opening.journal.append, opening.bench
                )
            elapsed_s = opening.elapsed_s(backend.speed, *reactors.bounds_s(earlier))
            reactors.begin(replay(earlier), elapsed_s)
            with left_off(reactors):
                yield reactors

    def preflight(self, backend: ChiBioConfig, bench: Bench, folder: Path) -> list[Check]:
        calibrations = load_calibrations(Path(backend.calibration), backend.reactors)
        with self.linked(backend, bench) as (transport, clock):
            return preflight(transport, clock, backend, calibrations, folder, bench)

    def tube(self, backend: ChiBioConfig, number: int, most_ml: float, who: str) -> None:
        key, pump = f"backend.supply.pump{number}_ml_s", f"Pump{number}"
        if pump not in backend.supply.pumps:
            remedy = f"weigh its flow at full power (docs/scenarios.md) and set {key}"
            raise UnfitError(f"{who}: {pump} has no tube; {remedy}")
        if (can := backend.supply.most_ml(pump)) < most_ml - 1e-9:
            remedy = f"allowed {most_ml:.2f} mL or more; use a wider tube or a smaller bench.max_rate"
            raise UnfitError(f"{key}: {pump} gives at most {can:.2f} mL a dose: {remedy}")

    def doses(self, backend: ChiBioConfig, bench: Bench) -> None:
        if bench.period_s != CONTROL_S:
            where = f"allowed {CONTROL_S:g}, the time between measurements of backend={backend.kind}"
            raise UnfitError(f"bench.period_s = {bench.period_s:g} s: {where}")
        for name in backend.reactors:
            if not LEAST_ML <= (ml := bench.volume_of(name)) < VIAL_ML:
                allowed = f"allowed {LEAST_ML:g} (the device's smallest) to less than {VIAL_ML:g} (the vial's volume)"
                raise UnfitError(f"bench.volume_ml = {ml:g} mL of {name}: {allowed}")

    def rim_ml(self, volumes_ml: Array) -> float:
        return VIAL_ML

    def sees_fluorescence(self, backend: ChiBioConfig) -> bool:
        return backend.fluorescence.measure

    def seeing_fluorescence(self, backend: ChiBioConfig) -> ChiBioConfig:
        return replace(backend, fluorescence=replace(backend.fluorescence, measure=True))

    def address(self, backend: ChiBioConfig) -> str:
        return backend.url

    def unmeasured(self, backend: ChiBioConfig) -> str:
        found = load_calibrations(Path(backend.calibration), backend.reactors)
        nominal = [name for name, c in zip(backend.reactors, found, strict=True) if not c.calibrated]
        return f"pumps not weighed, taken as 1 mL/s: {', '.join(nominal)}" if nominal else ""


FAMILY = ChiBioFamily()
