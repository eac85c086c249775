"""The fault matrix as tables: outcomes in Markdown and CSV, what is declared, and the sums that must be zero."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.reliability.faults import Fault
from experiments.reliability.outcome import Outcome

__all__ = ["declared", "table", "totals", "write_cases"]


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"


def _span(values: Sequence[float], form: str) -> str:
    """Smallest to largest, one number if they look the same."""
    low, high = _number(min(values), form), _number(max(values), form)
    return low if low == high else f"{low} – {high}"


def _times(minutes: Sequence[float], cases: int) -> str:
    """When a fault was detected, min, and in how many of its cases if not in all."""
    some = f" ({len(minutes)} of {cases})" if len(minutes) < cases else ""
    return _span(minutes, ".1f") + some if minutes else "–"


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: one row per fault over all moments; single cases are in cases.csv."""
    head = (
        "fault", "told after, min", "by", "response", "peak mL", "peak OD error", "rows missed", "rows lost",
        "doses doubled", "pumps off", "as declared",
    )  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in dict.fromkeys(o.label for o in outcomes):
        mine = [o for o in outcomes if o.label == name]
        cells = [
            name if mine[0].fault != "none" else f"{name} ({len(mine)} healthy runs)",
            _times([o.detected_s / 60.0 for o in mine if o.reason], len(mine)),
            ", ".join(dict.fromkeys(o.reason for o in mine if o.reason)) or "–",
            ", ".join(dict.fromkeys(o.response for o in mine if o.response)) or "–",
            _span([o.peak_ml for o in mine], ".1f"),
            _span([o.peak_error for o in mine], ".2f"),
            str(sum(o.rows_missed for o in mine)),
            str(sum(o.rows_lost + o.rows_doubled for o in mine)),
            str(sum(o.doses_doubled for o in mine)),
            f"{sum(o.pumps_off for o in mine)} of {len(mine)}",
            "yes"
            if all(o.ok for o in mine)
            else "**no**: " + ", ".join(dict.fromkeys(w for o in mine for w in o.wrong)),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def declared(faults: Sequence[Fault]) -> str:
    """Markdown: what is not detected, or overflows without a guard, and why."""
    lines = [
        "| fault | what happens | not detected because | without a guard it overflows because |",
        "|---|---|---|---|",
    ]
    for f in faults:
        if f.why_not or f.overflow:
            lines.append(f"| {f.name} | {f.what} | {f.why_not or '(detected)'} | {f.overflow or '–'} |")
    return "\n".join(lines) + "\n"


def totals(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """The sums by which the matrix passes or fails."""
    healthy = [o for o in outcomes if o.fault == "none"]
    bare = [o for o in outcomes if not o.guarded]
    return {
        "cases": len(outcomes),
        "faults": len({o.fault for o in outcomes} - {"none"}),
        "overflows": sum(o.overflowed for o in outcomes if o.guarded),
        "cases_without_guard": len(bare),
        "overflows_without_guard": sum(o.overflowed for o in bare),
        "rows_lost": sum(o.rows_lost for o in outcomes),
        "rows_doubled": sum(o.rows_doubled for o in outcomes),
        "doses_doubled": sum(o.doses_doubled for o in outcomes),
        "doses_repeated_by_the_device": sum(o.repeats for o in outcomes),
        "undetected": sum("not detected" in o.wrong for o in outcomes),
        "software_ended": sum(o.exits for o in outcomes),
        "neighbours_lost": sum(o.neighbours_lost for o in outcomes),
        "pumps_not_off": sum("pumps not off" in o.wrong for o in outcomes),
        "false_alarms": sum(o.early_alarms + o.neighbour_alarms for o in outcomes)
        + sum(sum(o.kinds.values()) for o in healthy),
        "healthy_runs": len(healthy),
        "healthy_peak_error": max((o.peak_error for o in healthy), default=math.nan),
        "not_as_declared": sum(not o.ok for o in outcomes),
    }


def write_cases(path: Path, outcomes: Sequence[Outcome]) -> None:
    """cases.csv: one row per case."""
    rows = [o.as_dict() for o in outcomes]
    with open(path, "w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, list(rows[0]))
        writer.writeheader()
        for row in rows:
            counts = {k: " ".join(f"{name} x{n}" for name, n in row[k].items()) for k in ("kinds", "notes")}
            writer.writerow({**row, **counts, "wrong": ", ".join(row["wrong"])})
