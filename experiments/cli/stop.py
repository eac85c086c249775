"""How a command stops: Ctrl-C, SIGTERM and SIGHUP alike; and worker processes that never outlive it."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import ParamSpec, TypeVar

from experiments.cli import extensions
from experiments.cli.messages import PumpsBeingEnded

__all__ = [
    "SIGNALS", "STATUS", "Pause", "Workers", "handled", "heard", "interrupts", "one_interrupt", "pausing",
    "undisturbed", "unmasked",
]  # fmt: skip

P = ParamSpec("P")
T = TypeVar("T")
log = logging.getLogger(__name__)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
CLUSTER = (signal.SIGUSR1, signal.SIGUSR2)  # how a batch system says that a job's time is nearly over
STATUS = 130  # of a stopped command, as shells have it for Ctrl-C
AGAIN_S = 0.1  # after which a stop that was lost is raised once more


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """Let these signals call `handler` for a while, except those that are ignored on purpose (nohup)."""
    before = {n: old for n in numbers if (old := signal.getsignal(n)) is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


class _Wait:
    """Whether a stop waits; the number of one that does; whether the last has arrived, and it while on its way."""

    asked = heard = False
    came = 0
    stop: Callable[[], KeyboardInterrupt | None] = staticmethod(lambda: None)


class _Stop(KeyboardInterrupt):
    """A stop on its way: it lives until somebody has handled it, or lost it."""

    def __init__(self) -> None:
        _Wait.stop = weakref.ref(self)  # here, where no frame of its traceback holds it


def heard() -> None:
    """Note that a stop was handled: whoever handles one and goes on calls this, so that nothing stops it again."""
    _Wait.heard = True


def _arrives() -> bool:
    return _Wait.heard or _Wait.stop() is not None


def _interrupt(number: int, stack: FrameType | None) -> None:
    """Raise a stop, again and again until it arrives.

    A handler runs between two steps of any Python code, and whatever C code has called that may take what it raises
    for an answer: NumPy asks operands for `__array_ufunc__`, an enum answers in Python, an error means no.
    """
    if _Wait.asked:
        _Wait.came = number
        return

    def again(alarm: int, stack: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0 if _Wait.heard else AGAIN_S)
        if not _arrives():
            signal.raise_signal(number)  # whoever listens now may put it off

    signal.signal(signal.SIGALRM, again)
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    raise _Stop


@contextmanager
def _stopping(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Send the signals of a stop to `handler`; one that leaves this context has arrived."""
    before, _Wait.heard = signal.getsignal(signal.SIGALRM), False
    try:
        with handled(handler, *SIGNALS):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Inside, a stop waits: for calls that take a queue's lock, which a KeyboardInterrupt might leave taken for good.

    Whoever needs that lock next, if only to close the writer at the end, would wait for ever. Not to be nested.
    """
    _Wait.asked = True
    try:
        yield
    finally:
        _Wait.asked = False
        if _Wait.came:
            number, _Wait.came = _Wait.came, 0
            _interrupt(number, None)


@contextmanager
def interrupts() -> Iterator[None]:
    """Ctrl-C, SIGTERM (a service manager, a shutting-down PC) or SIGHUP (a closed terminal) raise KeyboardInterrupt."""
    with _stopping(_interrupt):
        yield


@contextmanager
def one_interrupt() -> Iterator[None]:
    """As `interrupts`, but only the first: others do not cut short the switching off of pumps, nor the summary."""

    def answer(number: int, stack: FrameType | None) -> None:
        if _arrives():
            log.warning(PumpsBeingEnded())
        else:
            _interrupt(number, stack)

    with _stopping(answer):
        yield


@contextmanager
def unmasked() -> Iterator[None]:
    """Turn an ImportError that a stop caused while an extension module was loaded back into a KeyboardInterrupt."""
    try:
        yield
    except (ImportError, SystemError) as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        raise KeyboardInterrupt from error


class Pause:
    """Signals that wait until the work can be saved, and then go to whoever listened for them before.

    Args: until: when it will look, for the user.
    """

    def __init__(self, until: str) -> None:
        self._until = until
        self._before = {int(n): signal.getsignal(n) for n in (*SIGNALS, *CLUSTER)}
        self._came: list[int] = []

    def __call__(self) -> bool:
        """Whether a signal waits."""
        return bool(self._came)

    def answer(self, number: int, stack: FrameType | None) -> None:
        """Handle a signal. A second one from the user ends the program at once; a cluster may repeat its own.

        A worker hears it from the terminal and from its command, which then waits for it.
        """
        old = self._before[number]
        ours = number in SIGNALS and (not callable(old) or old.__module__ in (__name__, "_signal", "signal"))
        if self._came and ours and multiprocessing.parent_process() is None:
            print("stopped at once; what was saved before is whole", file=sys.stderr, flush=True)
            os._exit(STATUS)
        if not self._came:
            print(f"stopping {self._until}; once more stops at once", flush=True)
        self._came.append(number)

    def pass_on(self) -> None:
        """Give what came to whoever listened before: a batch system queues the job again, or lets it work on.

        Raises: KeyboardInterrupt where nobody listened, or whatever the listener raises.
        """
        came, self._came = self._came, []
        for number in dict.fromkeys(came):
            old = self._before[number]
            if not callable(old):
                raise KeyboardInterrupt
            old(number, None)


@contextmanager
def pausing(until: str) -> Iterator[Pause]:
    """Inside, the first signal only makes the yielded pause true; a second one from the user ends the program at once.

    For work that can be saved between two of its steps only. Args: until: when it will look, for the user.
    """
    pause = Pause(until)
    with handled(pause.answer, *SIGNALS, *CLUSTER):
        yield pause


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
