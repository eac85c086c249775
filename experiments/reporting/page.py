"""A run folder as one self-contained HTML page: tables, figures, configuration.

The page links to nothing: figures stand in it as images (SVG, or PNG where there is no SVG), the style too. Its
markup is report.html.j2.
"""

import base64
import json
import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from experiments.reporting import tables
from experiments.reporting.tables import Best, Table, number, typeset

__all__ = ["Page", "flat", "of_runs", "provenance", "save"]

PACKAGE = "turbidostat-dqn"
HERE = Path(__file__).parent
PICTURES = {".svg": ("svg+xml", b"<svg"), ".png": ("png", b"\x89PNG")}  # suffix -> media type, what such a file holds

templates = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined)
templates.filters["typeset"] = typeset
templates.tests["best"] = lambda cell: isinstance(cell, Best)


@dataclass
class Page:
    """A page under construction: headings, each with its blocks, and the tables among them.

    A block is the name of a macro of report.html.j2 and its arguments.
    """

    title: str
    subtitle: str
    sections: list[tuple[str, list[tuple[str, dict[str, Any]]]]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)

    def section(self, heading: str) -> None:
        """Begin a section."""
        self.sections.append((heading, []))

    def add(self, kind: str, **content: Any) -> None:
        """Append a block to the current section."""
        self.sections[-1][1].append((kind, content))

    def text(self, text: str) -> None:
        """Append a paragraph."""
        self.add("paragraph", text=text)

    def table(self, table: Table, folded: str = "") -> None:
        """Append a table, behind a heading to click on if `folded` gives one."""
        self.tables.append(table)
        self.add("table", table=table, folded=folded)

    def figure(self, path: Path, title: str, caption: str = "") -> None:
        """Append a figure file, SVG or PNG.

        Whoever wrote it: a browser runs no script of an image and follows no address in it.
        Raises: ValueError for a file that is no picture, OSError for one that cannot be read.
        """
        media, mark = PICTURES.get(path.suffix, ("", b""))
        data = path.read_bytes() if media else b""
        if not media or mark not in data:
            raise ValueError(f"figure {path}: not an SVG or PNG; delete it or draw it again")
        self.add("figure", title=title, caption=caption, media=media, data=base64.b64encode(data).decode())

    def html(self) -> str:
        """The whole document."""
        return templates.get_template("report.html.j2").render(page=self)


def _version() -> str:
    """Of this package; where it runs from its sources without being installed, what pyproject.toml says."""
    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        source = HERE.parents[1] / "pyproject.toml"
        found = re.search(r'^version = "([^"]+)"', source.read_text(encoding="utf-8"), re.MULTILINE)
        return found[1] if found else "unknown"


def _other_versions() -> str:
    found = [f"Python {platform.python_version()}"]
    for name in ("numpy", "scipy", "torch", "matplotlib"):
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(found)


def provenance(page: Page, run: Path) -> None:
    """What was run: command, seed, versions, and the whole configuration to unfold."""
    overrides = run / ".hydra" / "overrides.yaml"
    given = (
        re.findall(r"^- \+*(.+)$", overrides.read_text(encoding="utf-8"), re.MULTILINE) if overrides.is_file() else []
    )
    config = run / "config.yaml"
    text = config.read_text(encoding="utf-8") if config.is_file() else ""
    seed = re.search(r"^seed: (\d+)", text, re.MULTILINE)
    pairs = [("run folder", run.name), ("overrides", " ".join(given) or "none")]
    if seed:
        pairs.append(("seed", seed[1]))
    pairs += [(PACKAGE, _version()), ("with", _other_versions())]
    page.add("keys", pairs=pairs)
    if text:
        page.add("folded_text", heading="Configuration, every value", text=text)


def flat(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of nested mappings with dotted names; lists count as leaves."""
    for key, item in value.items():
        if isinstance(item, Mapping):
            yield from flat(item, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", item


def _show(value: Any) -> str:
    if isinstance(value, float):
        return number(value, 5)
    if value == []:
        return "none"
    if isinstance(value, list):
        return ", ".join(_show(v) for v in value) if len(value) <= 12 else f"{len(value)} values"
    return "–" if value is None else str(value)


def _results(page: Page, run: Path, prefix: str) -> None:
    """summary.json as tables, whose names begin with `prefix`, and every figure of a run folder."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    leaves = dict(flat(summary if isinstance(summary, Mapping) else {"summary": summary}))
    lists = {k: v for k, v in leaves.items() if isinstance(v, list) and v and all(isinstance(e, Mapping) for e in v)}
    page.add("keys", pairs=[(k, _show(v)) for k, v in leaves.items() if k not in lists])
    for key, value in lists.items():
        entries = [dict(flat(entry)) for entry in value]
        columns = tuple(dict.fromkeys(c for entry in entries for c in entry))
        rows = tuple(tuple(_show(entry.get(c)) for c in columns) for entry in entries)
        page.table(Table(prefix + re.sub(r"\W+", "_", key), key.replace("_", " "), columns, rows))
    for path in (p for folder in (run / "figures", run) for p in sorted(folder.glob("*.*"))):
        if path.suffix == ".svg" or (path.suffix == ".png" and not path.with_suffix(".svg").exists()):
            page.figure(path, path.stem.replace("_", " "))


def of_runs(folder: Path, runs: Sequence[Path], after: Callable[[Page, Path, str], None] | None = None) -> Page:
    """The page of any command's run: what it found, and what was run. `runs` is the folder itself or runs below it.

    Args: after: adds to the page what only some runs have; it is given the run and its name on a page of several.
    """
    name = folder.resolve()
    page = Page(f"{name.parent.name}, {name.name}", f"{PACKAGE} {_version()}")
    for run in runs:
        label = re.sub(r"^\d+_", "", run.name).capitalize() if run != folder else ""
        page.section(f"{label}: results" if label else "Results")
        _results(page, run, f"{run.name}_" if label else "")
        if after is not None:
            after(page, run, label)
        page.section(f"{label}: what was run" if label else "What was run")
        provenance(page, run)
    return page


def save(page: Page, folder: Path) -> Path:
    """Write report.html and the page's tables (tables/, CSV and LaTeX) into a run folder; returns the page's path."""
    tables.write(page.tables, folder / "tables")
    target = folder / "report.html"
    target.write_text(page.html(), encoding="utf-8")
    return target
