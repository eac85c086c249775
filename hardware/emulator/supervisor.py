"""Emulated gunicorn, whose worker serves one request at a time: starts and ends of the software, the power latch."""

from collections import deque
from collections.abc import Mapping

from hardware.emulator.computer import HARDWARE, AppError, Computer, Steps
from hardware.emulator.routes import HTML, Exchange, answer_request
from hardware.emulator.software import Software
from hardware.emulator.vial import Vial

REQUEST = "request"  # owner of the events of the request being served
ERROR_PAGE = b"<!doctype html>\n<title>500 Internal Server Error</title>\n<h1>Internal Server Error</h1>\n"
BOOT_S = 8.0  # from the end of a worker until the next one serves
REQUEST_S = 0.005  # least time of a request
WORKER_TIMEOUT_S = 30.0  # gunicorn kills a worker whose request takes longer
POWER_LATCH_S = 1.0  # the watchdog cuts power about a second after the software stopped


class Supervisor:
    """Emulated gunicorn supervisor: runs at most one worker and queues its requests.

    Args: vials: vials whose power the watchdog's latch switches.
    Attributes: software: that of the current or last worker. deadline: time at which the worker is killed for a slow
      request. alive: requests are accepted. restarts, exits: number of restarts of a worker and of ends of gunicorn.
    """

    def __init__(self, computer: Computer, vials: Mapping[str, Vial]) -> None:
        self._computer, self._vials = computer, vials
        self.alive, self.deadline, self.restarts, self.exits = True, 0.0, 0, 0
        self._waiting: deque[Exchange] = deque()
        self._serving: Exchange | None = None
        self._start()

    def _start(self) -> None:
        """Start the software: power on, every position initialised, all outputs off; then serve requests."""
        self._computer.faults.bus_stuck = False
        for vial in self._vials.values():
            vial.set_power(True, self._computer.now())
        self.software, self._ready = Software(self._computer, self._vials), True
        self._serve_next()

    def accept(self, exchange: Exchange) -> None:
        """Take a request that has arrived."""
        self._waiting.append(exchange)
        self._serve_next()

    def _serve_next(self) -> None:
        if self._ready and self._serving is None and self._waiting:
            self._serving = self._waiting.popleft()
            self.deadline = self._computer.now() + WORKER_TIMEOUT_S
            self._computer.spawn(self._serve(self._serving), REQUEST)

    def _serve(self, exchange: Exchange) -> Steps:
        computer, faults, software = self._computer, self._computer.faults, self.software
        hang, faults.hang_s = faults.hang_s, 0.0
        yield REQUEST_S + hang
        software.foreign_select()
        try:
            answer = yield from answer_request(software, exchange)
        except (AppError, ArithmeticError, LookupError, TypeError, ValueError) as problem:
            computer.note(f"{exchange.method} {exchange.path}: {type(problem).__name__}: {problem}")
            answer = (500, ERROR_PAGE, HTML)
        if faults.take("lost_reply"):
            exchange.fate = "lost"
        elif faults.take("reset_after"):
            exchange.fate = "reset"
        else:
            exchange.answer = answer
            if exchange.shows:
                software.shown(exchange.shows)
        self._serving = None
        self._serve_next()

    def _end_process(self) -> None:
        """End the process: threads and memory are lost, the current request is reset, and the latch soon cuts power."""
        events = self._computer.events
        events.life += 1
        self._ready = False
        if self._serving is not None:
            self._serving.fate, self._serving = "reset", None
        events.add(POWER_LATCH_S, self._latch(events.life), HARDWARE, "latch")

    def _latch(self, life: int) -> Steps:
        if life == self._computer.events.life and not self._ready:
            self._power_off()
        yield from ()

    def _power_off(self) -> None:
        for vial in self._vials.values():
            vial.set_power(False, self._computer.now())

    def kill_worker(self) -> None:
        """Replace the worker as gunicorn does: its state is lost, and requests wait until the new worker has booted."""
        self._computer.note("worker killed")
        self._end_process()
        self._start_soon()

    def _start_soon(self) -> None:
        self.restarts += 1
        events = self._computer.events
        events.add(BOOT_S, self._boot(events.life), HARDWARE, "boot")

    def _boot(self, life: int) -> Steps:
        if life == self._computer.events.life and self.alive:
            self._start()
        yield from ()

    def exit(self) -> None:
        """End gunicorn, as it ends when a worker exits with code 4: no more requests are accepted."""
        self._end_process()
        self.alive = False
        self.exits += 1
        while self._waiting:
            self._waiting.popleft().fate = "reset"

    def crash(self) -> None:
        """Make the software end itself, as after too many bus failures."""
        self._computer.note("crashed on demand")
        self.exit()

    def cut_power(self) -> None:
        """Cut the power of the whole board; its clock starts again at its first date."""
        self.crash()
        self._computer.wall_offset_s = -self._computer.now()
        self._power_off()

    def restart(self) -> None:
        """Start the ended software again, as a user does: with defaults and without an experiment."""
        if not self.alive:
            self.alive = True
            self._start_soon()
