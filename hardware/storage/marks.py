"""Marks of a run: what somebody did at the bench and when, beside the recordings of the run."""

import csv
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from hardware.errors import RecordingError
from hardware.storage.recorder import Recorder

__all__ = ["NAME", "Mark", "add_mark", "read_marks"]

NAME = "marks.csv"
COLUMNS = ("time_min", "reactor", "text", "written", "level_ml")


@dataclass(frozen=True)
class Mark:
    """What happened at minute `time_min` of a run to `reactor`; "" is all of them. level_ml: volume in its vial then,
    None if nobody read it."""

    time_min: float
    reactor: str
    text: str
    level_ml: float | None = None


def add_mark(folder: Path, mark: Mark) -> Path:
    """Append a mark to a run folder, on the disk when this returns; of the running program a level is taken over.

    Raises: RecordingError if the disk refuses or the file is another one.
    """
    written = datetime.now().astimezone().isoformat(timespec="seconds")
    with Recorder(folder / NAME, COLUMNS) as file:
        cells = (round(mark.time_min, 3), mark.reactor, mark.text, written, mark.level_ml)
        file.write(dict(zip(COLUMNS, cells, strict=True)))
    return folder / NAME


def read_marks(folder: Path) -> list[Mark]:
    """The marks of a run folder, as they were written; none where there is no file. Raises: RecordingError."""
    path = folder / NAME
    if not path.is_file():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [
                Mark(float(r["time_min"]), r["reactor"], r["text"], float(r["level_ml"]) if r.get("level_ml") else None)
                for r in csv.DictReader(file)
            ]
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise RecordingError(f"{path}: damaged ({type(error).__name__}: {error}); mend it or move it away") from None
