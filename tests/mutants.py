"""Mutation testing: small faults are put into the code one at a time, and the tests must notice each of them.

    python -m tests.mutants                                       # all of TABLE, in minutes
    python -m tests.mutants module=hardware/safety,dqn/agent.py   # some of it
    python -m tests.mutants sample=200 seed=1                     # a sample of it

For each row of TABLE one process imports everything and collects the tests. A fork of it runs them once and notes which
test runs which line, and how long it takes. Then each mutant gets a fork of its own, in which the code object of the
changed function is exchanged and only the tests that run the changed line are run, the fastest first, until one fails.
A fork costs some hundredths of a second where a fresh interpreter would take seconds to import torch. Code that runs at
import (constants, config fields, default arguments) cannot be exchanged; for it a fork of the bare process imports the
mutated module in place of the real one.

The score of a module is killed / (all - equivalent). Equivalent mutants are those listed, with the reason, in
docs/mutation.md. Results are printed, and written to runs/mutants.json.
"""

from __future__ import annotations

import ast
import copy
import datetime
import gc
import importlib
import importlib.util
import json
import os
import pickle
import random
import re
import signal
import sys
import tempfile
import threading
import time
import types
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
LISTED = ROOT / "docs" / "mutation.md"
ROOMS = ("conf", "dqn", "envs", "experiments", "hardware", "tests")
LIMIT_S = 20.0  # on top of ten times what the tests take unmutated

SAFETY, STORAGE, CHIBIO = "hardware/safety", "hardware/storage", "hardware/chibio"
TABLE = {
    "dqn": (
        [f"dqn/{name}.py" for name in (
            "agent", "targets", "replay", "trainer", "optimiser", "hindsight", "network", "checkpoint", "policy",
            "config",
        )],
        ["dqn", "test_settings.py"],
    ),
    "safety": (
        [f"{SAFETY}/{name}.py" for name in ("budget", "config", "interlock", "readings", "unexplained_change")],
        ["hardware/test_interlock.py", "hardware/test_safety_limits.py", "test_settings.py"],
    ),
    "storage": (
        [f"{STORAGE}/{name}.py" for name in ("journal", "atomic", "recorder")],
        ["hardware/test_disk.py", "hardware/test_atomic.py", "hardware/test_journal.py", "hardware/test_recording.py"],
    ),
    "dosing": (
        [f"{CHIBIO}/{name}.py" for name in (
            "dosing", "dose_sequence", "sampling", "resume", "agenda", "overflow_pump", "diagnosis",
        )],
        [f"hardware/test_{name}.py" for name in (
            "dosing", "dose_sequence", "sampling", "agenda", "diagnosis", "overflow_pump", "reactors",
        )] + ["test_settings.py"],
    ),
}  # fmt: skip
"""Which tests are asked about which modules; paths of tests are below tests/."""


# ------------------------------------------------------------------------------------------------------- operators

COMPARE: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
OPPOSITE = {"min": "max", "minimum": "maximum", "amin": "amax", "floor": "ceil", "any": "all", "first": "last"}
OPPOSITE |= {value: key for key, value in OPPOSITE.items()}


def is_text(node: ast.AST) -> bool:
    """A string or an f-string."""
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def altered(node: ast.AST, **fields: Any) -> ast.AST:
    """A copy of a node with some fields replaced."""
    new = copy.copy(node)
    for key, value in fields.items():
        setattr(new, key, value)
    return new


def without(items: list[Any], k: int) -> list[Any]:
    """The list but for its entry k."""
    return items[:k] + items[k + 1 :]


def of_constant(node: ast.Constant) -> Iterator[ast.AST]:
    """The other truth value; n + 1; twice a fraction, 1 for 0 and for a tolerance."""
    value = node.value
    if isinstance(value, bool):
        yield altered(node, value=not value)
    elif isinstance(value, int):
        yield altered(node, value=value + 1)
    elif isinstance(value, float):
        yield altered(node, value=2.0 * value if abs(value) > 1e-5 else 1.0)


def of_operator(node: ast.AST) -> Iterator[ast.AST]:
    """Another comparison, arithmetic or logical operator; a condition turned round."""
    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            for other in COMPARE[type(op)]:
                yield altered(node, ops=[*node.ops[:k], other(), *node.ops[k + 1 :]])
    elif (
        isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC and not (is_text(node.left) or is_text(node.right))
    ):
        yield altered(node, op=ARITHMETIC[type(node.op)]())
    elif isinstance(node, ast.BoolOp):
        yield altered(node, op=ast.And() if isinstance(node.op, ast.Or) else ast.Or())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
        yield node.operand
    if isinstance(node, ast.If | ast.IfExp | ast.While) and not isinstance(node.test, ast.Compare | ast.UnaryOp):
        yield altered(node, test=ast.UnaryOp(ast.Not(), node.test))


def of_call(node: ast.Call) -> Iterator[ast.AST]:
    """The opposite function, such as min for max; one keyword argument less."""
    f = node.func
    name = f.id if isinstance(f, ast.Name) else f.attr if isinstance(f, ast.Attribute) else ""
    if name in OPPOSITE:
        other = OPPOSITE[name]
        yield altered(node, func=altered(f, id=other) if isinstance(f, ast.Name) else altered(f, attr=other))
    for k, keyword in enumerate(node.keywords):
        if keyword.arg and not is_text(keyword.value):
            yield altered(node, keywords=without(node.keywords, k))


def of_statement(node: ast.AST) -> Iterator[ast.AST]:
    """A call, an assignment to an attribute or an entry, a raise or a jump left out; a result not returned."""
    if isinstance(node, ast.Return) and node.value is not None and words(node.value) != "None":
        yield altered(node, value=ast.Constant(None))
    stores = isinstance(node, ast.Assign) and not all(isinstance(t, ast.Name) for t in node.targets)
    calls = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    if stores or calls or isinstance(node, ast.AugAssign | ast.Raise | ast.Break | ast.Continue):
        yield ast.Pass()
    if isinstance(node, ast.AugAssign) and type(node.op) in ARITHMETIC:
        yield altered(node, op=ARITHMETIC[type(node.op)]())


def alternatives(node: ast.AST) -> Iterator[ast.AST]:
    """What a node may be replaced by."""
    if isinstance(node, ast.Constant):
        yield from of_constant(node)
    if isinstance(node, ast.Call):
        yield from of_call(node)
    yield from of_operator(node)
    yield from of_statement(node)


def skipped(parent: ast.AST, field: str, node: ast.AST) -> bool:
    """What no mutant is made of: texts, annotations, decorators, __all__, assertions, and what is raised."""
    if field in ("annotation", "returns", "decorator_list", "bases") or isinstance(parent, ast.Raise):
        return True
    if isinstance(node, ast.JoinedStr | ast.Assert | ast.Import | ast.ImportFrom):
        return True
    names = [t.id for t in getattr(node, "targets", ()) if isinstance(t, ast.Name)]
    alias = isinstance(parent, ast.Module) and isinstance(getattr(node, "value", None), ast.BinOp | ast.Subscript)
    return "__all__" in names or (alias and names == [n for n in names if n[0].isupper() and not n.isupper()])


# --------------------------------------------------------------------------------------------------------- mutants


@dataclass(frozen=True)
class Mutant:
    """One changed place of a module.

    where: qualified name of the function or class it is in. owner: qualified name and first line of the outermost
    function, None for code that runs at import. lines: of the statement, first and last. number: among the module's.
    """

    path: str
    number: int
    where: str
    owner: tuple[str, int] | None
    lines: tuple[int, int]
    was: str
    now: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """By what docs/mutation.md names it."""
        return (self.path, self.where, self.was, self.now)

    def __str__(self) -> str:
        return f"{self.path}:{self.lines[0]} `{self.where}` `{self.was}` → `{self.now}`"


Tell = Callable[[Mutant, str], None]
"""Takes a mutant and what became of it."""


def words(node: ast.AST) -> str:
    """A node as code in one line; of a compound statement its head."""
    return ast.unparse(node).split("\n")[0]


class Module:
    """The mutants of one file, and the code of each."""

    def __init__(self, path: str) -> None:
        self.path, self.file = path, str(ROOT / path)
        self.name = path.removesuffix(".py").replace("/", ".")
        self._tree = ast.parse((ROOT / path).read_text())
        self.mutants: list[Mutant] = []
        self._places: list[tuple[ast.AST, str, int | None, ast.AST]] = []
        self._visit(self._tree, "module", None, (1, 1))

    def _visit(self, parent: ast.AST, where: str, owner: tuple[str, int] | None, lines: tuple[int, int]) -> None:
        for field, value in ast.iter_fields(parent):
            nodes = list(enumerate(value)) if isinstance(value, list) else [(None, value)]
            for k, node in nodes:
                if not isinstance(node, ast.AST) or skipped(parent, field, node):
                    continue
                if isinstance(node, ast.stmt):
                    last = node.lineno if isinstance(getattr(node, "body", None), list) else node.end_lineno
                    lines = (node.lineno, last or node.lineno)
                elif isinstance(node, ast.expr):  # the head of a compound statement
                    lines = (lines[0], max(lines[1], node.end_lineno or 0))
                inside = field == "body" and owner is None and isinstance(parent, ast.FunctionDef)
                within = (where, parent.lineno) if inside and isinstance(parent, ast.FunctionDef) else owner
                for new in alternatives(node):
                    was, now = self._shown(parent, field, k, node, new)
                    self.mutants.append(Mutant(self.path, len(self.mutants), where, within, lines, was, now))
                    self._places.append((parent, field, k, new))
                self._visit(node, self._called(node, where, within), within, lines)

    @staticmethod
    def _called(node: ast.AST, where: str, owner: tuple[str, int] | None) -> str:
        """The name of what is inside: of a function, a class, or outside of functions of what is assigned."""
        target = getattr(node, "target", None) or next(iter(getattr(node, "targets", ())), None)
        name = getattr(node, "name", None) if isinstance(node, ast.FunctionDef | ast.ClassDef) else None
        if owner is None and isinstance(target, ast.Name):
            name = target.id
        return where if name is None else name if where == "module" else f"{where}.{name}"

    @staticmethod
    def _shown(parent: ast.AST, field: str, k: int | None, node: ast.AST, new: ast.AST) -> tuple[str, str]:
        """Before and after; a number together with the short expression it is in."""
        if not (isinstance(node, ast.Constant) and isinstance(parent, ast.expr | ast.keyword)):
            return words(node), words(new)
        held = getattr(parent, field)
        other = altered(parent, **{field: new if k is None else [*held[:k], new, *held[k + 1 :]]})
        pair = words(parent), words(other)
        return pair if max(map(len, pair)) < 60 else (words(node), words(new))

    def code(self, mutant: Mutant) -> types.CodeType:
        """The module compiled with one change."""
        parent, field, k, new = self._places[mutant.number]
        held = getattr(parent, field)
        setattr(parent, field, new if k is None else [*held[:k], new, *held[k + 1 :]])
        try:
            return compile(ast.fix_missing_locations(copy.deepcopy(self._tree)), self.file, "exec")
        finally:
            setattr(parent, field, held)


def listed() -> dict[tuple[str, str, str, str], str]:
    """The equivalent mutants of docs/mutation.md, each with its reason."""
    row = re.compile(r"^- `([^`]+)` `([^`]+)` `([^`]+)` → `([^`]+)`: (.+)$", re.MULTILINE)
    found = row.findall(LISTED.read_text()) if LISTED.exists() else []
    return {(path, where, was, now): reason for path, where, was, now, reason in found}


# ---------------------------------------------------------------------------------------------------------- forks


def forked(work: Callable[[int], int], limit_s: float, show: bool = False) -> tuple[int | None, bytes]:
    """Exit status of `work` in a fork, None beyond the limit, and what it wrote to the descriptor it is given."""
    reader, writer = os.pipe()
    if (pid := os.fork()) == 0:
        os.setpgid(0, 0)
        os.close(reader)
        if not show:
            nothing = os.open(os.devnull, os.O_RDWR)
            for fd in (0, 1, 2):
                os.dup2(nothing, fd)
        status = 70
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


def options(*more: str) -> list[str]:
    """Arguments of pytest: nothing kept between runs, no second process."""
    return ["-x", "-q", "-p", "no:cacheprovider", "-n", "0", "-W", "ignore::pytest.PytestAssertRewriteWarning", *more]


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

    def __init__(self, modules: list[Module], chosen: list[Mutant], tell: Tell) -> None:
        self._modules = {m.path: m for m in modules}
        self._chosen, self._tell = chosen, tell
        self._lines = Lines({m.file for m in modules})
        self._failed = False
        self.left: list[Mutant] = []  # to be imported
        self.seconds: dict[str, float] = {}
        self.tests: dict[tuple[str, int], set[str | None]] = {}
        self._lines.on()  # the import

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A failure ends a fork at once."""
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            os._exit(1)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """All mutants of functions."""
        self._lines.off()
        assert session.items, "no tests collected"
        self._items = {item.nodeid: item for item in session.items}
        status, answer = forked(self._baseline, 1800.0)
        if status:
            raise SystemExit("the tests fail without a mutant; run them by themselves first")
        self.seconds, self.tests = pickle.loads(answer)
        self._functions = self._index()
        gc.freeze()
        for mutant in self._chosen:
            self._one(mutant)
        return True

    def _run(self, names: list[str]) -> None:
        items = [self._items[name] for name in names]
        for item, following in zip(items, [*items[1:], None], strict=True):
            self._lines.test = item.nodeid
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)

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
            if isinstance(thing, types.FunctionType) and thing.__code__.co_filename in files:
                found[files[thing.__code__.co_filename], thing.__code__.co_qualname].append(thing)
        return found

    def covering(self, mutant: Mutant) -> set[str | None]:
        """The tests that run its statement; None among them if the import does."""
        file = self._modules[mutant.path].file
        first, last = mutant.lines
        return set().union(*(self.tests.get((file, line), set()) for line in range(first, last + 1)))

    def _one(self, mutant: Mutant) -> None:
        tests = self.covering(mutant)
        code = self._modules[mutant.path].code(mutant)
        found = [c for c in nested(code) if mutant.owner and c.co_qualname == mutant.owner[0]]
        if mutant.owner is None or None in tests or not found:
            self.left.append(mutant)
            return
        new = next(c for c in found if c.co_name != "<lambda>")
        old = [
            f
            for (path, name, _), fs in self._functions.items()
            for f in fs
            if (path, name) == (mutant.path, mutant.owner[0])
        ]
        order = sorted((t for t in tests if t), key=lambda t: self.seconds[t])
        limit = LIMIT_S + 10.0 * sum(self.seconds[t] for t in order)
        self._tell(mutant, outcome(forked(lambda _: self._try(old, new, order), limit)[0]) if order else "not run")

    def _try(self, functions: list[types.FunctionType], code: types.CodeType, tests: list[str]) -> int:
        for function in functions:
            try:
                function.__code__ = code
            except ValueError:  # a variable of an outer scope is no longer used: as if imported
                return 1
        self._run(tests)
        return 0


def nested(code: types.CodeType) -> Iterator[types.CodeType]:
    """All code objects inside one."""
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield constant
            yield from nested(constant)


def outcome(status: int | None) -> str:
    """What became of a mutant, by how its process ended."""
    return "time-out" if status is None else "survived" if status == 0 else "killed"


def imported(module: Module, mutant: Mutant, tests: list[str]) -> int:
    """Run tests with the mutated module imported in place of the real one; the exit status of pytest."""

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
    return int(pytest.main(options(*tests), plugins=[Deterministic()]))


# ------------------------------------------------------------------------------------------------------------ runs


def run_group(modules: list[Module], tests: list[str], chosen: list[Mutant], tell: Tell) -> None:
    """Try the chosen mutants of some modules with some tests; the results go to `tell`."""
    shown = os.dup(1)
    told: list[tuple[int, str]] = []

    def serve(out: int) -> int:
        def say(mutant: Mutant, result: str) -> None:
            told.append((chosen.index(mutant), result))

        server = Server(modules, chosen, say)
        status = pytest.main(options("--basetemp", f"{tempfile.gettempdir()}/mutants.{os.getpid()}", *tests), [server])
        if not told and not server.left and chosen:
            os.write(shown, f"pytest ended with {status}\n".encode())
            return 1
        third_party = [name for name in sys.modules if name.split(".")[0] not in (*ROOMS, "__main__")]
        left = []
        for mutant in server.left:
            near = {t for t in server.covering(mutant) if t}
            file = server._modules[mutant.path].file
            whole = {t for (f, _), names in server.tests.items() if f == file for t in names if t}
            order = sorted(near or whole, key=lambda t: server.seconds[t])
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
    base = ["--basetemp", f"{tempfile.gettempdir()}/mutants.{os.getpid()}"]
    for index, order, seconds in left:
        mutant = chosen[index]
        status, _ = forked(lambda _, m=mutant, o=order: imported(of[m.path], m, base + o), LIMIT_S + 10.0 * seconds)
        tell(mutant, outcome(status) if order else "not run")


def main(arguments: list[str]) -> int:
    """Run, print, store. Returns 1 if a score is below 90 %."""
    os.environ["OMP_NUM_THREADS"] = "1"
    os.chdir(ROOT)
    given = dict(a.partition("=")[::2] for a in arguments)
    if set(given) - {"module", "sample", "seed"}:
        raise SystemExit("usage: python -m tests.mutants [module=PREFIX,...] [sample=N] [seed=N]")
    wanted = tuple(given.get("module", "").split(","))
    groups = [([Module(p) for p in paths if p.startswith(wanted)], tests) for paths, tests in TABLE.values()]
    everything = [m for modules, _ in groups for module in modules for m in module.mutants]
    if "sample" in given:
        rng = random.Random(int(given.get("seed", "0")))
        everything = rng.sample(everything, min(int(given["sample"]), len(everything)))
    equivalent, results, began = listed(), [], time.monotonic()

    def tell(mutant: Mutant, result: str) -> None:
        if result in ("survived", "not run") and mutant.key in equivalent:
            result = "equivalent"
        results.append((mutant, result))
        if result in ("survived", "not run"):
            print(f"{result}: {mutant}", flush=True)

    for modules, tests in groups:
        chosen = [m for m in everything if m.path in {module.path for module in modules}]
        files = [str(ROOT / "tests" / t) for t in tests if (ROOT / "tests" / t.split("::")[0]).exists()]
        if chosen:
            run_group(modules, files, chosen, tell)
    return report(results, time.monotonic() - began)


def report(results: list[tuple[Mutant, str]], seconds: float) -> int:
    """The score of each module, printed and stored."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for mutant, result in results:
        counts[mutant.path][result] += 1
        counts["all"][result] += 1
    rows = {}
    print(f"\n{'module':42} mutants killed time-out survived not-run equivalent  score")
    for path in [*(p for p in counts if p != "all"), "all"]:
        c = counts[path]
        dead, n = c["killed"] + c["time-out"], sum(c.values()) - c["equivalent"]
        rows[path] = {"score": round(100.0 * dead / max(n, 1), 1), **c}
        print(
            f"{path:42} {sum(c.values()):7} {c['killed']:6} {c['time-out']:8} {c['survived']:8} {c['not run']:7} "
            f"{c['equivalent']:10} {rows[path]['score']:5.1f}%"
        )
    print(f"{len(results)} mutants in {seconds:.0f} s")
    survivors = [str(mutant) for mutant, result in results if result in ("survived", "not run")]
    stored = {"date": datetime.date.today().isoformat(), "seconds": round(seconds), "modules": rows}
    (ROOT / "runs").mkdir(exist_ok=True)
    (ROOT / "runs" / "mutants.json").write_text(json.dumps({**stored, "survivors": survivors}, indent=1) + "\n")
    return int(any(row["score"] < 90.0 for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
