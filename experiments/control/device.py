"""The device behind a backend's config: the link to it, its preflight, and the files of its calibrations."""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from experiments.cli import files, frame, stop
from hardware.check import Check
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.chibio.connection import identity
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.chibio.preflight import preflight
from hardware.clock import RealClock
from hardware.emulator.process import EmulatorProcess
from hardware.link.open import DeviceLock, open_transport
from hardware.link.transport import Transport
from hardware.storage import atomic

__all__ = ["check", "linked", "load_calibrations", "one_interrupt", "report", "save_calibration"]

log = logging.getLogger(__name__)
EMULATED = ("speed", "seed", "od", "plant")  # values of backend=emulator that its process is started with
PARTS = ("feed", "waste", "blank")  # one YAML file per reactor and part, REACTOR_PART.yaml


@contextmanager
def one_interrupt() -> Iterator[None]:
    """Ctrl-C, SIGTERM (a service manager, a shutting-down PC) or SIGHUP (a closed terminal) raise KeyboardInterrupt.

    Only the first of them: what comes after it does not cut short the switching off of the pumps, nor the summary.
    """
    told: list[int] = []

    def answer(number: int, stack: FrameType | None) -> None:
        told.append(number)
        if len(told) == 1:
            raise KeyboardInterrupt
        log.warning("the pumps are being switched off and verified; this takes up to a minute")

    with stop.handled(answer, *stop.SIGNALS):
        yield


@contextmanager
def linked(backend: ChiBioConfig) -> Iterator[tuple[Transport, RealClock]]:
    """The open link to a device that no other client has, and the device's clock.

    Raises: ReactorError if nothing answers, or another client on this computer has the device, by whatever name.
    """
    with ExitStack() as stack:
        url = backend.url
        if isinstance(backend, EmulatorConfig):  # one is started for as long as the run lasts
            arguments = {"reactors": ",".join(backend.reactors), **{k: getattr(backend, k) for k in EMULATED}}
            if (overflow := backend.overflow_pump).pump:
                arguments |= {"overflow-pump": overflow.pump, "overflow-flow": overflow.flow_ml_s}
            arguments |= {f"{pump.lower()}-flow": backend.supply.flow_ml_s(pump) for pump in backend.supply.pumps}
            words = [word for k, v in arguments.items() for word in (f"--{k}", str(v))]
            device = stack.enter_context(EmulatorProcess(words))
            log.info(
                "emulated device at %s, %g times real time; faults at %s", device.url, backend.speed, device.control
            )
            url = device.url
        transport = stack.enter_context(closing(open_transport(backend.transport, url, backend.speed)))
        clock = RealClock(backend.speed)
        if not isinstance(backend, EmulatorConfig):  # that one is this run's own
            stack.enter_context(closing(DeviceLock(f"the device with reactor {identity(transport, clock)}")))
        yield transport, clock


def check(
    backend: ChiBioConfig,
    transport: Transport,
    clock: RealClock,
    calibrations: list[ReactorCalibration],
    folder: Path,
    others: Sequence[Check] = (),
) -> None:
    """Log the preflight line by line, after it `others`. Raises: UserError if a required check failed."""
    report([*preflight(transport, clock, backend, calibrations, folder), *others])


def report(checks: Sequence[Check]) -> None:
    """Log the lines of a preflight. Raises: UserError if a required check failed."""
    for one in checks:
        log.log(logging.INFO if one.ok else logging.WARNING, "%s", one)
    failed = [one for one in checks if one.required and not one.ok]
    if failed:
        raise frame.UserError(f"preflight: {len(failed)} of {len(checks)} checks failed, the first: {failed[0]}")


def save_calibration(folder: Path, reactor: str, part: str, values: Mapping[str, Any]) -> Path:
    """Write FOLDER/REACTOR_PART.yaml, whole or not at all; returns its path.

    Args: part: feed, waste or blank. Raises: UserError if the folder cannot be written.
    """
    path = folder / f"{reactor}_{part}.yaml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        atomic.write(path, OmegaConf.to_yaml(OmegaConf.create(dict(values))), fsync=False)
    except OSError as error:
        raise frame.UserError(f"calibration {path}: {error.strerror or error}; give another folder") from None
    return path


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content = OmegaConf.to_container(files.load_yaml(path))
    except (OSError, ValueError, OmegaConfBaseException) as error:
        raise frame.UserError(
            f"calibration {path}: not readable ({str(error).splitlines()[0]}); measure again"
        ) from None
    if not isinstance(content, dict):
        raise frame.UserError(f"calibration {path}: no keys and values; measure again")
    return {str(k): v for k, v in content.items()}


def load_calibrations(folder: Path, reactors: Sequence[str]) -> list[ReactorCalibration]:
    """Pumps and blanks of `reactors`; what was never measured is nominal, and its blank is nan (the device's own).

    Raises: UserError naming the file and what is wrong with it.
    """
    calibrations = []
    for name in reactors:
        feed, waste, blank = (_read(folder / f"{name}_{part}.yaml") for part in PARTS)
        try:
            pumps = [PumpCalibration.from_dict(values) for values in (feed, waste)]
            counts = float(blank.get("blank", math.nan))
            if not math.isnan(counts) and not 3000.0 <= counts <= 60000.0:
                raise ValueError(f"blank = {counts}: allowed 3000 to 60000 counts")
        except (TypeError, ValueError) as error:
            raise frame.UserError(f"calibration of {name} in {folder}: {error}") from None
        calibrations.append(ReactorCalibration(pumps[0], pumps[1], counts))
    return calibrations
