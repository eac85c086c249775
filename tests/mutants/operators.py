"""The mutants of a module: what is changed, and the module compiled with one change."""

from __future__ import annotations

import ast
import copy
import types
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

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
        if keyword.arg not in (None, "strict") and not is_text(keyword.value):
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
    """What no mutant is made of: texts, annotations, decorators, __all__, assertions, strict=, and what is raised."""
    if field in ("annotation", "returns", "decorator_list", "bases") or isinstance(parent, ast.Raise):
        return True
    if isinstance(node, ast.JoinedStr | ast.Assert | ast.Import | ast.ImportFrom):
        return True
    names = [t.id for t in getattr(node, "targets", ()) if isinstance(t, ast.Name)]
    alias = isinstance(parent, ast.Module) and isinstance(getattr(node, "value", None), ast.BinOp | ast.Subscript)
    if isinstance(parent, ast.keyword) and parent.arg == "strict":  # zip's guard against a mistake of the program
        return True
    return "__all__" in names or (alias and names == [n for n in names if n[0].isupper() and not n.isupper()])


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
        """By what equivalent.txt names it."""
        return (self.path, self.where, self.was, self.now)

    def __str__(self) -> str:
        return f"{self.path}:{self.lines[0]} `{self.where}` `{self.was}` → `{self.now}`"


def words(node: ast.AST) -> str:
    """A node as code in one line; of a compound statement its head."""
    return ast.unparse(node).split("\n")[0]


class Module:
    """The mutants of one file, and the code of each."""

    def __init__(self, path: str) -> None:
        self.path, self.file = path, str(ROOT / path)
        self.name = path.removesuffix(".py").replace("/", ".")
        self.tree = ast.parse((ROOT / path).read_text())
        self.mutants: list[Mutant] = []
        self._places: list[tuple[ast.AST, str, int | None, ast.AST]] = []
        self._visit(self.tree, "module", None, (1, 1))

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
            return compile(ast.fix_missing_locations(copy.deepcopy(self.tree)), self.file, "exec")
        finally:
            setattr(parent, field, held)
