"""What a run left, read by its documented names, against the truth of vials and motors."""

from __future__ import annotations

import csv
import json
import re
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from tests.vendor.bench import ROOT, Bench, Run

TIMED = re.compile(r"\d\d:\d\d:\d\d ")
ALARM = re.compile(r"^\d\d:\d\d:\d\d (WARNING|ERROR|CRITICAL) |^failed|^error", re.IGNORECASE)
ROUTINE = re.compile(  # said of every run
    r"(INFO|WARNING) (pass|note)  |policy|never weighed|interlock alarms|kept for the next dose|supervisor's law acts"
    r"|setpoint .* from minute|writes to|recordings|next, write all|ISE|schedule of|alarms ended|verified off"
    r"|stopped by the operator"
)
FALSE_KINDS = ("falls", "no_dilution", "cannot_hold")


class Record:
    """The run folder: journal rows, recordings, summary."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.journal: list[dict[str, Any]] = []
        path = folder / "journal.jsonl"
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                self.journal.append(json.loads(line))
            except ValueError:  # torn by a kill
                continue
        summary = folder / "summary.json"
        self.summary = json.loads(summary.read_text()) if summary.exists() else {}

    def rows(self, m: str) -> list[dict[str, str]]:
        path = self.folder / "recordings" / f"{m}.csv"
        if not path.exists():
            return []
        with path.open(newline="") as file:
            return [row for row in csv.DictReader(file) if row["feed_pump"] is not None]

    def of(self, kind: str, m: str) -> list[dict[str, Any]]:
        return [row for row in self.journal if row["kind"] == kind and row.get("reactor") == m]

    def booked(self, m: str) -> float:
        """mL by the recording."""
        return sum(float(row["volume_ml"] or 0.0) for row in self.rows(m))

    def least(self, m: str) -> float:
        """Return what was given at least: mL by the recording, less what the journal leaves open."""
        ends = {round(row["on_s"], 3): row for row in self.of("dose_end", m)}.values()
        doubt = sum(row["feed_ml"] + row["repeated_ml"] - row["feed_low_ml"] for row in ends)
        return self.booked(m) - doubt - sum(row["feed_ml"] - row["feed_low_ml"] for row in self.of("given", m))

    def lost_and_doubled(self, m: str) -> tuple[int, int]:
        """Samples of the journal that have no row in the recording; rows beyond one a sample."""
        samples = [row["sample"] for row in self.of("sample", m)]
        different = [now for before, now in pairwise([None, *samples]) if now != before]
        difference = len(different) - len(self.rows(m))
        return max(difference, 0), max(-difference, 0)

    def false_alarms(self, m: str) -> dict[str, int]:
        """Rows of the recording with a kind that these faults do not justify."""
        words = [row["interlock"] or "" for row in self.rows(m)]
        counts = {kind: sum(bool(re.search(rf"(^|\| ?){kind}\b", text)) for text in words) for kind in FALSE_KINDS}
        return {kind: n for kind, n in counts.items() if n}

    def motor(self, m: str, runs: list[Run]) -> dict[str, int]:
        """Runs of the feed motor, doses that were begun by this run, repetitions that it booked."""
        ends = {round(row["on_s"], 3): row for row in self.of("dose_end", m)}
        return {
            "runs": sum(run.pump == "Pump1" and run.seconds > 0.05 for run in runs),
            "doses": len({round(row["on_s"], 3) for row in self.of("feed_on", m)}),
            "repeats": sum(times(row.get("feed_times")) for row in ends.values()) + len(self.of("given", m)),
        }


def times(value: Any) -> int:
    return len(value) if isinstance(value, list) else int(value or 0)


def alarms(lines: list[tuple[float, str]], since: float) -> list[tuple[float, str]]:
    """What the screen said from `since` on that is no routine, device s and text."""
    return [(at, line) for at, line in lines if at >= since and ALARM.search(line) and not ROUTINE.search(line)]


def told(lines: list[tuple[float, str]], since: float, words: str = "") -> tuple[float, str] | None:
    """Seconds from the fault to the first line with `words` that is no routine, and it; '': to the first alarm."""
    said = [line for line in lines if line[0] >= since and TIMED.match(line[1]) and not ROUTINE.search(line[1])]
    found = [(at - since, line) for at, line in (said if words else alarms(lines, since)) if re.search(words, line)]
    return found[0] if found else None


@cache
def page() -> list[re.Pattern[str]]:
    """The lines that docs/three_am.md explains."""
    text = (ROOT / "docs" / "three_am.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith(("|", "-"))]
    spans = {span for line in lines for span in re.findall(r"`([^`]+)`", line)}
    worth = [span for span in spans if len(span.replace("…", "").strip("; .,:")) >= 8]
    return [re.compile(".+?".join(map(re.escape, span.strip("…").split("…")))) for span in worth]


def on_page(line: str) -> bool:
    return any(pattern.search(line) for pattern in page())


def ise(bench: Bench, m: str, setpoint: float, begin_s: float, end_s: float) -> float:
    """Integral of the squared error of the true OD, OD^2 min."""
    points = [(t, x) for t, x, _ in bench.history[m] if begin_s <= t <= end_s]
    return sum((x - setpoint) ** 2 * (u - t) / 60.0 for (t, x), (u, _) in pairwise(points))


def worst(bench: Bench, m: str, setpoint: float, begin_s: float, end_s: float) -> float:
    """Largest distance of the true OD."""
    return max((abs(x - setpoint) for t, x, _ in bench.history[m] if begin_s <= t <= end_s), default=0.0)
