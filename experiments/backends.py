"""From a deploy config to reactors: simulated vials, a Chi.Bio, or an emulator that is started for the run."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from envs.plant import Plant, PlantConfig
from experiments import app
from experiments.config import DeployConfig
from experiments.loop import ClosedLoop
from experiments.record import Record
from hardware.chibio import ChiBioReactors
from hardware.clock import RealClock
from hardware.reactor import Reactor
from hardware.saved import replay
from hardware.simulated import SimulatedReactors
from hardware.transport import open_transport

__all__ = ["continue_loop", "opened", "plant_of"]

log = logging.getLogger(__name__)
logging.getLogger("httpx").setLevel(logging.WARNING)  # it tells of every request; the journal does that better


def plant_of(config: DeployConfig) -> PlantConfig:
    """The simulated plant, carrying the calibrated model if one is given. Raises: UserError for a bad env_file."""
    plant = config.plant
    if config.env_file is None:
        return plant
    from experiments.train import read_env_file

    model = read_env_file(config.env_file)
    gain = plant.vessel.volume_ml / (60.0 * model.tau)  # tau = V / (60 g)
    growth, pump = replace(plant.growth, mu=model.mu), replace(plant.pump, gain_ml_s=gain)
    return replace(plant, growth=growth, pump=pump)


@contextmanager
def opened(config: DeployConfig, plant: PlantConfig, record: Record) -> Iterator[Reactor]:
    """The reactors, ready for the loop; released afterwards. Raises: ReactorError."""
    backend = config.backend
    if backend.kind == "sim":
        vials = Plant(plant, len(backend.reactors), np.random.default_rng(backend.seed))
        yield SimulatedReactors(vials, backend)
        return
    transport = open_transport(backend.transport, backend.url, backend.speed)
    try:
        reactors = ChiBioReactors(transport, RealClock(backend.speed), backend, log=record.journal.append)
        earlier = record.journal.rows
        if earlier:
            run_s = (time.time() - float(earlier[0]["wall"])) * backend.speed
            reactors.begin(replay(earlier), run_s)
        else:
            reactors.begin()
        yield reactors
    finally:
        transport.close()


def continue_loop(loop: ClosedLoop, record: Record) -> None:
    """Put the loop where its state was saved, and book the doses begun after that.

    Raises: RecordingError, UserError for a state that does not fit.
    """
    state, doses = record.load_state()
    try:
        loop.load_state_dict(state)
    except (KeyError, ValueError, TypeError) as error:
        raise app.UserError(f"resume: state.json does not fit this run ({error}); start a new run") from None
    now = loop.reactors.elapsed()
    for receipt in doses:
        loop.interlock.confirm(receipt, now)
    log.info("resumed at minute %.1f; %d dose(s) booked from the journal", now / 60.0, len(doses))
