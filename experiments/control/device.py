"""The device behind a backend's config: the link to it, and its preflight."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from experiments.cli import frame
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.preflight import preflight
from hardware.clock import RealClock
from hardware.emulator.process import EmulatorProcess
from hardware.link.open import open_transport
from hardware.link.transport import Transport

__all__ = ["check", "linked"]

log = logging.getLogger(__name__)
EMULATED = ("speed", "seed", "od", "plant")  # values of backend=emulator that its process is started with


@contextmanager
def linked(backend: ChiBioConfig) -> Iterator[tuple[Transport, RealClock]]:
    """The open link to a device and the device's clock. Raises: LinkError."""
    with _running(backend) as url:
        transport = open_transport(backend.transport, url, backend.speed)
        try:
            yield transport, RealClock(backend.speed)
        finally:
            transport.close()


@contextmanager
def _running(backend: ChiBioConfig) -> Iterator[str]:
    """Address of the device; `backend=emulator` starts one for as long as the run lasts. Raises: LinkError."""
    if not isinstance(backend, EmulatorConfig):
        yield backend.url
        return
    arguments = {"reactors": ",".join(backend.reactors), **{k: getattr(backend, k) for k in EMULATED}}
    if (overflow := backend.overflow_pump).pump:
        arguments |= {"overflow-pump": overflow.pump, "overflow-flow": overflow.flow_ml_s}
    with EmulatorProcess([word for k, v in arguments.items() for word in (f"--{k}", str(v))]) as device:
        log.info("emulated device at %s, %g times real time; faults at %s", device.url, backend.speed, device.control)
        yield device.url


def check(
    backend: ChiBioConfig, transport: Transport, clock: RealClock, calibrations: list[ReactorCalibration], folder: Path
) -> None:
    """Log the preflight line by line. Raises: UserError if a required check failed."""
    checks = preflight(transport, clock, backend, calibrations, folder)
    for one in checks:
        log.log(logging.INFO if one.ok else logging.WARNING, "%s", one)
    failed = [one for one in checks if one.required and not one.ok]
    if failed:
        raise frame.UserError(f"preflight: {len(failed)} of {len(checks)} checks failed, the first: {failed[0]}")
