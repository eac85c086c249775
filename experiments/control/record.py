"""What a closed loop leaves behind: a journal, one CSV per reactor, the loop's state, TensorBoard events.

Order of writing, so that nothing is lost and nothing is done twice: the decision goes into the journal before the
dose; the dose's intent too (by the driver); after it the row goes into the CSV and the state into state.json. A run
that is killed in between is completed from the journal when it is resumed.
"""

from __future__ import annotations

import contextlib
import csv
import json
import math
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.cli import files
from experiments.control.loop import Step
from experiments.reporting.tensorboard import Events
from hardware.errors import RecordingError
from hardware.reactor import Receipt
from hardware.storage.journal import REMEDY, Journal
from hardware.storage.recorder import Recorder

__all__ = ["COLUMNS", "Record"]

Array = NDArray[np.float64]
Row = dict[str, float | int | str | bool | None]

COLUMNS = (
    "time_min", "elapsed_min", "phase", "od", "setpoint", "pump_rate_ml_s", "proposed_ml_s", "volume_ml",
    "temperature_degc", "interlock",
)  # fmt: skip
NUMBERS = COLUMNS[:-1]
REBUILD = "move it away and resume again: it is written anew from the last 20 MB of the journal"


def row_of(step: Step, n: int) -> Row:
    """The CSV row of reactor n in a step."""
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
    }


class Record:
    """Journal, recordings, state and events of one run.

    Args:
      folder: run folder; what an earlier life of the run left there is continued.
      names: of the reactors.
      fsync: each row on the disk before the call returns.
    Attributes: journal (the driver writes into it, too); interlock_rows, per reactor, rows in which the interlock had
      something to say; repairs, what was mended on opening, one line each.
    Raises: RecordingError.
    """

    def __init__(self, folder: Path, names: Sequence[str], fsync: bool) -> None:
        self.folder, self.names = folder, tuple(names)
        self._fsync = fsync
        (folder / "recordings").mkdir(exist_ok=True)
        self.journal = Journal(folder / "journal.jsonl", fsync=fsync)
        self.repairs = [f"journal: cut a torn last line of {self.journal.cut} bytes"] if self.journal.cut else []
        self._recorders = [Recorder(self._csv(name), COLUMNS, fsync, REBUILD) for name in names]
        self.repairs += [r.repaired for r in self._recorders if r.repaired]
        self._columns = [{key: array("d") for key in NUMBERS} for _ in names]
        self.interlock_rows = [0] * len(self.names)
        for n in range(len(self.names)):
            self._read(n)
        self._complete()
        first = max(self.lengths, default=0)
        self.events = Events(folder, first)
        self._points = first

    def _csv(self, name: str) -> Path:
        return self.folder / "recordings" / f"{name}.csv"

    @property
    def lengths(self) -> list[int]:
        """Rows of each recording."""
        return [len(columns["time_min"]) for columns in self._columns]

    def _keep(self, n: int, row: Mapping[str, Any]) -> None:
        for key, column in self._columns[n].items():
            column.append(float(row[key]))
        self.interlock_rows[n] += bool(row["interlock"])

    def _write(self, n: int, row: Row) -> None:
        self._recorders[n].write(row)
        self._keep(n, row)

    def _read(self, n: int) -> None:
        """Take over the rows an earlier life wrote. Raises: RecordingError for a row that was damaged."""
        path = self._csv(self.names[n])
        with open(path, newline="", encoding="utf-8") as f:
            rows = csv.DictReader(f)
            try:
                for raw in rows:
                    if raw.keys() != set(COLUMNS) or None in raw.values() or not math.isfinite(float(raw["time_min"])):
                        raise ValueError("a row without a time, or not with a cell for every column")
                    self._keep(n, {key: value if key == "interlock" else value or "nan" for key, value in raw.items()})
            except (ValueError, csv.Error) as error:
                raise RecordingError(
                    f"{path}: damaged near line {max(rows.line_num, 1)} ({error}); {REBUILD}"
                ) from None

    def _complete(self) -> None:
        """Append to the CSVs what is in the journal and a kill kept from being written."""
        for n, name in enumerate(self.names):
            try:
                self._complete_one(n, name)
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                what = f"a row of {name} is damaged ({type(error).__name__}: {error})"
                raise RecordingError(f"journal {self.journal.path}: {what}; {REMEDY}") from None

    def _complete_one(self, n: int, name: str) -> None:
        last = self._columns[n]["time_min"][-1] if self.lengths[n] else -math.inf
        kinds = ("sample", "decision", "intent")
        mine = [r for r in self.journal.rows if r.get("reactor") == name and r["kind"] in kinds]
        around = zip([{}, *mine], mine, [*mine[1:], {}], strict=False)
        for earlier, this, following in around:
            if this["kind"] == "decision":
                row: Row = {c: math.nan if this["row"][c] is None else this["row"][c] for c in COLUMNS}
                row["volume_ml"] = float(following["feed_ml"]) if following.get("kind") == "intent" else 0.0
            elif this["kind"] == "sample" and not following and earlier.get("kind") != "sample":
                row = self._undecided(this, n)
            else:
                continue
            if float(row["time_min"] or 0.0) <= last + 1e-3:
                continue
            self._write(n, row)
            self.repairs.append(f"{name}: the row of minute {row['time_min']} was completed from the journal")

    def _undecided(self, sample: Mapping[str, Any], n: int) -> Row:
        """The row of a sample that was read, and the program killed before it was decided on: no dose."""
        time = round(float(sample["time_s"]) / 60.0, 4)
        row: Row = dict.fromkeys(NUMBERS, math.nan)
        if self.lengths[n]:
            before = {key: column[-1] for key, column in self._columns[n].items()}
            elapsed = round(before["elapsed_min"] + time - before["time_min"], 4)
            row |= {"phase": int(before["phase"]), "setpoint": before["setpoint"], "elapsed_min": elapsed}
        reading = {"od": sample["od"], "temperature_degc": sample["temperature"]}
        row |= {"time_min": time, **{k: math.nan if v is None else float(v) for k, v in reading.items()}}
        nothing = {"pump_rate_ml_s": 0.0, "proposed_ml_s": 0.0, "volume_ml": 0.0}
        return {**row, **nothing, "interlock": "the program ended before it decided"}

    def decided(self, step: Step) -> None:
        """Journal every decision of a step before anything is dosed, with how the controller came to it."""
        for n in range(len(self.names)):
            if step.rows[n]:
                why = {key: float(value[n]) for key, value in step.explanation.items()}
                fields = {"reactor": self.names[n], "row": row_of(step, n), "why": why}
                self.journal.append("decision", fields)
            elif step.reasons[n] is not None:
                self.journal.append("trouble", {"reactor": self.names[n], "interlock": step.reasons[n]})

    def done(self, step: Step, state: Mapping[str, Any]) -> None:
        """Write a step's rows, the state after it, and its curves. Raises: RecordingError when the disk refuses."""
        for n in np.flatnonzero(step.rows):
            row = row_of(step, int(n))
            self._write(int(n), row)
            minute = self._points = max(self._points, round(float(step.minute[n])))
            curves = {"od": step.od, "setpoint": step.setpoint, "pump_rate_ml_s": step.rate}
            for tag, value in {**curves, "temperature_degc": step.temperature, **step.explanation}.items():
                if np.isfinite(value[n]):
                    self.events.scalar(f"{self.names[n]}/{tag}", float(value[n]), minute)
        try:
            if self._fsync:
                self.events.flush()
            self.save(state)
        except OSError as error:
            remedy = "free disk space, then resume the run"
            raise RecordingError(f"{self.folder}: {error.strerror or error}; {remedy}") from error

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace state.json; it says up to which row of the journal it knows everything."""
        content = {"journal_row": self.journal.next_row, **state}
        files.write_json(self.folder / "state.json", content, self._fsync, indent=None)

    def load_state(self) -> tuple[dict[str, Any], list[Receipt]]:
        """The saved state and the doses begun after it was written. Raises: RecordingError where there is none."""
        try:
            state = json.loads((self.folder / "state.json").read_text(encoding="utf-8"))
        except OSError as error:
            raise self.no_state(error.strerror or str(error)) from None
        except (ValueError, RecursionError) as error:
            raise self.no_state(f"not JSON: {error}") from None
        if not isinstance(state, dict):
            raise self.no_state(f"it holds {str(state)[:40]}, expected keys and values")
        known = state.get("journal_row", "missing")
        if type(known) is not int or known < 0:
            raise self.no_state(f"journal_row: {str(known)[:40]}, expected the number of a row")
        later = []
        for row in self.journal.rows:
            if row.get("kind") == "intent" and row["n"] >= known:
                volume = np.array([row["feed_ml"] if name == row["reactor"] else 0.0 for name in self.names])
                waste = np.array([row["waste_ml"] if name == row["reactor"] else 0.0 for name in self.names])
                later.append(Receipt(volume, (), waste))
        return state, later

    def no_state(self, why: str) -> RecordingError:
        """The error for a state that cannot be resumed from."""
        remedy = "journal and recordings are kept; start a new run, or put back the file as the run wrote it"
        return RecordingError(f"{self.folder / 'state.json'}: no state to resume from ({why}); {remedy}")

    def series(self, column: str) -> Array:
        """A column of all recordings, shape (N, K); shorter recordings end in nan."""
        values = np.full((len(self.names), max(self.lengths, default=0)), np.nan)
        for n, columns in enumerate(self._columns):
            values[n, : self.lengths[n]] = columns[column]
        return values

    def close(self) -> None:
        """Close all files. Idempotent."""
        for recorder in self._recorders:
            recorder.close()
        self.journal.close()
        with contextlib.suppress(OSError):  # on a full disk the last points of the curves are lost, no row is
            self.events.close()
