"""How the pages are built: `make docs`, or `python -m sphinx -W docs build/docs`. Warnings are errors."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

ROOT = Path(__file__).parents[1]
PACKAGES = ("conf", "dqn", "envs", "hardware", "experiments")

project = "turbidostat-dqn"
copyright = "the authors, MIT licence"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.apidoc", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
html_math_renderer = "mathml"  # set here, so that a page loads nothing from the network
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme = "furo"
html_title = "turbidostat-dqn"
highlight_language = "none"
exclude_patterns = ["figures"]
apidoc_modules = [{"path": f"../{name}", "destination": f"api/{name}", "separate_modules": False} for name in PACKAGES]
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_use_type_comments = False  # there are none; looking for them takes half the time

FIELD = re.compile(r"^[a-z_]\w*(, [a-z_]\w*)*( \(.*\))?: ")  # of a dataclass
LABEL = re.compile(r"^(Args|Attributes|Raises|Returns|State|Yields)\b([^:]*):\s*(.*)$")


def _plain(text: str) -> str:
    """Turn a line of a docstring into reStructuredText: only `code` is markup."""
    parts = text.split("`")
    escaped = [re.sub(r"([\\*|_])", r"\\\1", part) if k % 2 == 0 else part for k, part in enumerate(parts)]
    return "``".join(escaped) if len(parts) % 2 else re.sub(r"([\\*|_`])", r"\\\1", text)


def _blocks(lines: list[str]) -> Iterator[list[str]]:
    block: list[str] = []
    for line in [*lines, ""]:
        if line.strip():
            block.append(line)
        elif block:
            yield block
            block = []


def _rendered(block: list[str]) -> Iterator[str]:
    """One paragraph: equations and tables as they stand, labelled parts and fields as lists, all else as text."""
    if block[0][0] in " |-+":
        yield from ("::", "", *(f"    {line}" for line in block))
        return
    labelled = listed = False
    for line in block:
        if found := LABEL.match(line):
            labelled, listed = True, False
            yield from ("", f"**{found[1]}{_plain(found[2])}:** {_plain(found[3])}".rstrip(), "")
        elif FIELD.match(line) or (labelled and re.match(r"^ {1,3}\S", line)):
            listed = True
            yield from ("", f"- {_plain(line.strip())}")
        elif line.startswith(" ") and listed:
            yield f"  {_plain(line.strip())}"
        elif line.startswith(" "):
            yield _plain(line.strip())
        else:
            yield from ("", _plain(line)) if listed else (_plain(line),)
            labelled = listed = False


def _docstring(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Render docstrings, which are written for a terminal, on a page without changing a word."""
    lines[:] = [line for block in _blocks(lines) for line in (*_rendered(block), "")]


def _formula(page: Any, node: Any, display: str) -> None:
    """LaTeX as MathML, which browsers set by themselves."""
    formula = convert(node.astext().replace(r"\arg", r"\operatorname{arg}"), display=display)
    page.body.append(f'<div class="math">{formula}</div>' if display == "block" else formula)
    raise SkipNode


def setup(app: Any) -> None:
    """Set Sphinx up."""
    inline, block = (lambda page, node, d=display: _formula(page, node, d) for display in ("inline", "block"))
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("autodoc-process-docstring", _docstring)
