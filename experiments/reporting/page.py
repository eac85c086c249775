"""The HTML page of a run folder: tables, figures, configuration.

The page is one file: figures (SVG, else PNG) and style are embedded. Its template is report.html.j2.
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

import yaml  # type: ignore[import-untyped]
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from experiments.cli.files import given
from experiments.cli.start import version
from experiments.reporting import tables
from experiments.reporting.curves import ERROR_UNITS
from experiments.reporting.tables import Emphasis, Table, number, typeset
from experiments.reporting.verdict import verdict

HERE = Path(__file__).parent
PICTURES = {".svg": ("svg+xml", b"<svg"), ".png": ("png", b"\x89PNG")}  # suffix -> media type, bytes that it contains

LARGEST = 200_000  # characters of a configuration file; a longer one is not parsed
ALIAS = re.compile(r"(?:^|[\s\[,:-])[&*]\w", re.MULTILINE)
PLACE = re.compile(r"(?<![\w.:/~…])/(?:[^\s/:;,'\"]+/)+[^\s/:;,'\"\])]+")
UNITS = {
    "ise": "OD² min", "itae": "OD min²", "ise_mean": "OD²", "itae_mean": "OD min", "setpoint": "OD",
    "temperature": "°C", "steady_abs_error": "OD", "steady_abs_error_by_setpoint": "OD", "mean_abs_error": "OD",
    "steady_abs_error_last": "OD",
    "optimum_steady_abs_error": "OD", "optimum_mean_abs_error": "OD", "myopic_steady_abs_error": "OD",
    "od_abs_error_mean": "OD", "mu": "1/min", "regret_pct_last": "%",
    "optimum_cost": "squared error",
}  # fmt: skip
"""Key of summary.json -> its unit, for keys whose name does not end with one of `ENDINGS`."""
ENDINGS = {"_pct": "%", "_min": "min", "_ml": "mL", "_s": "s"}

templates = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined)
templates.filters["typeset"] = typeset
templates.tests["best"] = lambda cell: isinstance(cell, Emphasis)


@dataclass
class Page:
    """HTML page. sections: headings, each with its blocks. tables: all tables of the page.

    A block is the name of a macro of report.html.j2 and the arguments of that macro.
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
        """Append a table, folded under the heading `folded` if given."""
        self.tables.append(table)
        self.add("table", table=table, folded=folded)

    def figure(self, path: Path, title: str, caption: str = "") -> None:
        """Append a figure file, SVG or PNG.

        Files of unknown origin are safe: a browser runs no script inside an image and opens no address from it. Raises:
        ValueError for a file that is neither SVG nor PNG, OSError for an unreadable file.
        """
        media, mark = PICTURES.get(path.suffix, ("", b""))
        data = path.read_bytes() if media else b""
        if not media or mark not in data:
            raise ValueError(f"figure {path}: not an SVG or PNG; delete it or draw it again")
        self.add("figure", title=title, caption=caption, media=media, data=base64.b64encode(data).decode())

    def html(self) -> str:
        """Render the whole document."""
        return templates.get_template("report.html.j2").render(page=self)


def _other_versions() -> str:
    found = [f"Python {platform.python_version()}"]
    for name in ("numpy", "scipy", "torch", "matplotlib"):
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(found)


def provenance(page: Page, run: Path) -> None:
    """Add the overrides, seed and versions of a run, and its configuration, folded."""
    config = run / "config.yaml"
    text = config.read_text(encoding="utf-8") if config.is_file() else ""
    seed = re.search(r"^seed: (\d+)", text, re.MULTILINE)
    pairs = [("run folder", run.name), ("overrides", _near(" ".join(given(run))) or "none")]
    if seed:
        pairs.append(("seed", seed[1]))
    name, release = version().split(" ")
    pairs += [(name, release), ("with", _other_versions())]
    page.add("keys", pairs=pairs)
    if text:
        page.add("folded_text", heading="Configuration, every value", text=_near(text))


def flat(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of each leaf of nested mappings; a list is a leaf."""
    for key, item in value.items():
        if isinstance(item, Mapping):
            yield from flat(item, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", item


def _config(text: str) -> Mapping[str, Any]:
    """Read the configuration of a run; {} if it is invalid, too long or contains YAML aliases."""
    if len(text) > LARGEST or ALIAS.search(text):
        return {}
    try:
        loaded = yaml.safe_load(text)
    except yaml.YAMLError:
        return {}
    return loaded if isinstance(loaded, Mapping) else {}


def _near(text: str) -> str:

    def short(match: re.Match[str]) -> str:
        path = Path(match[0])
        return (
            str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else "…/" + "/".join(path.parts[-2:])
        )

    return PLACE.sub(short, text)


def _labelled(key: str, kind: str) -> str:
    """Label a key of summary.json with its unit. Args: kind: kind of the task, which determines the unit of errors."""
    *parents, name = key.split(".")
    unit = UNITS.get(parents[-1] if parents and name in ("value", "ci95") else name, "")
    if unit == "OD" and "error" in name:
        unit = ERROR_UNITS.get(kind, unit)
    for ending, own in ENDINGS.items():
        if name.endswith(ending):
            key, unit = key.removesuffix(ending), own
    return f"{key}, {unit}" if unit else key


def _show(value: Any) -> str:
    if isinstance(value, str):
        return _near(value)
    if isinstance(value, float):
        return number(value, 5)
    if value == []:
        return "none"
    if isinstance(value, list):
        return ", ".join(_show(v) for v in value) if len(value) <= 12 else f"{len(value)} values"
    return "–" if value is None else str(value)


def _read(run: Path) -> tuple[Any, Mapping[str, Any]]:
    path = run / "config.yaml"
    config = _config(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return json.loads((run / "summary.json").read_text(encoding="utf-8")), config


def _results(page: Page, run: Path, prefix: str) -> None:
    """Add every figure of a run folder, and summary.json as tables; `prefix` begins the tables' names.

    If the run has a verdict, the table of single values is folded.
    """
    summary, config = _read(run)
    leaves = dict(flat(summary if isinstance(summary, Mapping) else {"summary": summary}))
    lists = {k: v for k, v in leaves.items() if isinstance(v, list) and v and all(isinstance(e, Mapping) for e in v)}
    env = config.get("env")
    kind = str(env.get("kind", "")) if isinstance(env, Mapping) and "regret_pct" in leaves else ""
    _figures(page, run)
    shown = [(_labelled(k, kind), typeset(_show(v))) for k, v in leaves.items() if k not in lists and v != ""]
    told = isinstance(summary, Mapping) and verdict(summary, config) is not None
    page.add("keys", pairs=shown, folded="Every number" if told else "")
    for key, value in lists.items():
        entries = [dict(flat(entry)) for entry in value]
        columns = tuple(dict.fromkeys(c for entry in entries for c in entry))
        rows = tuple(tuple(_show(entry.get(c)) for c in columns) for entry in entries)
        heads = tuple(_labelled(column, kind) for column in columns)
        page.table(Table(prefix + re.sub(r"\W+", "_", key), key.replace("_", " "), heads, rows))


def _figures(page: Page, run: Path) -> None:
    for path in (p for folder in (run / "figures", run) for p in sorted(folder.glob("*.*"))):
        if path.suffix == ".svg" or (path.suffix == ".png" and not path.with_suffix(".svg").exists()):
            page.figure(path, path.stem.replace("_", " "))


def _command(run: Path) -> str:
    """Return the name of a run folder without its leading step number."""
    return re.sub(r"^\d+_", "", run.name).capitalize()


def of_runs(folder: Path, runs: Sequence[Path], after: Callable[[Page, Path, str], None] | None = None) -> Page:
    """Build the page of a run of any command, or of several runs: results and configuration.

    A page of several runs begins with a summary of their results.

    Args: runs: `folder` itself, or runs below it. after: function (page, run, label) that adds further blocks of a run.
    """
    name = folder.resolve()
    title = next((c for c in map(_command, (name, *name.parents)) if c[:1].isalpha()), "Run")
    page = Page(title, f"{name.parent.name}/{name.name}, {version()}")
    labels = {_command(run) if run != folder else "": run for run in runs}
    if len(labels) < len(runs):
        labels = {run.name: run for run in runs}
    read = [(summary, config) for summary, config in map(_read, runs) if isinstance(summary, Mapping)]
    told = [said for each in read if (said := verdict(*each)) is not None]
    if told and "" not in labels:
        page.section("Summary")
        page.add("verdicts", found=told)
    for label, run in labels.items():
        page.section(f"{label}: results" if label else "Results")
        if told and not label:
            page.add("verdicts", found=told)
        _results(page, run, f"{run.name}_" if label else "")
        if after is not None:
            after(page, run, label)
        page.section(f"{label}: command and configuration" if label else "Command and configuration")
        provenance(page, run)
    return page


def save(page: Page, folder: Path) -> Path:
    """Write report.html, and the page's tables as tables/*.csv and *.tex, into a folder; return the page's path."""
    tables.write(page.tables, folder / "tables")
    target = folder / "report.html"
    target.write_text(page.html(), encoding="utf-8")
    return target
