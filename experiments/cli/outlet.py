"""Output without waiting: a bounded queue, and a thread that writes it."""

import atexit
import logging
import os
import queue
import stat
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Generic, TextIO, TypeVar

T = TypeVar("T")
LAST_S, WAITING = 2.0, 2000  # longest wait for output at the program's end, s; largest number of queued pieces


class Outlet(Generic[T]):
    """A queue of at most `size` items, and a thread that sends them in order. `put` neither waits nor raises.

    Attributes: dropped: number of items dropped because the queue was full.
    """

    def __init__(self, send: Callable[[T], None], size: int) -> None:
        self._send, self._size, self._over, self.dropped = send, size, False, 0
        self._waiting: queue.SimpleQueue[T | None] = queue.SimpleQueue()  # a signal's handler may also put items
        self._thread = threading.Thread(target=self._deliver, daemon=True)
        self._thread.start()

    def put(self, one: T) -> bool:
        """Queue an item; return whether there was room."""
        if room := self._waiting.qsize() < self._size:
            self._waiting.put(one)
        self.dropped += not room
        return room

    def _deliver(self) -> None:
        while (one := self._waiting.get()) is not None and not self._over:
            with suppress(OSError):  # there is no reader
                self._send(one)

    def close(self, within_s: float) -> int:
        """Wait at most `within_s` for queued items, then drop them; return how many were dropped."""
        self._waiting.put(None)
        self._thread.join(within_s)
        self._over = self._thread.is_alive()
        return max(self._waiting.qsize() - 1, 0)


class Screen:
    """A standard stream that never makes its writer wait. It counts dropped lines and reports their number later."""

    def __init__(self, stream: TextIO, size: int = WAITING) -> None:
        self._stream, self._number, self._lines = stream, stream.fileno(), 0
        self.outlet = Outlet(self._out, size)

    def write(self, text: str) -> int:
        """Queue the text; return its length."""
        lost = f"... {self._lines} lines are missing here, because the screen was blocked; the log file has all lines\n"
        room = self.outlet.put((lost * bool(self._lines) + text).encode(self._stream.encoding, "replace"))
        self._lines = 0 if room else self._lines + text.count("\n")
        return len(text)

    def _out(self, left: bytes) -> None:
        while left:
            left = left[os.write(self._number, left) :]

    def close(self) -> None:
        """Report the number of dropped lines, and wait at most `LAST_S` for queued output."""
        self.write("")
        self.outlet.close(LAST_S)

    def flush(self) -> None:
        """Do nothing: no text is kept back."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _may_wait(stream: TextIO) -> bool:
    """Return whether the stream's reader can block a writer, as a terminal (Ctrl-S), a pipe or a socket can."""
    try:
        mode = os.fstat(stream.fileno()).st_mode
    except (AttributeError, OSError, ValueError):
        return False
    return not isinstance(stream, Screen) and (stream.isatty() or stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode))


def detach() -> None:
    """Write standard output and standard error through threads, so that no caller waits for a reader. Idempotent."""
    for name in ("stdout", "stderr"):
        before = getattr(sys, name)
        if not _may_wait(before):
            continue
        setattr(sys, name, after := Screen(before))
        atexit.register(after.close)
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream is before:
                handler.stream = after
