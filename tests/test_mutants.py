"""The mutants themselves: which are made, which are not, and that those listed as equivalent still exist."""

import ast
import os
import time

import pytest

from tests.mutants.__main__ import TABLE, listed
from tests.mutants.operators import ROOT, Module, alternatives
from tests.mutants.server import forked


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("a < b", ["a <= b", "a >= b"]),
        ("a <= b < c", ["a < b < c", "a > b < c", "a <= b <= c", "a <= b >= c"]),
        ("a == b", ["a != b"]),
        ("a is not None", ["a is None"]),
        ("a + b", ["a - b"]),
        ("'a' + b", []),
        ("a and b", ["a or b"]),
        ("not a", ["a"]),
        ("-a", ["a"]),
        ("min(a, key=f)", ["max(a, key=f)", "min(a)"]),
        ("np.minimum(a, b)", ["np.maximum(a, b)"]),
        ("f(a, why='text')", []),
        ("3", ["4"]),
        ("0.5", ["1.0"]),
        ("0.0", ["1.0"]),
        ("1e-9", ["1.0"]),
        ("True", ["False"]),
        ("'text'", []),
    ],
)
def test_what_an_expression_may_become(code: str, expected: list[str]) -> None:
    assert [ast.unparse(new) for new in alternatives(ast.parse(code, mode="eval").body)] == expected


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("os.fsync(fd)", ["pass"]),
        ("self.a = b", ["pass"]),
        ("a = b", []),
        ("a[0] += b", ["pass", "a[0] -= b"]),
        ("raise ValueError(f'{a < 1}')", ["pass"]),
        ("continue", ["pass"]),
        ("return a", ["return None"]),
        ("return None", []),
        ("if a:\n    b()", ["if not a:\n    b()"]),
        ("if a < b:\n    b()", []),
    ],
)
def test_what_a_statement_may_become(code: str, expected: list[str]) -> None:
    assert [ast.unparse(new) for new in alternatives(ast.parse(code).body[0])] == expected


def test_each_mutant_is_one_change_that_compiles_and_texts_are_left_alone() -> None:
    module = Module("hardware/storage/atomic.py")
    plain = ast.unparse(ast.parse((ROOT / module.path).read_text())).splitlines()
    seen = {str(m) for m in module.mutants}
    assert len(seen) == len(module.mutants)
    assert any("`os.fsync(folder)` → `pass`" in text for text in seen)
    assert not any(".part" in m.was and m.now != "pass" for m in module.mutants)
    for mutant in module.mutants:
        module.code(mutant)
    assert ast.unparse(module.tree).splitlines() == plain


def test_the_equivalent_ones_exist() -> None:
    made = {m.key for paths, _ in TABLE.values() for path in paths for m in Module(path).mutants}
    assert set(listed()) - made == set()


def test_a_fork_tells_its_status_its_answer_and_that_it_took_too_long() -> None:
    assert forked(lambda out: os.write(out, b"abc"), 10.0) == (3, b"abc")
    assert forked(lambda out: time.sleep(60.0) or 0, 0.1) == (None, b"")
