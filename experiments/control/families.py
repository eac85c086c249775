"""Reactor families: how the reactors that a backend's config describes are opened, by kind of backend."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf import presets
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from experiments.control.config import BACKENDS
from experiments.control.device import check, linked, load_calibrations, report
from hardware.check import Check
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.reactors import ChiBioReactors
from hardware.chibio.resume import replay
from hardware.clock import RealClock
from hardware.errors import RecordingError
from hardware.link.open import DeviceLock
from hardware.logbook import Log, no_log
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig, UnitConfig
from hardware.pioreactor.preflight import preflight as preflight_units
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.resume import replay as replay_units
from hardware.reactor import Reactor, left_off
from hardware.rig.processes import Rig
from hardware.simulated import SimulatedReactors
from hardware.storage.journal import Journal

__all__ = ["Opening", "add", "opened", "preflight"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Opening:
    """What a family is given to open its reactors.

    backend: its config. bench: volume, period and pump. plant: of simulated vials. journal: of the run, into which a
    driver writes every command before it is carried out; `journal.rows` is what an earlier life of the run wrote.
    folder: of the run. resumed: there was such a life.
    """

    backend: Any
    bench: Bench
    plant: PlantConfig
    journal: Journal
    folder: Path
    resumed: bool


Opener = Callable[[Opening], AbstractContextManager[Reactor]]


@contextmanager
def _simulated(opening: Opening) -> Iterator[Reactor]:
    """Vials in this process."""
    backend = opening.backend
    volumes_ml = opening.bench.volumes(backend.reactors)
    vials = Plant(opening.plant, len(backend.reactors), np.random.default_rng(backend.seed), volumes_ml)
    yield SimulatedReactors(vials, backend, opening.bench.control_min)


@contextmanager
def _not_looked_at() -> Iterator[None]:
    """Who stops it in here is told that nobody has looked at the pumps: an earlier life may have left one on."""
    try:
        yield
    except KeyboardInterrupt:
        log.warning("stopped before the pumps were looked at: pumps not verified off")
        raise


@contextmanager
def _chibio(opening: Opening) -> Iterator[Reactor]:
    """A Chi.Bio or its emulator, checked before a run begins. Raises: ReactorError, UserError."""
    backend, earlier = opening.backend, opening.journal.rows
    with ExitStack() as stack:
        with _not_looked_at():
            transport, clock = stack.enter_context(linked(backend))
            calibrations = load_calibrations(Path(backend.calibration), backend.reactors)
            if opening.resumed and not earlier:
                where = opening.journal.path
                raise RecordingError(f"journal {where}: missing or empty; put it back, or start a new run")
            if not earlier:
                check(backend, transport, clock, calibrations, opening.folder)
            reactors = ChiBioReactors(transport, clock, backend, calibrations, opening.journal.append)
        elapsed_s = (time.time() - float(earlier[0]["wall"])) * backend.speed if earlier else 0.0
        reactors.begin(replay(earlier), elapsed_s)
        with left_off(reactors):
            yield reactors


@contextmanager
def _units(
    backend: PioreactorConfig, folder: Path, log_row: Log = no_log, run: str = ""
) -> Iterator[PioreactorReactors]:
    """Pioreactors that no other client on this computer has, or those of a rig. Raises: ReactorError."""
    with ExitStack() as stack:
        if isinstance(backend, RigBackendConfig):
            cultures = dict(zip(backend.reactors, backend.volumes_ml, strict=True))
            login = backend.username, backend.password()
            made = Rig(cultures, backend.rig, backend.speed, folder, backend.experiment, login)
            rig = stack.enter_context(made)
            units = {u: replace(backend.units.get(u, UnitConfig()), address=url) for u, url in rig.web.items()}
            backend = replace(
                backend, broker="127.0.0.1", broker_port=rig.broker, tls=False, units=units,
                leader=rig.web[backend.reactors[0]],
            )  # fmt: skip
            log.info("the vendor's software %s at %s, cultures %g times real time", rig.version, rig.web, backend.speed)
        for unit in backend.reactors:
            stack.enter_context(closing(DeviceLock(f"unit {unit} of {backend.broker}:{backend.broker_port}")))
        yield stack.enter_context(closing(PioreactorReactors(backend, RealClock(), log_row, run)))


@contextmanager
def _pioreactor(opening: Opening) -> Iterator[Reactor]:
    """Pioreactors, checked before a run begins. Raises: ReactorError, UserError."""
    earlier = opening.journal.rows
    if opening.resumed and not earlier:
        raise RecordingError(f"journal {opening.journal.path}: missing or empty; put it back, or start a new run")
    began = float(earlier[0]["wall"]) if earlier else time.time()
    run = format(int(began), "x")
    with ExitStack() as stack:
        with _not_looked_at():
            reactors = stack.enter_context(_units(opening.backend, opening.folder, opening.journal.append, run))
            if not earlier:
                report(preflight_units(reactors))
        elapsed_s = (time.time() - began) * opening.backend.speed if earlier else 0.0
        with left_off(reactors):
            reactors.begin(replay_units(earlier), elapsed_s)
            yield reactors


OPENERS: dict[str, Opener] = {
    "sim": _simulated,
    "chibio": _chibio,
    "emulator": _chibio,
    "pioreactor": _pioreactor,
    "pioreactor_rig": _pioreactor,
}


def preflight(backend: Any, folder: Path, others: Sequence[Check]) -> None:
    """Every check of a family's reactors a line, after them `others`. Raises: UserError if one failed; ReactorError."""
    if isinstance(backend, ChiBioConfig):
        calibrations = load_calibrations(Path(backend.calibration), backend.reactors)
        with linked(backend) as (transport, clock):
            check(backend, transport, clock, calibrations, folder, others)
    elif isinstance(backend, PioreactorConfig):
        with _units(backend, folder) as reactors:
            report([*preflight_units(reactors), *others])
    else:
        report(others)


def add(kind: str, config: type[Any], opener: Opener, what: str) -> None:
    """Make a family known as `backend=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`; it needs `reactors`, their names,
        and `control_min`, the time between samples.
      opener: called with an `Opening`; inside the context its reactors are ready, on leaving it they are released.
      what: the sentence that the help shows.
    Raises: ValueError for a kind that exists.
    """
    presets.add(f"backend/{kind}", {"kind": kind}, what)
    BACKENDS[kind], OPENERS[kind] = config, opener


def opened(opening: Opening) -> AbstractContextManager[Reactor]:
    """The reactors of a run. Raises, on entering: what the family raises; ReactorError, UserError for a Chi.Bio."""
    return OPENERS[opening.backend.kind](opening)
