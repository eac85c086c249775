"""One fork a mutant: of a process that holds the collected tests, or of one that holds third-party modules only."""

from __future__ import annotations

import gc
import importlib
import importlib.util
import itertools
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import types
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.machinery import SourceFileLoader
from typing import Any

import pytest

from tests.mutants.operators import Module, Mutant

ROOMS = ("conf", "dqn", "envs", "experiments", "hardware", "tests")
BROKEN = 70  # exit status of a fork in which this tool itself failed
LIMIT_S = 10.0  # on top of three times what the tests take unmutated
BUDGET_S = 20.0  # of the processor for one mutant, as timed under trace: the fastest tests

Tell = Callable[[Mutant, str], None]
"""Takes a mutant and what became of it."""


def forked(work: Callable[[int], int], limit_s: float) -> tuple[int | None, bytes]:
    """Exit status of `work` in a fork, None beyond the limit, and what it wrote to the descriptor it is given."""
    reader, writer = os.pipe()
    if (pid := os.fork()) == 0:
        os.setpgid(0, 0)
        os.close(reader)
        nothing = os.open(os.devnull, os.O_RDWR)
        for fd in (0, 1, 2):
            os.dup2(nothing, fd)
        status = BROKEN
        with suppress(BaseException):
            status = work(writer)
        os._exit(status)
    os.close(writer)
    chunks: list[bytes] = []
    drain = threading.Thread(target=lambda: chunks.extend(iter(lambda: os.read(reader, 1 << 20), b"")))
    drain.start()
    status, until = None, time.monotonic() + limit_s
    while status is None and time.monotonic() < until:
        done, code = os.waitpid(pid, os.WNOHANG)
        if done:
            status = os.waitstatus_to_exitcode(code)
        else:
            time.sleep(0.002)
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # with whatever processes the tests have left
    if status is None:
        os.waitpid(pid, 0)
    drain.join()
    os.close(reader)
    return status, b"".join(chunks)


class Lines:
    """Which test runs which line of some files, by the interpreter's trace."""

    def __init__(self, files: set[str]) -> None:
        self._files = files
        self.seen: dict[tuple[str, int], set[str | None]] = defaultdict(set)
        self.test: str | None = None  # None: the import

    def _line(self, frame: types.FrameType, event: str, _: Any) -> Any:
        self.seen[frame.f_code.co_filename, frame.f_lineno].add(self.test)
        return self._line

    def _call(self, frame: types.FrameType, event: str, _: Any) -> Any:
        return self._line if frame.f_code.co_filename in self._files else None

    def on(self) -> None:
        """Begin."""
        threading.settrace(self._call)
        sys.settrace(self._call)

    def off(self) -> None:
        """End, in this thread and in new ones."""
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]


def options(base: str, *more: str) -> list[str]:
    """Arguments of pytest: nothing kept between runs, no second process; `base`: folder for temporary files."""
    return [
        "-x", "-q", "-p", "no:cacheprovider", "-n", "0", "-W", "ignore::pytest.PytestAssertRewriteWarning",
        "--basetemp", base, *more,
    ]  # fmt: skip


class Deterministic:
    """Plugin: property tests draw the same examples each time."""

    def pytest_configure(self, config: pytest.Config) -> None:
        """After the plugins are loaded, before tests are imported."""
        from hypothesis import HealthCheck, settings

        quiet = list(HealthCheck)
        settings.register_profile(
            "mutants", derandomize=True, database=None, deadline=None, suppress_health_check=quiet
        )
        settings.load_profile("mutants")


class Server(Deterministic):
    """Plugin in place of pytest's loop: holds the collected tests, and forks for each mutant."""

    def __init__(self, modules: list[Module], chosen: list[Mutant], tell: Tell, shown: int) -> None:
        self._modules = {m.path: m for m in modules}
        self._chosen, self._tell, self._shown = chosen, tell, shown
        self._lines = Lines({m.file for m in modules})
        self.left: list[Mutant] = []  # to be imported
        self.seconds: dict[str, float] = {}
        self.tests: dict[tuple[str, int], set[str | None]] = {}
        self._lines.on()  # the import

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A failure ends a fork at once."""
        if report.failed:
            if not self.tests:  # without a mutant
                os.write(self._shown, f"{report.nodeid} fails without a mutant\n{report.longreprtext}\n".encode())
            os._exit(1)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """All mutants of functions."""
        self._lines.off()
        assert session.items, "no tests collected"
        self._items = {item.nodeid: item for item in session.items}
        status, answer = forked(self._baseline, 1800.0)
        if status:
            raise pytest.UsageError("the tests fail without a mutant")
        self.seconds, self.tests = pickle.loads(answer)
        self._functions = self._index()
        gc.freeze()
        for mutant in self._chosen:
            self._one(mutant)
        return True

    def _run(self, names: list[str]) -> None:
        items = [self._items[name] for name in names]
        for item, following in zip(items, [*items[1:], None], strict=True):
            self._lines.test, start = item.nodeid, time.process_time()
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
            self.seconds[item.nodeid] = time.process_time() - start  # whatever else the machine does

    def _baseline(self, out: int) -> int:
        """All tests once, under trace; writes durations and lines."""
        self._lines.on()
        self._run(list(self._items))
        self._lines.off()
        data = pickle.dumps((self.seconds, dict(self._lines.seen)))
        with os.fdopen(out, "wb") as f:
            f.write(data)
        return 0

    def _index(self) -> dict[tuple[str, str], list[types.FunctionType]]:
        """The functions of the modules, wherever they are held."""
        found = defaultdict(list)
        files = {m.file: m.path for m in self._modules.values()}
        for thing in gc.get_objects():
            if type(thing) is types.FunctionType and thing.__code__.co_filename in files:
                found[files[thing.__code__.co_filename], thing.__code__.co_qualname].append(thing)
        return found

    def covering(self, mutant: Mutant) -> set[str | None]:
        """The tests that run its statement; None among them if the import does."""
        file = self._modules[mutant.path].file
        first, last = mutant.lines
        return set().union(*(self.tests.get((file, line), set()) for line in range(first, last + 1)))

    def order(self, tests: set[str | None]) -> list[str]:
        """The fastest first, as many as there is time for."""
        order = sorted((t for t in tests if t), key=lambda t: self.seconds[t])
        until = itertools.accumulate(self.seconds[t] for t in order)
        return [t for k, (t, s) in enumerate(zip(order, until, strict=True)) if k == 0 or s <= BUDGET_S]

    def _one(self, mutant: Mutant) -> None:
        tests = self.covering(mutant)
        name = mutant.owner[0] if mutant.owner else ""
        new = next((c for c in nested(self._modules[mutant.path].code(mutant)) if c.co_qualname == name), None)
        old = self._functions[mutant.path, name]
        if None in tests or new is None or any(f.__code__.co_freevars != new.co_freevars for f in old):
            self.left.append(mutant)
            return
        order = self.order(tests)
        limit = LIMIT_S + 3.0 * sum(self.seconds[t] for t in order)
        self._tell(mutant, outcome(forked(lambda _: self._try(old, new, order), limit)[0]) if order else "not run")

    def _try(self, functions: list[types.FunctionType], code: types.CodeType, tests: list[str]) -> int:
        for function in functions:
            function.__code__ = code
        try:
            self._run(tests)
        except BaseException:
            return 1  # what no test may let out
        return 0


def nested(code: types.CodeType) -> Iterator[types.CodeType]:
    """All code objects inside one."""
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield constant
            yield from nested(constant)


def outcome(status: int | None) -> str:
    """What became of a mutant, by how its process ended; a crash of the interpreter is a failure, too."""
    if status == BROKEN:
        raise SystemExit("the fork of a mutant failed by itself")
    return "time-out" if status is None else "survived" if status == 0 else "killed"


def imported(module: Module, mutant: Mutant, tests: list[str], base: str) -> int:
    """Run tests, file by file, with the mutated module imported in place of the real one; 0 if all of them pass."""

    class Mutated(SourceFileLoader):
        def get_code(self, fullname: str) -> types.CodeType:
            return module.code(mutant)

    class Finder:
        @staticmethod
        def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
            if name == module.name:
                return importlib.util.spec_from_file_location(name, module.file, loader=Mutated(name, module.file))
            return None

    sys.meta_path.insert(0, Finder())  # type: ignore[arg-type]
    files = dict.fromkeys(test.split("::")[0] for test in tests)
    runs = (pytest.main(options(base, *(t for t in tests if t.split("::")[0] == f)), [Deterministic()]) for f in files)
    return next((1 for status in runs if status), 0)


def run_group(modules: list[Module], tests: list[str], chosen: list[Mutant], tell: Tell) -> None:
    """Try the chosen mutants of some modules with some tests; the results go to `tell`."""
    shown, base = os.dup(1), f"{tempfile.gettempdir()}/mutants.{os.getpid()}"
    told: list[tuple[int, str]] = []

    def serve(out: int) -> int:
        def say(mutant: Mutant, result: str) -> None:
            told.append((chosen.index(mutant), result))
            if os.isatty(shown):
                os.write(shown, f"\r{len(told)} of {len(chosen)}\r".encode())

        server = Server(modules, chosen, say, shown)
        if pytest.main(options(base, *tests), [server]):
            return 1
        third_party = [name for name in sys.modules if name.split(".")[0] not in (*ROOMS, "__main__")]
        left = []
        for mutant in server.left:
            near = {t for t in server.covering(mutant) if t}
            file = server._modules[mutant.path].file
            own = {t.split("::")[0] for (f, _), names in server.tests.items() if f == file for t in names if t}
            whole = {t for t in server.seconds if t.split("::")[0] in own}
            order = server.order(near or whole)
            total: dict[str, float] = defaultdict(float)
            for t in order:
                total[t.split("::")[0]] += server.seconds[t]
            order.sort(key=lambda t: total[t.split("::")[0]])
            left.append((chosen.index(mutant), order, sum(server.seconds[t] for t in order)))
        with os.fdopen(out, "wb") as f:
            pickle.dump((told, left, third_party), f)
        return 0

    status, answer = forked(serve, 1e9)
    if status:
        raise SystemExit("the tests could not be collected, or fail without a mutant")
    told, left, third_party = pickle.loads(answer)
    for index, result in told:
        tell(chosen[index], result)
    for name in third_party:
        with suppress(Exception):
            importlib.import_module(name)
    of = {m.path: m for m in modules}
    for index, order, seconds in left:
        mutant = chosen[index]
        status, _ = forked(lambda _, m=mutant, o=order: imported(of[m.path], m, o, base), LIMIT_S + 3.0 * seconds)
        tell(mutant, outcome(status) if order else "not run")
