"""docs/three_am.md and the code say the same: every word of alarm that the screen can show is on the page, no other.

The words are read from the source, piece by piece: what stands between two values of an f-string or of a log's format.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from hardware.safety.config import RESPONSES, WORDS, Responses, SafetyConfig

ROOT = Path(__file__).parents[1]
CODE = re.compile(r"`([^`]+)`")
VARIES = re.compile(r"…|%[\d.]*[sdfg]")
ERRORS = {"DeviceStateError", "IdentityError", "LinkError", "ProtocolError", "RecordingError"}
TELLS = {"tell", "say", "_mend", "Fault", "Finding", "_Reason"} | ERRORS
LOGS = {"warning", "error", "exception"}
SAID = {  # which calls say something, in which files
    "hardware/safety/*.py": TELLS, "hardware/chibio/*.py": TELLS, "hardware/pioreactor/*.py": TELLS,
    "hardware/link/*.py": ERRORS, "hardware/reactor.py": ERRORS, "hardware/storage/journal.py": ERRORS,
    "hardware/storage/recorder.py": ERRORS, "experiments/loop/s*.py": TELLS, "experiments/control/*.py": LOGS,
    "experiments/record/*.py": LOGS, "experiments/cli/stop.py": LOGS, "hardware/family.py": LOGS,
    "hardware/board/board_agent.py": LOGS,
}  # fmt: skip
NAMED = {  # what is assigned to these, appended or returned is said elsewhere
    "said", "repairs", "repaired", "outcome", "who", "how", "plug", "trouble", "foreign", "end", "why", "refusal",
    "texts", "_words", "_not_off", "_measure_lateness", "_finish",
}  # fmt: skip
TOLD = {"what", "remedy", "note", "text"}  # of what is told while a run goes on
BEFORE = {"preflight.py", "config.py", "family.py", "procedures.py"}  # are read before a run
ELSEWHERE = {  # at the start of a run or of a procedure, where somebody reads it
    "an experiment is running; stop it before pumps are weighed", "it runs all the same: force_policy=true",
    "a simulated run takes a second; run it again", "its reactors cannot; start anew", "which decides the temperature",
    "what a vial has room for above its tube, and safety.ml_per_minute", "the serial line", "by its mark",
    "has no tube; weigh it and give backend.supply", "if it is not there any more: mosquitto_pub -r -n -t",
}  # fmt: skip


def pieces(text: str) -> set[str]:
    """Return what stands between the values of a text, where that is more than a word."""
    return {piece.strip(" .,;:()") for piece in VARIES.split(text) if re.search(r"\w[\w'-]* \w", piece)}


def prose(node: ast.AST) -> set[str]:
    """Return the pieces of text in an expression; what is shown of a value is none of them."""
    shown = isinstance(node, ast.FormattedValue) or (isinstance(node, ast.Call) and isinstance(node.func, ast.Name))
    parts = () if shown else ast.iter_child_nodes(node)
    own = pieces(node.value) if isinstance(node, ast.Constant) and isinstance(node.value, str) else set()
    return own.union(*map(prose, parts))


def told(tree: ast.AST, calls: set[str]) -> Iterator[ast.AST]:
    """Yield the expressions of a file that are said."""
    named = NAMED | TOLD if calls is TELLS else NAMED
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Attribute(attr=name) | ast.Name(id=name), args=values) if name in calls:
                yield from values
            case ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="append"), args=[value]) if name in named:
                yield value
            case ast.Assign(targets=[ast.Name(id=name) | ast.Attribute(attr=name)], value=value) if name in named:
                yield value
            case ast.FunctionDef(name=name) if name in named:
                yield from (inner for inner in ast.walk(node) if isinstance(inner, ast.Return))


def tables() -> Iterator[list[str]]:
    """The rows of every table on the page whose first column is what the screen says."""
    inside = False
    for line in (ROOT / "docs" / "three_am.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        if not cells:
            inside = False
        elif inside and not set(cells[0]) <= {"-"}:
            yield cells
        inside = inside or cells[:1] == ["the screen says"]


def stands_in(code: str, words: list[str]) -> bool:
    """Return whether half of these words stand side by side in the code, which may put a text together."""
    half = max(len(words) // 2, 1)
    return any(" ".join(words[k : k + half]) in code for k in range(len(words) - half + 1))


def test_the_page_has_every_word_of_the_screen_and_no_other():
    page = {text for cells in tables() for text in CODE.findall(cells[0])}
    said: set[str] = set()
    for pattern, calls in SAID.items():
        for path in (path for path in ROOT.glob(pattern) if calls is not TELLS or path.name not in BEFORE):
            said = said.union(*map(prose, told(ast.parse(path.read_text(encoding="utf-8")), calls)))
    missing = {piece for piece in said if not any(piece in text for text in page)}
    assert sorted(missing - ELSEWHERE) == [], "the code says what the page does not have"
    paths = [path for room in ("hardware", "experiments") for path in (ROOT / room).rglob("*.py")]
    code = "\n".join(path.read_text(encoding="utf-8") for path in paths)
    written = {part.strip() for text in page for piece in pieces(text) for part in re.split(r"[;:,.]", piece)}
    stale = {part for part in written if not stands_in(code, part.split())}
    assert sorted(stale) == [], "the page has what the code does not say"


def test_every_reason_of_the_interlock_is_on_the_page_with_its_response():
    found: dict[str, set[str]] = {}
    for cells in tables():
        for text in CODE.findall(cells[0]):
            if (kind := text.partition(": ")[0]) in RESPONSES:
                found.setdefault(kind, set()).add(CODE.findall(cells[2])[0])
    assert found == {kind: {word} for kind, word in RESPONSES.items()}
    chosen = {f.name: SafetyConfig().response(f.name) for f in fields(Responses)}
    assert chosen == {kind: WORDS[RESPONSES[kind]] for kind in chosen}
