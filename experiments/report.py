"""A run folder as one self-contained HTML page, `python -m experiments.report run=RUN`: tables, figures, configuration.

The page links to nothing: figures stand in it as SVG (or as embedded PNG where there is no SVG), styles too. The same
tables are written as CSV and LaTeX into RUN/tables.
"""

from __future__ import annotations

import base64
import html
import json
import logging
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from conf.schema import setting
from experiments.cli import frame
from experiments.reporting import tables
from experiments.reporting.tables import Table, number, typeset

__all__ = ["Page", "ReportConfig", "inline_svg", "main", "write"]

log = logging.getLogger(__name__)

PACKAGE = "turbidostat-dqn"

STYLE = """
:root { --ink: #1d2733; --soft: #5b6876; --line: #dde3e9; --accent: #0b5c8a; --wash: #f5f7f9; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff; font: 16px/1.55 "Helvetica Neue", Helvetica, Arial, sans-serif; }
header { background: var(--accent); color: #fff; padding: 2.2rem 0 1.8rem; }
header p { margin: .3rem 0 0; opacity: .88; }
main, header > div { max-width: 76rem; margin: 0 auto; padding: 0 1.5rem; }
h1 { font-size: 1.9rem; margin: 0; font-weight: 600; }
h2 { font-size: 1.35rem; margin: 2.6rem 0 .8rem; padding-bottom: .3rem; border-bottom: 2px solid var(--line); }
h3 { font-size: 1.08rem; margin: 1.8rem 0 .4rem; }
p, li { max-width: 52rem; }
nav { margin: 1.2rem 0 0; } nav a { margin-right: 1.1rem; color: var(--accent); }
figure { margin: 1.2rem 0 1.8rem; }
figcaption { font-weight: 600; margin-bottom: .45rem; }
figure svg, figure img { max-width: 100%; height: auto; display: block; }
.scroll { overflow-x: auto; }
.note, .caption { color: var(--soft); font-size: .9rem; margin: .45rem 0 0; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .32rem .6rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
thead th { border-bottom: 2px solid var(--ink); vertical-align: bottom; white-space: normal; background: var(--wash); }
th:first-child { text-align: left; font-weight: 500; }
td.best { font-weight: 700; color: #08634a; background: #e7f5ef; }
table.keys td { text-align: left; white-space: normal; overflow-wrap: anywhere; }
details { margin: 1rem 0; border: 1px solid var(--line); border-radius: 4px; padding: .5rem .9rem; }
summary { cursor: pointer; font-weight: 600; }
pre { font-size: .8rem; line-height: 1.4; overflow-x: auto; background: var(--wash); padding: .8rem; }
dt { font-weight: 600; margin-top: .7rem; } dd { margin: 0 0 0 1.2rem; max-width: 50rem; }
.verdict { border-left: 4px solid var(--accent); background: var(--wash); padding: .7rem 1.1rem; margin: 1rem 0; }
"""


@dataclass(frozen=True)
class ReportConfig:
    """What to report on."""

    run: str = setting("latest", "a run folder, a folder of run folders, or `latest`: the newest run below runs/")


@dataclass
class Page:
    """A page under construction: sections of HTML, and the tables among them."""

    title: str
    subtitle: str
    sections: list[tuple[str, list[str]]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    _figures: int = 0

    def section(self, heading: str) -> None:
        """Begin a section."""
        self.sections.append((heading, []))

    def add(self, *parts: str) -> None:
        """Append HTML to the current section."""
        self.sections[-1][1].extend(parts)

    def text(self, text: str) -> None:
        """Append a paragraph of plain text."""
        self.add(f"<p>{typeset(text)}</p>")

    def table(self, table: Table, folded: str = "") -> None:
        """Append a table, behind a heading to click on if `folded` gives one."""
        self.tables.append(table)
        content = table.html()
        self.add(f"<details><summary>{html.escape(folded)}</summary>{content}</details>" if folded else content)

    def figure(self, path: Path, title: str, caption: str = "") -> None:
        """Append a figure file, SVG or PNG."""
        self._figures += 1
        if path.suffix == ".svg":
            picture = inline_svg(path.read_text(encoding="utf-8"), f"f{self._figures}-", title)
        else:
            code = base64.b64encode(path.read_bytes()).decode()
            picture = f'<img alt="{html.escape(title)}" src="data:image/png;base64,{code}">'
        below = f'<p class="caption">{html.escape(caption)}</p>' if caption else ""
        self.add(f"<figure><figcaption>{html.escape(title)}</figcaption>{picture}{below}</figure>")

    def html(self) -> str:
        """The whole document."""
        keys = [f"s{k}" for k in range(len(self.sections))]
        links = "".join(
            f'<a href="#{key}">{html.escape(name)}</a>' for key, (name, _) in zip(keys, self.sections, strict=True)
        )
        body = "\n".join(
            f'<section id="{key}"><h2>{html.escape(name)}</h2>\n' + "\n".join(parts) + "</section>"
            for key, (name, parts) in zip(keys, self.sections, strict=True)
        )
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            '<link rel="icon" href="data:,">'
            f"<title>{html.escape(self.title)}</title><style>{STYLE}</style></head>\n<body>"
            f"<header><div><h1>{html.escape(self.title)}</h1><p>{html.escape(self.subtitle)}</p></div></header>\n"
            f"<main><nav>{links}</nav>\n{body}\n</main></body></html>\n"
        )


def inline_svg(text: str, prefix: str, title: str) -> str:
    """An SVG file as an element of a page: no prolog, no metadata, no name spaces, ids that meet no other figure's."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text).replace("xlink:href", "href")
    text = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}\1)", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(title)}"', 1)


def _version() -> str:
    """Of this package; where it runs from its sources without being installed, what pyproject.toml says."""
    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        source = Path(__file__).parents[1] / "pyproject.toml"
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


def key_values(pairs: Sequence[tuple[str, str]]) -> str:
    """A two-column table of names and values."""
    rows = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in pairs)
    return f'<div class="scroll"><table class="keys"><tbody>{rows}</tbody></table></div>'


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
    page.add(key_values(pairs))
    if text:
        page.add(f"<details><summary>Configuration, every value</summary><pre>{html.escape(text)}</pre></details>")


def _flat(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of nested mappings with dotted names; lists count as leaves."""
    for key, item in value.items():
        if isinstance(item, Mapping):
            yield from _flat(item, f"{prefix}{key}.")
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


def generic(page: Page, run: Path, prefix: str = "") -> None:
    """summary.json as tables and every figure of a run folder."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    plain = [(k, _show(v)) for k, v in _flat(summary) if not (isinstance(v, list) and v and isinstance(v[0], Mapping))]
    page.add(key_values(plain))
    for key, value in _flat(summary):
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            entries = [dict(_flat(entry)) for entry in value]
            columns = tuple(dict.fromkeys(c for entry in entries for c in entry))
            rows = tuple(tuple(_show(entry.get(c)) for c in columns) for entry in entries)
            page.table(Table(prefix + key.replace(".", "_"), key.replace("_", " "), columns, rows))
    for path in figures_of(run):
        page.figure(path, path.stem.replace("_", " "))


def figures_of(run: Path) -> list[Path]:
    """Figures in a run folder and its figures/: the SVG of each, its PNG where there is no SVG."""
    found = [p for folder in (run / "figures", run) for p in sorted(folder.glob("*.*"))]
    return [p for p in found if p.suffix == ".svg" or (p.suffix == ".png" and not p.with_suffix(".svg").exists())]


def write(run: Path) -> Path:
    """Write RUN/report.html and RUN/tables/; returns the page's path.

    A benchmark gets a page of its own; any other run its summary and figures; a folder of runs (as `make run` leaves
    one) a section for each. Raises: frame.UserError where there is nothing to report on.
    """
    parts = [run] if (run / "summary.json").is_file() else sorted(p.parent for p in run.glob("*/summary.json"))
    if not parts:
        raise frame.UserError(f"run={run}: holds no summary.json; give the folder of a finished run")
    try:
        page = _compose(run, parts)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise frame.UserError(f"run={run}: its summary.json is damaged ({error}); run it again") from None
    tables.write(page.tables, run / "tables")
    target = run / "report.html"
    target.write_text(page.html(), encoding="utf-8")
    return target


def _compose(run: Path, parts: Sequence[Path]) -> Page:
    if parts == [run] and "beside_paper" in json.loads((run / "summary.json").read_text(encoding="utf-8")):
        from experiments.comparison import page as benchmark_page

        return benchmark_page.page(run)
    name = run.resolve()
    page = Page(f"{name.parent.name}, {name.name}", f"{PACKAGE} {_version()}")
    for part in parts:
        label = re.sub(r"^\d+_", "", part.name).capitalize() if part != run else ""
        page.section(f"{label}: results" if label else "Results")
        generic(page, part, f"{part.name}_" if label else "")
        page.section(f"{label}: what was run" if label else "What was run")
        provenance(page, part)
    return page


def find(name: str, root: Path = Path("runs")) -> Path:
    """A run folder from its path or `latest`. Raises: frame.UserError naming what to give."""
    if name != "latest":
        if not Path(name).is_dir():
            raise frame.UserError(f"run={name}: no such folder; give the folder of a finished run")
        return Path(name)
    found = sorted(root.glob("*/*/summary.json"), key=lambda p: p.stat().st_mtime)
    if not found:
        raise frame.UserError(f"run=latest: no finished run under {root}; give run=FOLDER")
    return found[-1].parent


def report(config: ReportConfig, folder: Path) -> None:
    """Write the report of a run; `folder` only takes the log."""
    log.info("report %s", write(find(config.run)))


main = frame.Command("report", ReportConfig(), report)


if __name__ == "__main__":
    main()
