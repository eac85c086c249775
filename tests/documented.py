"""The commands that README and docs show, as a user would type them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PYTHON = r"(?:python3?|\.venv/bin/python) -m (?:experiments|hardware|tests\.(?:campaigns|studies))[\w.]*"
SHELL = rf"(?:^|[`\s])(?={PYTHON})|`|^    "  # the word turbidostat alone may be a reactor
PROGRAM = re.compile(rf"(?:{SHELL})({PYTHON}|turbidostat)(?![\w.])((?: [^`\n]*)?)", re.MULTILINE)
OPEN = re.compile(r"\.\.\.|NAME|COMMAND|KEY|GROUP|PRESET|\bFILE\b(?!\.)| \| ")  # a pattern, not a command


def commands(page: Path) -> Iterator[list[str]]:
    """Program and arguments of every command of a page, without the comment behind it; patterns are left out."""
    text = re.sub(r"\\\n\s*", "", page.read_text(encoding="utf-8"))
    for program, rest in PROGRAM.findall(text):
        line = re.split(r"\s#|\s{2,}| > | \| |; |\)\.?$", program + rest)[0].rstrip(" .,;:)")
        if OPEN.search(rest) or OPEN.search(line):
            continue
        try:
            words = shlex.split(line.replace("turbidostat ", "python -m experiments.", 1))
        except ValueError:  # an apostrophe of the sentence around it
            continue
        yield words[words.index("-m") + 1 :] if "-m" in words else words


def needs_hardware(words: list[str]) -> bool:
    """A command that talks to a device, or weighs what a device pumped."""
    device = {"backend=chibio", "backend=pioreactor"} & set(words)
    return bool(device) or words[0] in ("experiments.blank", "experiments.calibrate_pump")
