"""Stop of a command by Ctrl-C, SIGTERM or SIGHUP, and worker processes that end with the command."""

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

P = ParamSpec("P")
T = TypeVar("T")
log = logging.getLogger(__name__)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
CLUSTER = (signal.SIGUSR1, signal.SIGUSR2)  # signals of a batch system before a job's time limit
STATUS = 130  # exit status of a stopped command, as in shells for Ctrl-C
AGAIN_S = 0.1  # time after which a lost stop is raised again


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """Let these signals call `handler` in this context, except a signal that is ignored on purpose (nohup)."""
    before = {n: old for n in numbers if (old := signal.getsignal(n)) is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def blocked(*numbers: int) -> Iterator[None]:
    """Let these signals wait in this context, so that none arrives between two handlers."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Wait:
    """State of stops. asked: stops must wait. came: waiting signal. heard: last stop was handled. stop: last stop."""

    asked = heard = False
    came = 0
    stop: Callable[[], KeyboardInterrupt | None] = staticmethod(lambda: None)


class _Stop(KeyboardInterrupt):
    """A raised stop. The object exists until the stop is handled or lost."""

    def __init__(self) -> None:
        _Wait.stop = weakref.ref(self)  # here, because no frame of the traceback references the stop yet


def heard() -> None:
    """Note that a stop was handled. Code that handles a stop and continues must call this."""
    _Wait.heard = True


def _arrives() -> bool:
    return _Wait.heard or _Wait.stop() is not None


def _interrupt(number: int, stack: FrameType | None) -> None:
    """Raise a stop, and raise it again every `AGAIN_S` until it is handled.

    A handler runs between two steps of any Python code. If C code called this Python code, the C code may swallow the
    exception. For example, when NumPy looks up an attribute of an operand, it takes any error as "no such attribute".
    """
    if _Wait.asked:
        _Wait.came = number
        return

    def again(alarm: int, stack: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0 if _Wait.heard else AGAIN_S)
        if not _arrives():
            signal.raise_signal(number)  # the current handler may delay it

    signal.signal(signal.SIGALRM, again)
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    raise _Stop


@contextmanager
def _stopping(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Send the signals of a stop to `handler`. After this context a raised stop is not raised again."""
    before, _Wait.heard = signal.getsignal(signal.SIGALRM), False
    try:
        with handled(handler, *SIGNALS):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay stops in this context, for a call that could leave a lock locked after a KeyboardInterrupt.

    The next user of the lock, e.g. the writer's close, would wait without limit. Do not nest.
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
    """Raise KeyboardInterrupt on Ctrl-C, SIGTERM (service manager, shutdown of the PC) or SIGHUP (closed terminal)."""
    with _stopping(_interrupt):
        yield


@contextmanager
def one_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt only for the first stop, so that later ones do not interrupt switching off the pumps."""

    def answer(number: int, stack: FrameType | None) -> None:
        if _arrives():
            log.warning(PumpsBeingEnded())
        else:
            _interrupt(number, stack)

    with _stopping(answer):
        yield


@contextmanager
def unmasked() -> Iterator[None]:
    """Raise KeyboardInterrupt instead of the ImportError that a stop causes while a C extension is loading."""
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
    """Handler that keeps signals until the work is saved, and then passes them to their previous handlers.

    Args: until: text shown to the user: when the work will stop.
    """

    def __init__(self, until: str) -> None:
        self._until = until
        self._before = {int(n): signal.getsignal(n) for n in (*SIGNALS, *CLUSTER)}
        self._came: list[int] = []

    def __call__(self) -> bool:
        """Return whether a signal is waiting."""
        return bool(self._came)

    def answer(self, number: int, stack: FrameType | None) -> None:
        """Handle a signal. A second stop by the user ends the program at once; a second signal of a cluster does not.

        A second signal does not end a worker, because a worker gets each stop twice: from terminal and command.
        """
        old = self._before[number]
        ours = number in SIGNALS and (not callable(old) or old.__module__ in (__name__, "_signal", "signal"))
        if self._came and ours and multiprocessing.parent_process() is None:
            print("stopped at once; data saved earlier is complete", file=sys.stderr, flush=True)
            os._exit(STATUS)
        if not self._came:
            print(f"stopping {self._until}; a second signal stops at once", flush=True)
        self._came.append(number)

    def pass_on(self) -> None:
        """Pass the signal to its previous handler. A batch system's handler requeues the job or lets it continue.

        Raises: KeyboardInterrupt without a previous handler, or the handler's own exception.
        """
        came, self._came = self._came, []
        for number in dict.fromkeys(came):
            old = self._before[number]
            if not callable(old):
                raise KeyboardInterrupt
            old(number, None)


@contextmanager
def pausing(until: str) -> Iterator[Pause]:
    """Let the first signal only set the yielded pause. A second stop by the user ends the program at once.

    Use this context only for work that can be saved between two steps. Args: as of `Pause`.
    """
    pause = Pause(until)
    with handled(pause.answer, *SIGNALS, *CLUSTER):
        yield pause


def _begin_worker() -> None:
    """Prepare a worker: load the command's extensions, and end when the parent ends or is killed."""
    extensions.load_all()
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(STATUS)

    threading.Thread(target=watch, daemon=True).start()


class Workers(ProcessPoolExecutor):
    """Pool of worker processes that leave terminal signals to the command. An exception in the context ends the pool.

    The workers are spawned, because a fork would copy torch's threads in an arbitrary state.
    Args: count: number of processes; 0 for one per core.
    """

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        super().__init__(count or os.cpu_count() or 1, mp_context=context, initializer=_begin_worker)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Submit a call while terminal signals are blocked, because a new process inherits blocked signals."""
        with blocked(signal.SIGINT, signal.SIGHUP):
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)
