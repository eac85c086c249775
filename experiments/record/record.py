"""Output files of a closed loop: a journal, one CSV per reactor, the loop's state, TensorBoard events.

The order of writing prevents lost rows and repeated doses. Before a dose, the journal gets the decision, and the
driver's intent to dose. After the dose, the CSV gets the row, and state.json gets the state. If the run is killed in
between, the next start completes the row from the journal.
"""

import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conf.messages import Message
from experiments.cli import files
from experiments.loop.loop import Step
from experiments.record import messages
from experiments.record.curves import Curves
from experiments.record.recovery import COLUMNS, REBUILD, Array, Row, Rows, at_end, complete, read_rows, row_of
from hardware.errors import RecordingError
from hardware.storage.journal import Journal
from hardware.storage.marks import Mark, read_marks
from hardware.storage.messages import NotWritten
from hardware.storage.recorder import Recorder

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings of all N reactors of a run.

    names: names of the reactors. columns: column name -> values, (N, K); a shorter recording ends in nan. rows: rows
    and alarms of each reactor. repairs: messages of repairs. marks: events marked at the bench, in order of time.
    """

    names: tuple[str, ...]
    columns: Mapping[str, Array]
    rows: Sequence[Rows]
    repairs: Sequence[Message]
    marks: Sequence[Mark]

    def od(self, refused: bool = False) -> Array:
        """Return the OD, (N, K), of readings that the interlock accepted, or (`refused`) rejected; nan elsewhere."""
        return np.where((self.columns["believed"] == 0.0) == refused, self.columns["od"], np.nan)

    def setpoints(self) -> Array:
        """Return the setpoint of the OD, (N, K), nan during a recovery, which has no setpoint."""
        return np.where(self.columns["phase"] >= 0, self.columns["setpoint"], np.nan)


class Record:
    """Journal, recordings, state and events of one run.

    Args:
      folder: run folder; an existing run in it is continued. names: names of the reactors.
      fsync: whether a call returns only after its row and curves are on the disk. columns: of the recordings.
    Attributes: journal: written by the driver, too. state_path: path of state.json. columns: of the recordings.
      rows: rows of each reactor. repairs: messages of the repairs on opening.
    Raises: RecordingError.
    """

    def __init__(self, folder: Path, names: Sequence[str], fsync: bool, columns: Sequence[str] = COLUMNS) -> None:
        self.folder, self.names = folder, tuple(names)
        self.state_path = folder / "state.json"
        self._fsync = fsync
        (folder / "recordings").mkdir(exist_ok=True)
        self.journal = Journal(folder / "journal.jsonl", fsync=fsync)
        try:
            self._continue(columns)
        except BaseException:
            self.journal.close()
            raise

    def _continue(self, columns: Sequence[str]) -> None:
        self.repairs: list[Message] = [messages.TornJournal(length=self.journal.cut)] if self.journal.cut else []
        paths = [self.folder / "recordings" / f"{name}.csv" for name in self.names]
        self._recorders = [Recorder(path, columns, self._fsync, REBUILD) for path in paths]
        self.repairs += [r.repaired for r in self._recorders if r.repaired]
        self._paths, self.columns, self._gone = paths, tuple(columns), set[Path]()
        self.rows = [read_rows(path, columns) for path in paths]
        self.repairs += complete(self.journal.rows, self.names, self.rows, self._write)
        began = float(self.journal.rows[0]["wall"]) if self.journal.rows else None
        newest = max((float(rows.columns["time_min"][-1]) for rows in self.rows if len(rows)), default=-1.0)
        self.curves = Curves(self.folder, self.names, columns, round(newest) + 1, began)

    def complete(self) -> None:
        """Complete the recordings from the journal after the end of the loop: missing rows, corrected dose volumes.

        The rows are read from the disk again, because a signal may have come after a row was written and before it was
        kept in memory. Raises: RecordingError.
        """
        self.rows, journal = [read_rows(path, self.columns) for path in self._paths], self.journal.reread()
        complete(journal, self.names, self.rows, self._write)
        for n, name in enumerate(self.names):
            closed = {"n": self.journal.next_row, "kind": "closed", "reactor": name}
            if any(row["kind"] == "intent" for row in journal) and (
                row := at_end([*journal, closed], name, self.rows[n])
            ):
                self.journal.append("closed", {"reactor": name})
                self._recorders[n].amend(row)
                self.rows[n] = read_rows(self._paths[n], self.columns)

    def _write(self, n: int, row: Row) -> None:
        self._recorders[n].write(row)
        self.rows[n].append(row)

    def decided(self, step: Step) -> None:
        """Write every decision of a step into the journal before any dose, with the controller's explanation."""
        for n in range(len(self.names)):
            if step.rows[n]:
                why = {key: value[n] for key, value in step.explanation.items()}  # a number, or an MPC's plan
                fields = {"reactor": self.names[n], "row": row_of(step, n), "why": why, "position": step.position[n]}
                self.journal.append("decision", fields)
            elif step.reasons[n] is not None:
                self.journal.append("trouble", {"reactor": self.names[n], "interlock": step.reasons[n]})

    def done(self, step: Step, state: Mapping[str, Any]) -> None:
        """Write a step's rows, the state after the step, and its curves. Raises: RecordingError if the disk fails."""
        for n in map(int, np.flatnonzero(step.rows)):
            self._write(n, row_of(step, n))
            if (path := self._paths[n]) not in self._gone and self._recorders[n].gone:
                self._gone.add(path)
                log.warning(messages.RecordingGone(path=path))
        try:
            self.curves.step(step)
            if self._fsync:
                self.curves.flush()
            self.save(state)
        except OSError as error:
            raise NotWritten(path=self.folder, why=error.strerror or error) from error

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace state.json. The new state includes all rows of the journal before `journal_row`."""
        content = {"journal_row": self.journal.next_row, **state}
        files.write_json(self.state_path, content, self._fsync, indent=None)

    def series(self, column: str) -> Array:
        """Return a column of all recordings, shape (N, K); shorter recordings end in nan."""
        values = np.full((len(self.names), max(map(len, self.rows), default=0)), np.nan)
        for own, rows in zip(values, self.rows, strict=True):
            own[: len(rows)] = rows.columns[column]
        return values

    def table(self) -> Recordings:
        """Return all recordings; if the file of marks is damaged, warn and omit the marks."""
        try:
            marks = sorted(read_marks(self.folder), key=lambda mark: mark.time_min)
        except RecordingError as error:
            log.warning("%s", error)
            marks = []
        columns = {key: self.series(key) for key in self.columns if key != "interlock"}
        return Recordings(self.names, columns, self.rows, self.repairs, marks)

    def close(self) -> None:
        """Close all files. Idempotent."""
        for recorder in self._recorders:
            recorder.close()
        self.journal.close()
        with contextlib.suppress(OSError):  # a full disk loses the last points of the curves, but no row
            self.curves.close()
