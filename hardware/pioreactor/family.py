"""Pioreactors as a family: exclusive access to units, their preflight, and their volumes and dose limits."""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from pathlib import Path

import numpy as np

from envs.bench import Bench
from hardware.clock import RealClock
from hardware.errors import UnfitError
from hardware.family import Can, Check, Family, Opening, not_looked_at, report
from hardware.link.open import DeviceLock
from hardware.logbook import Log, no_log
from hardware.pioreactor.config import FULL_ML, PioreactorConfig, vial_ml
from hardware.pioreactor.doses import replay
from hardware.pioreactor.mailbox import SPARE
from hardware.pioreactor.preflight import preflight
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.reactor import Array, Reactor, left_off

Reached = AbstractContextManager[PioreactorConfig]


class PioreactorFamily(Family):
    """Units of one cluster."""

    config = PioreactorConfig
    can = Can(spare_pumps=(SPARE,), thermostat=True, regulation=True, resume=True)
    called = "Pioreactors"

    def reached(self, backend: PioreactorConfig, bench: Bench, folder: Path) -> Reached:
        """Return, as a context, the config with which a run reaches the units. Raises: ReactorError."""
        return nullcontext(backend)

    @contextmanager
    def units(
        self, backend: PioreactorConfig, bench: Bench, folder: Path, log_row: Log = no_log, run: str = ""
    ) -> Iterator[PioreactorReactors]:
        """Open units that no other client on this computer uses. Raises: ReactorError."""
        with ExitStack() as stack:
            backend = stack.enter_context(self.reached(backend, bench, folder))
            for unit in backend.reactors:
                stack.enter_context(closing(DeviceLock(f"unit {unit} of {backend.broker}:{backend.broker_port}")))
            yield stack.enter_context(closing(PioreactorReactors(backend, RealClock(), log_row, run, bench)))

    @contextmanager
    def open(self, opening: Opening) -> Iterator[Reactor]:
        earlier, began = opening.earlier(), opening.began
        with ExitStack() as stack:
            with not_looked_at(opening.resumed):
                run = next((str(row["run"]) for row in earlier if row.get("run")), format(int(began), "x"))
                units = self.units(opening.backend, opening.bench, opening.folder, opening.journal.append, run)
                reactors = stack.enter_context(units)
                if not earlier:
                    report(preflight(reactors))
            elapsed_s = opening.elapsed_s(opening.backend.speed)
            with left_off(reactors):
                reactors.begin(replay(earlier), elapsed_s)
                yield reactors

    def preflight(self, backend: PioreactorConfig, bench: Bench, folder: Path) -> list[Check]:
        with self.units(backend, bench, folder) as reactors:
            return preflight(reactors)

    def tube(self, backend: PioreactorConfig, number: int, most_ml: float, who: str) -> None:
        if not backend.alt_media:
            remedy = "connect a tube, calibrate the pump in the vendor's page and set backend.alt_media=true"
            raise UnfitError(f"{who}: pump {number}, the vendor's alt-media pump, has no tube; {remedy}")

    def no_thermostat(self, backend: PioreactorConfig) -> str | None:
        return None if backend.thermostat else " without backend.thermostat=true"

    def doses(self, backend: PioreactorConfig, bench: Bench) -> None:
        where = f"backend={backend.kind}"
        if not 30.0 <= bench.period_s <= 600.0:
            raise UnfitError(f"bench.period_s = {bench.period_s:g} s: allowed 30 to 600 with {where}")
        volumes_ml = bench.volumes(backend.reactors)
        for name, ml, full_ml in zip(backend.reactors, volumes_ml, self.rim_ml(volumes_ml), strict=True):
            if ml >= full_ml:
                given = f"bench.volume_ml = {ml:g} mL of {name}"
                raise UnfitError(f"{given}: allowed less than the vendor's limit of this vial, {full_ml:g}")
        if bench.max_rate * bench.period_s > backend.max_dose_ml + 1e-9:
            least = math.floor(1e5 * backend.max_dose_ml / bench.period_s) / 1e5
            raise UnfitError(
                f"{where}: backend.max_dose_ml = {backend.max_dose_ml:g} mL, the interlock allows "
                f"{bench.max_rate * bench.period_s:.3g} mL in a period of {bench.period_s:g} s; "
                f"set bench.max_rate={least:g} or a larger backend.max_dose_ml"
            )

    def rim_ml(self, volumes_ml: Array) -> Array:
        return np.array([FULL_ML[vial_ml(ml)] for ml in volumes_ml])

    def address(self, backend: PioreactorConfig) -> str:
        return f"{backend.broker}:{backend.broker_port}"


FAMILY = PioreactorFamily()
