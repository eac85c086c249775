"""How a command stops: Ctrl-C, SIGTERM and SIGHUP alike; and worker processes that never outlive it."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import ParamSpec, TypeVar

from experiments.cli import extensions

__all__ = ["SIGNALS", "STATUS", "Workers", "handled", "interrupts", "pausing"]

P = ParamSpec("P")
T = TypeVar("T")

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STATUS = 130  # of a stopped command, as shells have it for Ctrl-C


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """These signals call `handler` for a while, except those that are ignored on purpose (nohup)."""
    before = {n: old for n in numbers if (old := signal.getsignal(n)) is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def interrupts() -> Iterator[None]:
    """SIGTERM (a service manager, a shutting-down PC) and SIGHUP (a closed terminal) raise KeyboardInterrupt."""

    def interrupt(number: int, stack: FrameType | None) -> None:
        raise KeyboardInterrupt

    with handled(interrupt, signal.SIGTERM, signal.SIGHUP):
        yield


@contextmanager
def pausing(until: str) -> Iterator[Callable[[], bool]]:
    """Inside, the first signal only makes the yielded function true; a second one ends the program at once.

    For work that can be saved between two of its steps only. Args: until: when it will look, for the user.
    """
    asked = threading.Event()

    def answer(number: int, stack: FrameType | None) -> None:
        if asked.is_set():
            print("stopped at once; what was saved before is whole", file=sys.stderr, flush=True)
            os._exit(STATUS)
        asked.set()
        print(f"stopping {until}; once more stops at once", flush=True)

    with handled(answer, *SIGNALS):
        yield asked.is_set


def _begin_worker() -> None:
    """In a worker: what the command loaded; and it ends when its parent does, also when that was killed."""
    extensions.load_all()
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(STATUS)

    threading.Thread(target=watch, daemon=True).start()


class Workers(ProcessPoolExecutor):
    """Spawned worker processes that leave signals from the terminal to the command; left by an exception, they end.

    Spawned, because a fork would copy torch's threads in whatever state they are.
    Args: count: of processes; 0 for one per core.
    """

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        super().__init__(count or os.cpu_count() or 1, mp_context=context, initializer=_begin_worker)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """As of an executor. A process started here inherits which signals are held back."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)
