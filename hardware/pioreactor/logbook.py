"""One unit's notes: into the journal, and to whoever asks for them."""

from collections.abc import Callable, Mapping
from typing import Any

from hardware.errors import ReactorError

__all__ = ["Log", "Logbook", "no_log"]

Log = Callable[[str, Mapping[str, Any]], None]


def no_log(kind: str, fields: Mapping[str, Any]) -> None:
    """Forget it."""


class Logbook:
    """Writes for one unit, its name and the run time with every row.

    Attributes: notes, since they were last taken; env, what a job of the vendor's is started with; error, of a row that
    could not be written and that did not stand in the way of anything.
    """

    def __init__(self, unit: str, experiment: str, log: Log, elapsed: Callable[[], float]) -> None:
        self.unit, self.experiment, self.elapsed, self._log = unit, experiment, elapsed, log
        self.env = {"EXPERIMENT": experiment, "JOB_SOURCE": "turbidostat"}
        self.notes: list[str] = []
        self.error: Exception | None = None

    def write(self, kind: str, **fields: Any) -> None:
        """A row that must be on the disk before what it speaks of is done. Raises: what the log raises."""
        self._log(kind, {"reactor": self.unit, "time_s": round(self.elapsed(), 3), **fields})

    def note_down(self, kind: str, **fields: Any) -> None:
        """A row that tells of something that was done; an error is kept for whoever looks."""
        try:
            self.write(kind, **fields)
        except (OSError, ReactorError) as error:
            self.error = error

    def tell(self, note: str) -> None:
        """A line for the run's log, and into the journal."""
        self.notes.append(note)
        self.note_down("note", text=note)
