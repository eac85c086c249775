"""Tables: cells for a page, CSV and LaTeX."""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

LONG_MIN = 180.0  # min; times above this are given in hours


class Emphasis(str):
    """Text of a table cell that is highlighted."""

    __slots__ = ()


def number(value: float | None, digits: int = 3) -> str:
    """Format a number to `digits` significant digits; large numbers without exponent; None and nan as a dash."""
    if value is None or value != value:
        return "–"
    if value == 0.0:
        return "0"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in text else text.replace("e-0", "e-")


def plus_minus(mean: float | None, sd: float | None) -> str:
    """Format mean ± sd, the sd to two digits; only the mean if the sd is unknown or negligible."""
    if mean is None or sd is None or not sd > 1e-6 * abs(mean):
        return number(mean)
    return f"{number(mean)} ± {number(sd, 2)}"


def interquartile_mean(values: NDArray[np.float64]) -> float:
    """Return the mean of the middle half of the finite values (Agarwal 2021); nan if there are none."""
    finite = np.sort(values[np.isfinite(values)])
    cut = finite.size // 4
    return float(finite[cut : finite.size - cut].mean()) if finite.size else float("nan")


def clock(last: float) -> tuple[float, str]:
    """Return the time unit for an axis up to `last` min: (60, "h") above LONG_MIN, else (1, "min")."""
    return (60.0, "h") if last > LONG_MIN else (1.0, "min")


def span(first: float, last: float) -> str:
    """Format a time span given in minutes."""
    unit, sign = clock(last)
    return f"{'hour' if sign == 'h' else 'minute'} {round(first / unit, 1):g} to {round(last / unit, 1):g}"


def count(n: int, one: str) -> str:
    """Format a count with its noun, "1 dose" or "3 doses"; `one` is the singular."""
    return f"{n} {one}{'' if n == 1 else 's'}"


def markdown(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a table in Markdown, ending with a newline."""
    head, *body = ("| " + " | ".join(map(str, row)) + " |" for row in (columns, *rows))
    return "\n".join([head, "|" + "---|" * len(columns), *body]) + "\n"


def typeset(text: str) -> str:
    """Replace hyphens before numbers by minus signs, and +- by ±."""
    return re.sub(r"(?<![\w.])-(?=\d)", "−", text.replace("+-", "±"))


@dataclass(frozen=True)
class Table:
    """Table that can be written as CSV, LaTeX or HTML.

    name: name of its files. title, note: text above and below the table. columns: headings. rows: cells as plain text
    or `Emphasis`; the first cell names the row.

    Raises: ValueError if a row and the headings differ in length.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.name}: row of {len(row)} cells under {len(self.columns)} headings")

    def csv(self) -> str:
        """Format the table as comma-separated values; the first line has the headings."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return out.getvalue()

    def latex(self) -> str:
        """Format a LaTeX table in booktabs style; include it with \\input."""
        lines = [
            r"\begin{table}",
            rf"\caption{{{_tex(self.title)}}}\label{{tab:{self.name}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
            r"\toprule",
            " & ".join(_tex(c) for c in self.columns) + r" \\",
            r"\midrule",
            *(" & ".join(_tex(c) for c in row) + r" \\" for row in self.rows),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
        return "\n".join(lines) + "\n"


TEX = {"\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}",
       "±": r"$\pm$", "–": "--", "−": "$-$", "µ": r"$\mu$", "°": r"$^\circ$", "²": "$^2$", "⁻": "$^-$", "³": "$^3$",
       "~": r"\textasciitilde{}",
       "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$"}  # fmt: skip


def _tex(text: str) -> str:
    plain = "".join(TEX.get(character, character) for character in text)
    return rf"\textbf{{{plain}}}" if isinstance(text, Emphasis) else plain


def write(tables: Sequence[Table], folder: Path) -> None:
    """Write each table as NAME.csv and NAME.tex into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for table in tables:
        (folder / f"{table.name}.csv").write_text(table.csv(), encoding="utf-8")
        (folder / f"{table.name}.tex").write_text(table.latex(), encoding="utf-8")
