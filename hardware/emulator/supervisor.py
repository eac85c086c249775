"""gunicorn: its worker serves one request at a time; starts and ends of the software, the watchdog's power latch."""

from collections import deque
from collections.abc import Mapping

from hardware.emulator.computer import HARDWARE, AppError, Computer, Steps
from hardware.emulator.routes import HTML, Exchange, answer_request
from hardware.emulator.software import Software
from hardware.emulator.vial import Vial

REQUEST = "request"  # owner of the events of the request being served
ERROR_PAGE = b"<!doctype html>\n<title>500 Internal Server Error</title>\n<h1>Internal Server Error</h1>\n"
BOOT_S = 8.0  # from a dead worker to a serving one
REQUEST_S = 0.005  # what any request takes
WORKER_TIMEOUT_S = 30.0  # gunicorn kills a worker whose request takes longer
POWER_LATCH_S = 1.0  # the watchdog cuts power about a second after the software stopped


class Supervisor:
    """Emulated gunicorn supervisor: runs at most one worker and queues its requests.

    Args: vials: whose power it switches.
    Attributes: software, of the current or last worker; deadline, when the worker is killed for a slow request; alive,
      whether requests are accepted; restarts and exits, counts.
    """

    def __init__(self, computer: Computer, vials: Mapping[str, Vial]) -> None:
        self._computer, self._vials = computer, vials
        self.alive, self.deadline, self.restarts, self.exits = True, 0.0, 0, 0
        self._waiting: deque[Exchange] = deque()
        self._serving: Exchange | None = None
        self._start()

    def _start(self) -> None:
        """Import of the app: every position initialised, power on, all outputs off; then its worker serves."""
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
        """Threads and memory are gone, and the request being served breaks off; the latch cuts the power soon."""
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
        """Replace the worker as gunicorn does: state wiped, requests wait until the new one has booted."""
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
        """Exit code 4: gunicorn gives up; no more requests are accepted."""
        self._end_process()
        self.alive = False
        self.exits += 1
        while self._waiting:
            self._waiting.popleft().fate = "reset"

    def crash(self) -> None:
        """Fault: the software ends itself, as after too many bus failures."""
        self._computer.note("crashed on demand")
        self.exit()

    def cut_power(self) -> None:
        """Fault: the whole board loses power; its clock starts again at its first date."""
        self.crash()
        self._computer.wall_offset_s = -self._computer.now()
        self._power_off()

    def restart(self) -> None:
        """Somebody starts the software again by hand: defaults, nothing running."""
        if not self.alive:
            self.alive = True
            self._start_soon()
