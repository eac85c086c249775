"""The device's web worker: one request at a time, the others wait."""

from __future__ import annotations

from collections import deque

from hardware.emulator.computer import AppError
from hardware.emulator.events import Steps
from hardware.emulator.exchange import Exchange
from hardware.emulator.routes import HTML, answer_request
from hardware.emulator.software import Software

__all__ = ["REQUEST", "WebWorker"]

REQUEST = "request"  # owner of the events of the request being served
ERROR_PAGE = b"<!doctype html>\n<title>500 Internal Server Error</title>\n<h1>Internal Server Error</h1>\n"


class WebWorker:
    """The worker and the requests that wait for it.

    Args: request_s: what any request takes; timeout_s: how long one may take.
    `software` is what it runs, `ready` whether it serves, `deadline` when the request being served has taken too long.
    """

    def __init__(self, software: Software, request_s: float, timeout_s: float) -> None:
        self.software, self.ready, self.deadline = software, True, 0.0
        self._request_s, self._timeout_s = request_s, timeout_s
        self._waiting: deque[Exchange] = deque()
        self._serving: Exchange | None = None

    def boot(self, software: Software) -> None:
        """Serve again, with other software."""
        self.software, self.ready = software, True
        self._serve_next()

    def end(self) -> None:
        """Serve no more; the request being served breaks off."""
        self.ready = False
        if self._serving is not None:
            self._serving.fate, self._serving = "reset", None

    def turn_away(self) -> None:
        """Nobody will serve those that wait."""
        while self._waiting:
            self._waiting.popleft().fate = "reset"

    def accept(self, exchange: Exchange) -> None:
        """A request has arrived."""
        self._waiting.append(exchange)
        self._serve_next()

    def _serve_next(self) -> None:
        if self.ready and self._serving is None and self._waiting:
            self._serving = self._waiting.popleft()
            computer = self.software.computer
            self.deadline = computer.now() + self._timeout_s
            computer.spawn(self._serve(self._serving), REQUEST)

    def _serve(self, exchange: Exchange) -> Steps:
        computer = self.software.computer
        faults = computer.faults
        hang, faults.hang_s = faults.hang_s, 0.0
        yield self._request_s + hang
        self.software.foreign_select()
        try:
            answer = yield from answer_request(self.software, exchange)
        except (AppError, ArithmeticError, LookupError, TypeError, ValueError) as problem:
            computer.note(f"{exchange.method} {exchange.path}: {type(problem).__name__}: {problem}")
            answer = (500, ERROR_PAGE, HTML)
        if faults.take("lost_reply"):
            exchange.fate = "lost"
        elif faults.take("reset_after"):
            exchange.fate = "reset"
        else:
            exchange.answer = answer
        self._serving = None
        self._serve_next()
