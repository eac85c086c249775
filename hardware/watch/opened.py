"""A family of reactors that are only watched: opened and checked by reads."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from envs.bench import Bench
from envs.scenario import HEATED, Scenario
from hardware.actuator import Actuator
from hardware.chibio.calibrations import load_calibrations
from hardware.clock import DeviceClock, RealClock
from hardware.errors import UnfitError
from hardware.family import Check, Family, Opening
from hardware.link.http import HttpTransport
from hardware.reactor import Array
from hardware.watch.chibio import WatchedChiBio
from hardware.watch.pioreactor import WatchedPioreactors
from hardware.watched import Watched

KINDS = ("chibio", "pioreactor")


class WatchedFamily(Family):
    """Family that can only read the reactors of another family. Args: of: the other family."""

    at_stake = False

    def __init__(self, of: Family) -> None:
        self._of, self.config, self.called = of, of.config, f"{of.called}, only watched,"

    @contextmanager
    def open(self, opening: Opening) -> Iterator[Watched]:
        with self._opened(opening.backend, opening.bench) as reactors:
            yield reactors

    def preflight(self, backend: Any, bench: Bench, folder: Path) -> list[Check]:
        with self._opened(backend, bench) as reactors:
            m = reactors.measure()
        faults = m.vitals.faults if m.vitals is not None else (None,) * len(m.od)
        return [
            Check(f"{name} is heard", not fault, str(fault or f"OD {od:.3f}"), "look at the device's page")
            for name, od, fault in zip(reactors.names, m.od, faults, strict=True)
        ]

    @contextmanager
    def _opened(self, backend: Any, bench: Bench) -> Iterator[Watched]:
        if backend.kind == "pioreactor":
            with closing(WatchedPioreactors(backend, RealClock(), bench)) as units:
                yield units
            return
        (calibration,) = load_calibrations(Path(backend.calibration), backend.reactors)
        with closing(HttpTransport(backend.url, backend.speed, backend.transport)) as link:
            clock, (name,) = DeviceClock(backend.speed), backend.reactors
            yield WatchedChiBio(link.get, clock, name, calibration.feed.flow_ml_s)

    def fits(self, backend: Any, bench: Bench, scenarios: Sequence[Scenario], ends: Sequence[str]) -> None:
        said = "watch=true: "
        if backend.kind not in KINDS:
            raise UnfitError(f"{said}backend={backend.kind}: allowed {', '.join(KINDS)}")
        if any(s.supplied or any(heated(s) for heated in HEATED) for s in scenarios):
            raise UnfitError(f"{said}scenario.ratios and outputs are commands; allowed a scenario of the density alone")
        if backend.kind == "chibio" and len(backend.reactors) > 1:
            why = "a Chi.Bio shows one reactor, and to select another is a command"
            raise UnfitError(f"{said}backend.reactors = {', '.join(backend.reactors)}: allowed one; {why}")
        if backend.kind == "chibio" and (backend.transport.kind != "http" or backend.transport.token_file):
            raise UnfitError(f"{said}a board agent obeys one client; allowed backend/transport=http without token_file")
        undosed = replace(bench, max_rate=1e-6)  # no limit of a dose applies
        self._of.fits(backend, undosed, scenarios, ends)

    def actuators(self, backend: Any) -> tuple[Actuator, ...]:
        return self._of.actuators(backend)

    def rim_ml(self, volumes_ml: Array) -> Array | float:
        return self._of.rim_ml(volumes_ml)

    def address(self, backend: Any) -> str:
        return self._of.address(backend)
