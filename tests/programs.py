"""Programs as a user starts them, each in a process of its own that has the slow imports behind it.

Every process is forked from one server that has imported torch and the rest once, so that a command costs what it does
and not the 3 s before it. What matters of a process is real: arguments, environment, folder, standard output and error,
exit status, limits, signals, sudden death. Only tests of an interpreter's start or end need one of their own.
"""

import multiprocessing
import os
import resource
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing import forkserver, process
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.patience import PATIENCE_S

__all__ = ["OURS", "ROOT", "Program", "run", "spent_s"]

ROOT = Path(__file__).parents[1]
OURS = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.preloaded"])
Stream = str | Connection


def _serve() -> None:
    """Start the server with the environment of its programs: libraries read some of it when they are imported."""
    before = dict(os.environ)
    os.environ.update(OURS)
    try:
        forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)


def spent_s() -> float:
    """Processor time of all programs that have ended so far, s; a test runner does not see it as its children's."""
    server = getattr(forkserver._forkserver, "_forkserver_pid", None)
    with suppress(OSError):
        words = Path(f"/proc/{server}/stat").read_text().rpartition(") ")[2].split()
        return sum(map(int, words[13:15])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _begin(
    words: Sequence[str], cwd: str, environment: Mapping[str, str], streams: Sequence[Stream], limit: int | None
) -> None:
    """In the new process: `python -m WORDS`, or `python -c CODE WORDS`."""
    for number, stream in enumerate(streams, 1):
        target = os.open(stream, os.O_WRONLY | os.O_APPEND) if isinstance(stream, str) else stream.fileno()
        os.dup2(target, number)
    os.setsid()
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    process._parent_process = None  # type: ignore[attr-defined]  # it is nobody's worker
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    if environment.get("WITHOUT_FIGURES"):
        from matplotlib.figure import Figure

        from experiments.reporting import charts

        save = charts.save
        charts.save = lambda figure, folder, name: save(Figure((1.0, 1.0)), folder, name)
    sys.argv = [words[0], *words[1 + (words[0] == "-c") :]]
    if words[0] == "-c":
        exec(words[1], {"__name__": "__main__"})
    else:
        sys.modules.pop(words[0], None)
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)


class Program:
    """`python -m WORDS` at work, a session of its own; killed at the end of a `with` block.

    Args:
      words: module and arguments, or "-c", code and arguments. cwd: its folder. limit: bytes that a file may have; more
      is refused as by a full disk. out, err: files its streams go to, one for both where `err` is not given, or the
      end of a pipe. environment: beside that of the tests; WITHOUT_FIGURES=1: they are blank.
    """

    def __init__(
        self,
        *words: str,
        cwd: Path,
        out: Path | Connection,
        err: Path | None = None,
        limit: int | None = None,
        **environment: str,
    ) -> None:
        _serve()
        self._paths = list(dict.fromkeys(path for path in (out, err) if isinstance(path, Path)))
        for path in self._paths:
            path.touch()
        streams = [str(one.resolve()) if isinstance(one, Path) else one for one in (out, err or out)]
        given = {**os.environ, **OURS, **environment}
        self._process = CONTEXT.Process(target=_begin, args=(words, str(cwd), given, streams, limit))
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    def poll(self) -> int | None:
        """The status of a program that has ended, None of one at work."""
        return self._process.exitcode

    def wait(self, seconds: float = PATIENCE_S) -> int:
        """Its status, once it has ended. Raises: AssertionError where it does not."""
        self._process.join(seconds)
        status = self._process.exitcode
        assert status is not None, f"still at work after {seconds:g} s: {self.said()}"
        return status

    def until(self, there: Callable[[], bool]) -> None:
        """Wait for what the program brings about. Raises: AssertionError where it has ended without."""
        deadline = time.monotonic() + PATIENCE_S
        while not there():
            assert time.monotonic() < deadline, self.said()
            assert self.poll() is None, self.said()
            time.sleep(0.01)

    def end(self) -> tuple[int, str]:
        """Status and what was said, after it has ended by itself."""
        return self.wait(), self.said()

    def said(self) -> str:
        """Standard output and error so far."""
        return "".join(path.read_text(errors="replace") for path in self._paths)

    def send_signal(self, number: int) -> None:
        """To the program alone."""
        with suppress(ProcessLookupError):  # its server may have collected it since
            if self.poll() is None:
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *raised: object) -> None:
        self.kill()
        self.wait()


def run(
    *words: str, cwd: Path, seconds: float = PATIENCE_S, limit: int | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """`python -m WORDS` to its end. Args: as of `Program`."""
    with TemporaryDirectory() as name:
        out, err = Path(name, "out"), Path(name, "err")
        with Program(*words, cwd=cwd, out=out, err=err, limit=limit, **environment) as program:
            status = program.wait(seconds)
        return subprocess.CompletedProcess(words, status, out.read_text(), err.read_text())
