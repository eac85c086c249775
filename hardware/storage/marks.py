"""Marks of a run: what somebody did or measured at the bench, and when, in a file beside the recordings."""

import csv
import fcntl
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from hardware.storage.messages import MarksDamaged
from hardware.storage.recorder import Recorder

NAME = "marks.csv"
MEASURED = ("level_ml", "share", "sd", "bottle_ml")
COLUMNS = ("time_min", "reactor", "text", "written", *MEASURED)


@dataclass(frozen=True)
class Mark:
    """An action or a measurement at minute `time_min` of a run, of `reactor`; "": all reactors.

    level_ml: volume in the vial, mL. share, sd: share of the second species in a sample, and its standard deviation.
    bottle_ml: volume in the bottle after a refill, mL. None: not measured.
    """

    time_min: float
    reactor: str
    text: str
    level_ml: float | None = None
    share: float | None = None
    sd: float | None = None
    bottle_ml: float | None = None

    @property
    def measured(self) -> bool:
        return (self.level_ml, self.share, self.bottle_ml) != (None, None, None)


def add_mark(folder: Path, mark: Mark) -> Path:
    """Append a mark to a run folder; it is then on the disk, and the run reads it. Raises: RecordingError."""
    written = datetime.now().astimezone().isoformat(timespec="seconds")
    with _alone(folder), Recorder(folder / NAME, COLUMNS) as file:
        cells = (round(mark.time_min, 3), mark.reactor, mark.text, written, *(getattr(mark, key) for key in MEASURED))
        file.write(dict(zip(COLUMNS, cells, strict=True)))
    return folder / NAME


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield
    finally:
        os.close(held)


def read_marks(folder: Path) -> list[Mark]:
    """Read the marks of a run folder in the order written, none if there is no file. Raises: RecordingError."""
    path = folder / NAME
    if not path.is_file():
        return []
    try:
        text = path.read_text(encoding="utf-8")
        whole = io.StringIO(text[: text.rfind("\n") + 1], newline="")  # an incomplete last line is read later
        found = [
            Mark(float(r["time_min"]), r["reactor"], r["text"], *(float(r[c]) if r.get(c) else None for c in MEASURED))
            for r in csv.DictReader(whole)
        ]
        if wrong := [m for m in found if m.share is not None and not (m.sd is not None and m.sd > 0.0)]:
            raise ValueError(f"share {wrong[0].share:g} at minute {wrong[0].time_min:g} has no sd above 0")
        return found
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise MarksDamaged(path=path, why=f"{type(error).__name__}: {error}") from None
