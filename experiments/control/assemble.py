"""From a deploy config to reactors: simulated vials, a Chi.Bio, or an emulator that is started for the run."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from dqn.policy import Policy
from envs.plant.plant import Plant, PlantConfig
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.control.calibration_files import load_calibrations
from experiments.control.config import DeployConfig
from experiments.control.loop import ClosedLoop
from experiments.control.record import Record
from experiments.controllers.base import Controller
from experiments.training import build
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.preflight import preflight
from hardware.chibio.reactors import ChiBioReactors
from hardware.chibio.resume import replay
from hardware.clock import RealClock
from hardware.emulator.process import EmulatorProcess
from hardware.errors import RecordingError
from hardware.link.open import open_transport
from hardware.link.transport import Transport
from hardware.reactor import Reactor
from hardware.safety.config import Response
from hardware.simulated import SimulatedReactors

__all__ = ["continue_loop", "controller_of", "model_of", "opened", "plant_of", "run_preflight"]

log = logging.getLogger(__name__)
EMULATED = ("speed", "seed", "od", "plant")  # values of backend=emulator that its process is started with


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


def model_of(config: DeployConfig) -> EnvConfig:
    """The growth model that model-based controllers are given: the calibrated one, else the nominal one."""
    model = EnvConfig()
    if config.env_file is not None:
        from experiments.train import read_env_file

        model = read_env_file(config.env_file)
    return replace(model, control_min=config.backend.control_min)


def controller_of(config: DeployConfig, model: EnvConfig, policy: Policy | None, reactors: Reactor) -> Controller:
    """The configured controller. Raises: UserError naming what it needs and does not have here."""
    plant, flow = None, 1.0
    if isinstance(reactors, SimulatedReactors):
        plant, flow = reactors.plant, reactors.config.pump_ml_s
    try:
        return build.controller(config.controller, model, policy, plant, flow)
    except ValueError as error:
        raise frame.UserError(str(error)) from None


@contextmanager
def opened(config: DeployConfig, plant: PlantConfig, record: Record) -> Iterator[Reactor]:
    """The reactors, ready for the loop; released afterwards. Raises: ReactorError."""
    backend = config.backend
    if backend.kind == "sim":
        vials = Plant(plant, len(backend.reactors), np.random.default_rng(backend.seed))
        yield SimulatedReactors(vials, backend)
        return
    with ExitStack() as stack:
        url = stack.enter_context(device_of(config))
        transport = open_transport(backend.transport, url, backend.speed)
        stack.callback(transport.close)
        clock = RealClock(backend.speed)
        calibrations = load_calibrations(Path(backend.calibration), backend.reactors)
        earlier = record.journal.rows
        if config.resume is not None and not earlier:
            raise RecordingError(f"journal {record.journal.path}: missing or empty; put it back, or start a new run")
        if not earlier:
            _check(transport, clock, config, calibrations, record.folder)
        reactors = ChiBioReactors(transport, clock, backend, calibrations, record.journal.append)
        if earlier:
            reactors.begin(replay(earlier), (time.time() - float(earlier[0]["wall"])) * backend.speed)
        else:
            reactors.begin()
        try:
            yield reactors
        except BaseException:  # before the loop, which ends with the same by itself: a guard runs already
            reactors.stop()
            raise


@contextmanager
def device_of(config: DeployConfig) -> Iterator[str]:
    """Address of the device; `backend=emulator` starts one for as long as the run lasts. Raises: LinkError."""
    backend = config.backend
    if backend.kind != "emulator":
        yield backend.url
        return
    arguments = {"reactors": ",".join(backend.reactors), **{k: getattr(backend, k) for k in EMULATED}}
    if (overflow := backend.overflow_pump).pump:
        arguments |= {"guard": overflow.pump, "guard-flow": overflow.flow_ml_s}
    with EmulatorProcess([word for k, v in arguments.items() for word in (f"--{k}", str(v))]) as device:
        log.info("emulated device at %s, %g times real time; faults at %s", device.url, backend.speed, device.control)
        yield device.url


def _check(
    transport: Transport, clock: RealClock, config: DeployConfig, calibrations: list[ReactorCalibration], folder: Path
) -> None:
    """Log the preflight line by line. Raises: UserError if a required check failed."""
    checks = preflight(transport, clock, config.backend, calibrations, folder)
    for check in checks:
        log.log(logging.INFO if check.ok else logging.WARNING, "%s", check)
    failed = [check for check in checks if check.required and not check.ok]
    if failed:
        raise frame.UserError(f"preflight: {len(failed)} of {len(checks)} checks failed, the first: {failed[0]}")


def run_preflight(config: DeployConfig, folder: Path) -> None:
    """`preflight_only=true`: every check a line with pass or the remedy. Raises: UserError if one failed."""
    backend = config.backend
    if backend.kind == "sim":
        raise frame.UserError("preflight_only=true: a simulated reactor needs no preflight; use backend=chibio")
    with ExitStack() as stack:
        url = stack.enter_context(device_of(config))
        transport = open_transport(backend.transport, url, backend.speed)
        stack.callback(transport.close)
        calibrations = load_calibrations(Path(backend.calibration), backend.reactors)
        _check(transport, RealClock(backend.speed), config, calibrations, folder)


def continue_loop(loop: ClosedLoop, record: Record) -> None:
    """Put the loop where its state was saved, and book the doses and hand-overs begun after that.

    Raises: RecordingError for a state that is damaged or does not fit.
    """
    state, doses = record.load_state()
    try:
        loop.load_state_dict(state)
    except ValueError as error:
        raise record.no_state(str(error)) from None
    loop.interlock.latch(Response.REGULATE, loop.reactors.handed_over)
    now = loop.reactors.elapsed()
    for receipt in doses:
        loop.interlock.confirm(receipt, now)
    log.info("resumed at minute %.1f; %d dose(s) booked from the journal", now / 60.0, len(doses))
