"""docs/three_am.md and the code say the same: every word of alarm that the screen can show is on the page, no other.

The words are read from the source: a text is a constant or an f-string with `…` for what varies. Names, choices,
parameters and results of functions of the same module are followed, so a text may be put together on the way.
"""

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import product
from pathlib import Path

from hardware.safety.config import RESPONSES, WORDS, Responses, SafetyConfig

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "three_am.md"
GAP = "…"
KINDS = set(RESPONSES)
CODE = re.compile(r"`([^`]+)`")


@dataclass
class Module:
    """A source file. functions: by name; calls: of each function in this file, with the function they stand in."""

    tree: ast.Module
    functions: dict[str, ast.FunctionDef] = field(default_factory=dict)
    calls: dict[str, list[tuple[ast.Call, ast.FunctionDef]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for function in ast.walk(self.tree):
            if isinstance(function, ast.FunctionDef):
                self.functions[function.name] = function
                for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
                    self.calls.setdefault(name_of(call), []).append((call, function))


def name_of(call: ast.Call) -> str:
    """`tell` of `self.book.tell(...)`."""
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


@dataclass(frozen=True)
class Scope:
    """Where a text stands: its function, and what one caller gives for the parameters."""

    module: Module
    function: ast.FunctionDef | None
    given: tuple[tuple[str, ast.expr, "Scope"], ...] = ()
    depth: int = 0

    def assigned(self, name: str) -> Iterator[ast.expr]:
        """Every value that the function gives to a name."""
        for node in ast.walk(self.function) if self.function else ():
            if isinstance(node, ast.NamedExpr) and node.target.id == name:
                yield node.value
            if not isinstance(node, ast.Assign):
                continue
            for target in node.targets:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=True))
                yield from (value for to, value in pairs if isinstance(to, ast.Name) and to.id == name)


def texts(node: ast.expr | None, scope: Scope) -> set[str]:
    """What an expression may read, with `…` for what is only known when it is run."""
    match node:
        case ast.Constant(value=str(text)):
            return {text}
        case ast.JoinedStr(values=parts):
            return joined([texts(part, scope) for part in parts])
        case ast.FormattedValue(value=ast.Name() | ast.Call() as value):
            return texts(value, scope)
        case ast.IfExp(body=body, orelse=orelse):
            return texts(body, scope) | texts(orelse, scope)
        case ast.BoolOp(values=values):
            return set().union(*(texts(value, scope) for value in values))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return joined([texts(left, scope), texts(right, scope)])
        case ast.Lambda(body=body) | ast.ListComp(elt=body) | ast.Attribute(value=body, attr="__getitem__"):
            return texts(body, scope)
        case ast.List(elts=[only]):
            return texts(only, scope)
        case ast.Name(id=name):
            return of_name(name, scope)
        case ast.Call() if name_of(node) in scope.module.functions and scope.depth < 3:
            return returned(scope.module.functions[name_of(node)], scope.module, scope.depth + 1)
    return {GAP}


def joined(parts: list[set[str]]) -> set[str]:
    return {re.sub(f"{GAP}+", GAP, "".join(choice)) for choice in product(*parts)}


def of_name(name: str, scope: Scope) -> set[str]:
    for parameter, value, where in scope.given:
        if parameter == name:
            return texts(value, where)
    values = list(scope.assigned(name)) if scope.depth < 3 else []
    deeper = Scope(scope.module, scope.function, scope.given, scope.depth + 1)
    return set().union(*(texts(value, deeper) for value in values)) if values else {GAP}


def returned(function: ast.FunctionDef, module: Module, depth: int = 0) -> set[str]:
    """What a function may return; of a tuple the last value."""
    scope, found = Scope(module, function, depth=depth), set()
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and node.value is not None:
            found |= texts(node.value.elts[-1] if isinstance(node.value, ast.Tuple) else node.value, scope)
    return found or {GAP}


def scopes(function: ast.FunctionDef, module: Module) -> list[Scope]:
    """A function as each of its callers in this module calls it; alone, if there is none."""
    names = [a.arg for a in function.args.args if a.arg != "self"]
    found = []
    for call, caller in module.calls.get(function.name, []):
        if not any(isinstance(a, ast.Starred) for a in call.args):
            where = Scope(module, caller)
            given = [*zip(names, call.args, strict=False), *((k.arg, k.value) for k in call.keywords if k.arg)]
            found.append(Scope(module, function, tuple((name, value, where) for name, value in given)))
    return found or [Scope(module, function)]


def formatted(call: ast.Call, scope: Scope) -> set[str]:
    """What a call of a logger says: its format with the arguments in it."""
    found = set()
    for form in texts(call.args[0], scope):
        parts = re.split(r"%[\d.]*[sdfg]", form)
        values = [texts(a, scope) for a in call.args[1:]] + [{GAP}] * len(parts)
        pieces = [p for pair in zip([{part} for part in parts], values, strict=False) for p in pair][:-1]
        found |= joined(pieces)
    return found


def finding(call: ast.Call, scope: Scope) -> set[str]:
    """`kind: text` of a Finding or a _Reason; where the kind is a variable, of every kind that is a key here."""
    kinds = {k for k in texts(call.args[0], scope) if k in KINDS}
    if not kinds and scope.function:
        keys = [k for d in ast.walk(scope.module.tree) if isinstance(d, ast.Dict) for k in d.keys]
        kinds = {k.value for k in keys if isinstance(k, ast.Constant) and k.value in KINDS}
    return joined([kinds or {GAP}, {": "}, texts(call.args[2], scope)])


def fault(call: ast.Call, scope: Scope) -> set[str]:
    kind, detail, remedy = (texts(a, scope) for a in call.args)
    return joined([kind, {": "}, detail, {"; "}, remedy])


def first(call: ast.Call, scope: Scope) -> set[str]:
    return texts(call.args[0], scope)


Reader = Callable[[ast.Call, Scope], set[str]]
ERRORS: dict[str, Reader] = dict.fromkeys(
    ("DeviceStateError", "IdentityError", "LinkError", "ProtocolError", "RecordingError"), first
)
TELLS: dict[str, Reader] = {"tell": first, "say": first, "Fault": fault, **ERRORS}
LOGS: dict[str, Reader] = {"warning": formatted, "error": formatted, "exception": formatted}
SAID: dict[str, dict[str, Reader]] = {  # which call says something, in which files
    "hardware/safety/*.py": {"Finding": finding, "_Reason": finding},
    **{f"hardware/chibio/{name}.py": TELLS for name in (
        "connection", "diagnosis", "dose_sequence", "fluorescence", "onboard_regulation", "overflow_pump", "reactors",
        "station",
    )},
    "hardware/chibio/protocol.py": ERRORS,
    "hardware/pioreactor/*.py": {k: v for k, v in TELLS.items() if k != "say"},
    "hardware/link/*.py": ERRORS,
    "hardware/reactor.py": ERRORS,
    "hardware/storage/journal.py": ERRORS,
    "hardware/storage/recorder.py": ERRORS,
    "experiments/control/*.py": LOGS,
    "experiments/record/*.py": LOGS,
    "experiments/cli/stop.py": LOGS,
    "hardware/family.py": LOGS,
    "hardware/board/board_agent.py": LOGS,
}  # fmt: skip
RETURNED = {  # functions whose result is said elsewhere
    "hardware/chibio/ending.py": "_words",
    "hardware/chibio/reactors.py": "_not_off",
    "hardware/chibio/sampling.py": "_measure_lateness",
}
NAMED = {  # names whose values are said elsewhere
    "experiments/loop/share.py": ("said",),
    "experiments/loop/signals.py": ("said",),
    "experiments/record/record.py": ("repairs",),
    "experiments/record/recovery.py": ("repairs",),
    "experiments/control/run.py": ("outcome",),
    "experiments/record/summary.py": ("who", "said"),
    "hardware/chibio/fluorescence.py": ("trouble",),
    "hardware/chibio/overflow_pump.py": ("trouble",),
    "hardware/pioreactor/doses.py": ("foreign",),
    "hardware/pioreactor/pumps.py": ("trouble", "end", "why"),
    "hardware/pioreactor/station.py": ("refusal",),
    "hardware/safety/interlock.py": ("texts",),
    "hardware/storage/recorder.py": ("repaired",),
}


@cache
def module(path: Path) -> Module:
    return Module(ast.parse(path.read_text(encoding="utf-8")))


def said_in(path: Path, calls: dict[str, Reader]) -> set[str]:
    """What these calls in a file say; a note as each caller of the function that tells it has it."""
    found, source = set(), module(path)
    for name, read in calls.items():
        for call, function in source.calls.get(name, []):
            if call.args:
                where = scopes(function, source) if name == "tell" else [Scope(source, function)]
                found |= set().union(*(read(call, scope) for scope in where))
    return found


def named_in(path: Path, names: tuple[str, ...]) -> set[str]:
    """What is assigned or appended to these names in a file."""
    found, source = set(), module(path)
    for function in source.functions.values():
        scope = Scope(source, function)
        for node in ast.walk(function):
            match node:
                case ast.Assign(targets=[ast.Name(id=name) | ast.Attribute(attr=name)], value=value) if name in names:
                    found |= texts(value, scope)
                case ast.Return(value=ast.JoinedStr() as value) if "outcome" in names:
                    found |= texts(value, scope)
                case ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="append"), args=[value]):
                    found |= texts(value, scope) if name in names else set()
    return found


def words() -> set[str]:
    """Everything that the code can say when something is wrong."""
    found: set[str] = set()
    for pattern, calls in SAID.items():
        for path in ROOT.glob(pattern):
            found |= said_in(path, calls)
    for name, function in RETURNED.items():
        found |= returned(module(ROOT / name).functions[function], module(ROOT / name))
    for name, names in NAMED.items():
        found |= named_in(ROOT / name, names)
    plain = {re.sub(rf"^({GAP} )*{GAP}(: |(?=\w))", "", text).strip() for text in found}  # whose words they are
    empty = re.compile(r"  | ;|:$|^\W*$")  # a name that may be "" is not when this is said
    return {text for text in plain if not empty.search(text)}


def tables() -> Iterator[list[str]]:
    """The rows of every table on the page whose first column is what the screen says."""
    inside = False
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        if not cells:
            inside = False
        elif inside and not set(cells[0]) <= {"-"}:
            yield cells
        inside = inside or cells[:1] == ["the screen says"]


def on_page() -> set[str]:
    return {text for cells in tables() for text in CODE.findall(cells[0])}


def test_the_page_has_every_word_of_the_screen_and_no_other():
    said, written = words(), on_page()
    assert sorted(said - written) == [], "the code says what the page does not have"
    assert sorted(written - said) == [], "the page has what the code does not say"


def test_every_reason_of_the_interlock_is_on_the_page_with_its_response():
    told = {}
    for cells in tables():
        for text in CODE.findall(cells[0]):
            if (kind := text.partition(": ")[0]) in RESPONSES:
                told.setdefault(kind, set()).add(CODE.findall(cells[2])[0])
    assert told == {kind: {word} for kind, word in RESPONSES.items()}
    chosen = {f.name: SafetyConfig().response(f.name) for f in fields(Responses)}
    assert chosen == {kind: WORDS[RESPONSES[kind]] for kind in chosen}
