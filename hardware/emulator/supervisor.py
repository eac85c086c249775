"""Starts and ends of the device's software: gunicorn, the watchdog's power latch, crashes, restarts by hand."""

from __future__ import annotations

from collections.abc import Mapping

from hardware.emulator.computer import Computer
from hardware.emulator.events import HARDWARE, Steps
from hardware.emulator.software import Software
from hardware.emulator.vial import Vial
from hardware.emulator.worker import WebWorker

__all__ = ["Supervisor"]

POWER_LATCH_S = 1.0  # the watchdog cuts power about a second after the software stopped


class Supervisor:
    """Keeps one process of the software running, or none.

    Args:
      vials: whose power it switches. boot_s: from a dead worker to a serving one. request_s, timeout_s: as `WebWorker`.
    `alive` is whether anybody listens; `restarts` and `exits` count.
    """

    def __init__(
        self, computer: Computer, vials: Mapping[str, Vial], boot_s: float, request_s: float, timeout_s: float
    ) -> None:
        self._computer, self._vials, self._boot_s = computer, vials, boot_s
        self.alive = True
        self.restarts = self.exits = 0
        self.worker = WebWorker(self._started(), request_s, timeout_s)

    def _started(self) -> Software:
        """Import of the app: every position initialised, power on, all outputs off."""
        self._computer.faults.bus_stuck = False
        for vial in self._vials.values():
            vial.set_power(True, self._computer.now())
        return Software(self._computer, self._vials)

    def _end_process(self) -> None:
        """Threads and memory are gone; the latch cuts the power a second later."""
        events = self._computer.events
        events.life += 1
        self.worker.end()
        events.add(POWER_LATCH_S, self._latch(events.life), HARDWARE, "latch")

    def _latch(self, life: int) -> Steps:
        if life == self._computer.events.life and not self.worker.ready:
            self._power_off()
        yield from ()

    def _power_off(self) -> None:
        for vial in self._vials.values():
            vial.set_power(False, self._computer.now())

    def kill_worker(self) -> None:
        """gunicorn replaces the worker: state wiped, requests wait until the new one has booted."""
        self._computer.note("worker killed")
        self._end_process()
        self._start_soon()

    def _start_soon(self) -> None:
        self.restarts += 1
        events = self._computer.events
        events.add(self._boot_s, self._boot(events.life), HARDWARE, "boot")

    def _boot(self, life: int) -> Steps:
        if life == self._computer.events.life and self.alive:
            self.worker.boot(self._started())
        yield from ()

    def exit(self) -> None:
        """Exit code 4: gunicorn gives up, nobody listens any more."""
        self._end_process()
        self.alive = False
        self.exits += 1
        self.worker.turn_away()

    def crash(self) -> None:
        """Fault: the software ends itself, as after too many bus failures."""
        self._computer.note("crashed on demand")
        self.exit()

    def cut_power(self) -> None:
        """Fault: the whole board loses power; its clock starts again where it had started before."""
        self.crash()
        self._computer.wall_offset_s = -self._computer.now()
        self._power_off()

    def restart(self) -> None:
        """Somebody starts the software again by hand: defaults, nothing running."""
        if not self.alive:
            self.alive = True
            self._start_soon()
