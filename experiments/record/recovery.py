"""Rows of a recording, and recovery of a run: its written rows, its missing rows, the state of its loop.

The journal is written before all other files, so it has everything that the other files lack.
"""

import bisect
import csv
import json
import logging
import math
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.messages import Message
from experiments.loop.loop import ClosedLoop, Step
from experiments.record import messages
from hardware.actuator import FEED
from hardware.reactor import Receipt
from hardware.safety.config import Response
from hardware.safety.interlock import kinds_of
from hardware.storage.doses import dosed
from hardware.storage.journal import Journal
from hardware.storage.messages import RowDamaged

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Row = dict[str, float | int | str | bool | None]

REBUILD = messages.RecordingDamaged.remedy
COLUMNS = (
    "time_min", "elapsed_min", "phase", "od", "setpoint", "pump_rate_ml_s", "proposed_ml_s", "volume_ml",
    "temperature_degc", "interlock", "raw_counts", "blank_counts", "feed_pump", "believed",
)  # fmt: skip
KEPT = ("decision", "closed")  # kinds of journal rows whose doses are in a row of a recording


def row_of(step: Step, n: int) -> Row:
    """Build the CSV row of reactor n in a step."""
    further = {key: float(value[n]) for key, value in step.columns.items()}
    return {
        "time_min": round(float(step.minute[n]), 4),
        "elapsed_min": round(float(step.elapsed[n]), 4),
        "phase": int(step.phase[n]),
        "od": float(step.od[n]),
        "setpoint": float(step.setpoint[n]),
        "pump_rate_ml_s": float(step.rate[n]),
        "proposed_ml_s": float(step.proposed[n]),
        "volume_ml": float(step.volume_ml[n]),
        "temperature_degc": round(float(step.temperature[n]), 3),
        "interlock": step.reasons[n] or "",
        "raw_counts": math.nan if step.raw is None else float(step.raw[n]),
        "blank_counts": math.nan if step.blank is None else float(step.blank[n]),
        "feed_pump": 1 if step.pump is None else int(step.pump[n]),
        "believed": 1 if step.believed is None else int(step.believed[n]),
        **further,
    }


@dataclass
class Reason:
    """One kind of interlock alarm: number of rows with it, minutes of the first and of the last of these rows."""

    rows: int
    first_min: float
    last_min: float


class Rows:
    """All rows of one reactor's recording: numbers by column, and alarms of the interlock.

    Args: columns: names of the recording's columns: `COLUMNS`, perhaps followed by others.
    Attributes: names: of columns. columns: name -> numbers. alarms: number of rows with alarms. reasons: by kind.
    """

    def __init__(self, columns: Sequence[str] = COLUMNS) -> None:
        self.names = tuple(columns)
        self.columns = {key: array("d") for key in self.names if key != "interlock"}
        self.alarms = 0
        self.reasons: dict[str, Reason] = {}

    def __len__(self) -> int:
        return len(self.columns["time_min"])

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row. Raises: ValueError for a cell that is not a number, KeyError for a missing cell."""
        for key, column in self.columns.items():
            column.append(float(row[key]))
        self.alarms += bool(row["interlock"])
        for kind in kinds_of(str(row["interlock"])):
            minute = float(row["time_min"])
            reason = self.reasons.setdefault(kind, Reason(0, minute, minute))
            reason.rows, reason.last_min = reason.rows + 1, minute

    def last(self) -> dict[str, float]:
        """Return the numbers of the newest row, {} for an empty recording."""
        return {key: column[-1] for key, column in self.columns.items()} if len(self) else {}


def read_rows(path: Path, columns: Sequence[str] = COLUMNS) -> Rows:
    """Read the rows of a recording with these columns. Raises: RecordingError for a damaged row."""
    found, line = Rows(columns), 1
    try:
        with open(path, newline="", encoding="utf-8") as f:
            for raw in (rows := csv.DictReader(f)):
                line = rows.line_num
                if raw.keys() != set(columns) or None in raw.values() or not math.isfinite(float(raw["time_min"])):
                    raise ValueError("a row has no time, or not one cell for every column")
                found.append({key: value if key == "interlock" else value or "nan" for key, value in raw.items()})
    except OSError as error:
        raise messages.RecordingUnreadable(path=path, why=error.strerror) from None
    except (ValueError, csv.Error) as error:
        raise messages.RecordingDamaged(path=path, line=line, why=error) from None
    return found


def complete(
    journal: Sequence[Mapping[str, Any]], names: Sequence[str], rows: Sequence[Rows], write: Callable[[int, Row], None]
) -> list[Message]:
    """Write each reactor's rows that are in the journal but, after a kill, not in the recording.

    Args: journal: rows of the journal. rows: written rows of each reactor; `write` must add each new row to them.
    Returns: one message for each new row. Raises: RecordingError for a damaged row of the journal.
    """
    repairs = list[Message]()
    for n, name in enumerate(names):
        try:
            for row in _unwritten(journal, name, rows[n]):
                write(n, row)
                repairs.append(messages.RowCompleted(reactor=name, minute=row["time_min"]))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            what = f"a row of {name} is damaged ({type(error).__name__}: {error})"
            raise RowDamaged(path="journal.jsonl", what=what) from None
    return repairs


def volumes(journal: Sequence[Mapping[str, Any]], name: str) -> dict[int, float]:
    """Return the volume fed by each decision for a reactor: number of the decision's journal row -> mL, oldest first.

    A dose belongs to the decision before it. A repeated dose belongs to the decision after it, or to the last decision
    if the program ended (row `closed`) before another one. Raises: RecordingError.
    """
    decided, closed = ([r["n"] for r in journal if r.get("reactor") == name and r["kind"] == k] for k in KEPT)
    found = dict.fromkeys(decided, 0.0)
    for dose in dosed(journal):
        k = bisect.bisect(decided, dose.n)
        ended = bisect.bisect(closed, dose.n) < bisect.bisect(closed, decided[k] if k < len(decided) else math.inf)
        k -= not dose.again or ended
        if dose.reactor == name and 0 <= k < len(decided):
            found[decided[k]] += dose.feed_ml
    return found


def at_end(journal: Sequence[Mapping[str, Any]], name: str, rows: Rows) -> Row | None:
    """Return the corrected last row of reactor `name` if its dose was cut short or repeated later, else None.

    Args: journal: rows up to the present, the last one `closed`. rows: the written rows, with the planned dose.
    Raises: RecordingError.
    """
    decisions = [r for r in journal if r.get("reactor") == name and r["kind"] == "decision"]
    if not decisions or not len(rows) or rows.last()["time_min"] != decisions[-1]["row"]["time_min"]:
        return None
    earlier = np.nansum(rows.columns["volume_ml"][:-1])  # each row includes corrections of the row before it
    given = sum(volumes(journal, name).values()) - float(earlier)
    if abs(given - rows.last()["volume_ml"]) <= 1e-6:
        return None
    return {c: _kept(decisions[-1]["row"], c) for c in rows.names} | {"volume_ml": given}


def _kept(row: Mapping[str, Any], column: str) -> float | int | str | bool | None:
    """Return a cell of a decision's row, nan for an empty cell."""
    value: float | int | str | bool | None = row[column]
    return math.nan if value is None else value


def _unwritten(journal: Sequence[Mapping[str, Any]], name: str, rows: Rows) -> Iterator[Row]:
    last = rows.last().get("time_min", -math.inf)
    mine = [r for r in journal if r.get("reactor") == name and r["kind"] in ("sample", "decision")]
    volume = volumes(journal, name)
    for earlier, this, following in zip([{}, *mine], mine, [*mine[1:], {}], strict=False):
        if this["kind"] == "decision":
            row: Row = {c: _kept(this["row"], c) for c in rows.names}
            row["volume_ml"] = volume[this["n"]]
        elif not following and earlier.get("kind") != "sample":
            row = _undecided(this, rows)
        else:
            continue
        if float(row["time_min"] or 0.0) > last + 1e-3:
            yield row


def _undecided(sample: Mapping[str, Any], rows: Rows) -> Row:
    """Build the row of a sample, with no dose, if the program was killed after the sample and before a decision.

    Args: rows: earlier rows of the reactor.
    """
    time, before = round(float(sample["time_s"]) / 60.0, 4), rows.last()
    row: Row = dict.fromkeys(rows.columns, math.nan)
    if before:
        elapsed = round(before["elapsed_min"] + time - before["time_min"], 4)
        row |= {"phase": int(before["phase"]), "setpoint": before["setpoint"], "elapsed_min": elapsed}
    reading = {"od": sample["od"], "temperature_degc": sample["temperature"]}
    reading |= {"raw_counts": sample.get("raw"), "blank_counts": sample.get("blank")}
    if "fluorescence" in rows.columns:
        reading["fluorescence"] = sample.get("fluorescence")
    row |= {"time_min": time, **{k: math.nan if v is None else float(v) for k, v in reading.items()}}
    nothing = {"pump_rate_ml_s": 0.0, "proposed_ml_s": 0.0, "volume_ml": 0.0}
    return {**row, **nothing, "interlock": "the program ended before it decided"}


def load_state(path: Path) -> dict[str, Any]:
    """Load state.json. The state includes all rows of the journal before its `journal_row`.

    Raises: RecordingError if there is no state to resume from.
    """
    try:
        state = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise messages.NoState(path=path, why=error.strerror or str(error)) from None
    except (ValueError, RecursionError) as error:
        raise messages.NoState(path=path, why=f"not JSON: {error}") from None
    if not isinstance(state, dict):
        raise messages.NoState(path=path, why=f"the file has {str(state)[:40]}, expected keys and values")
    known = state.get("journal_row", "missing")
    if type(known) is not int or known < 0:
        raise messages.NoState(path=path, why=f"journal_row: {str(known)[:40]}, expected the number of a row")
    return state


def is_over(journal: Journal, path: Path) -> bool:
    """Return whether every reactor of a run is done or given up, and the pumps were verified off after that.

    Args: path: path of state.json. Raises: RecordingError.
    """
    state, ends = load_state(path), [row for row in journal.rows if row["kind"] in ("start", "stop")]
    done, stopped = (state.get(key) for key in ("done", "stopped"))
    if not (ends and ends[-1]["kind"] == "stop" and not ends[-1].get("not_verified")):
        return False
    return isinstance(done, list) and isinstance(stopped, list) and bool(np.logical_or(done, stopped).all())


def continue_loop(loop: ClosedLoop, journal: Journal, path: Path, rows: Sequence[Rows] = ()) -> None:
    """Restore the loop from its saved state, and book the doses and hand-overs that began after it was saved.

    The controller also gets these doses, and the volume that the driver has since then deferred to the next dose.

    Args: journal: journal of the run. path: path of state.json. rows: rows of the recordings.
    Raises: RecordingError for a state that is damaged or does not fit the run.
    """
    state = load_state(path)
    doses = [dose for dose in dosed(journal.rows) if dose.n >= state["journal_row"]]
    try:
        newer = [row for row in journal.rows if row["n"] >= state["journal_row"]]
        loop.restore(_caught_up(state, newer, list(loop.reactors.names)))
    except ValueError as error:
        raise messages.NoState(path=path, why=str(error)) from None
    loop.interlock.latch(Response.REGULATE, loop.reactors.handed_over)
    decided, written = (
        {r["reactor"]: r["n"] for r in journal.rows if r["kind"] in kinds} for kinds in (KEPT[:1], KEPT)
    )
    marked = [row for row in journal.rows if row["kind"] in ("level", "bottle") and row["n"] >= state["journal_row"]]
    for dose in [*doses, None]:
        while marked and (dose is None or marked[0]["n"] < dose.n):
            told = marked.pop(0)
            if told["reactor"] in loop.reactors.names:
                act = loop.set_level if told["kind"] == "level" else loop.refilled
                act(told["reactor"], float(told[f"{told['kind']}_ml"]))
        if dose is None:
            break
        mine = np.array([name == dose.reactor for name in loop.reactors.names])
        pump = np.where(mine, dose.pump or FEED.pump, FEED.pump)
        loop.book(Receipt(mine * dose.feed_ml, (), mine * dose.waste_ml), dose.at_s, pump)
        if dose.n > decided.get(dose.reactor, -1):  # the newest decision's position includes all earlier doses
            loop.supply.given(pump, mine * dose.feed_ml)
        if dose.again and dose.n > written.get(dose.reactor, -1):  # no row has this dose yet
            loop.repeated_ml += mine * dose.feed_ml
    before = [row for row in journal.rows if row["n"] < state["journal_row"]]
    kept_ml = _put_off(journal.rows, loop) - _put_off(before, loop)
    for signal in loop.signals:
        signal.dosed(np.zeros(kept_ml.size), kept_ml, np.full(kept_ml.size, FEED.pump))
    names = list(loop.reactors.names)
    shares = [row for row in journal.rows if row["kind"] == "share" and row["reactor"] in names]
    counted = [(names.index(s["reactor"]), float(s["share"]), float(s["sd"]), float(s["minute"])) for s in shares]
    loop.retell([r.columns for r in rows], counted)
    log.info(messages.Resumed(minute=loop.reactors.elapsed() / 60.0, doses=len(doses)))


def _caught_up(state: dict[str, Any], rows: Sequence[Mapping[str, Any]], names: list[str]) -> dict[str, Any]:
    """Return a state with every schedule advanced to the newest decision in these rows of the journal."""
    found = dict(state)
    for row in rows:
        if row["kind"] == "decision" and isinstance(row.get("position"), Mapping) and row.get("reactor") in names:
            n, position = names.index(row["reactor"]), row["position"]
            for key, new in (("began", position.get("began", "missing")), ("steps", position), ("supply", position)):
                if isinstance(known := found.get(key), list) and n < len(known):
                    found[key] = [*known[:n], new, *known[n + 1 :]]
    return found


def _put_off(rows: Sequence[Mapping[str, Any]], loop: ClosedLoop) -> Array:
    """Return the volume that the driver last deferred to the next dose in these journal rows, mL, (N,)."""
    last = {row["reactor"]: float(row["carry_ml"]) for row in rows if row["kind"] == "intent"}
    return np.array([last.get(name, 0.0) for name in loop.reactors.names])
