"""Reports of one reactor: rows for the journal, notes for the next receipt, and its current fault."""

import logging
from collections.abc import Callable, Mapping
from typing import Any

from conf.messages import Message
from hardware.messages import Fault

Log = Callable[[str, Mapping[str, Any]], None]
"""Takes a kind and its fields, for instance `Journal.append`."""

screen = logging.getLogger(__name__)


def no_log(kind: str, fields: Mapping[str, Any]) -> None: ...


class Logbook:
    """One reactor's journal, notes and fault.

    Args: log: takes a row; must never raise (see `hardware.stations`). write: takes a row that must be on the disk
      before its action begins, e.g. an intent; may raise. elapsed: returns the run time, s.
    Attributes: fault: current fault, or None. news: its kind changed after the last measurement. notes: for a receipt.
    """

    def __init__(self, name: str, log: Log, write: Log, elapsed: Callable[[], float]) -> None:
        self.name, self.elapsed = name, elapsed
        self.fault: Fault | None = None
        self.news = False
        self.notes: list[Message] = []
        self._log, self._write = log, write

    def log(self, kind: str, **fields: Any) -> None:
        self._log(kind, {"reactor": self.name, **fields})

    def write(self, kind: str, **fields: Any) -> None:
        """Write a row before its action. Raises: what the journal raises; then the action must not begin."""
        self._write(kind, {"reactor": self.name, **fields})

    def tell(self, note: Message) -> None:
        """Write a note, and keep it for the next receipt."""
        self.notes.append(note)
        self.log("note", note=str(note), **note.row)

    def say(self, note: Message) -> None:
        """Write a note and show it at once, for a wait: a receipt would come only after the wait."""
        screen.info("%s: %s", self.name, note)
        self.log("note", note=str(note), **note.row)

    def report(self, fault: Fault | None) -> None:
        """Set or clear the fault; write a row if its kind changes."""
        before, self.fault = self.fault, fault
        if (before.kind if before else None) != (fault.kind if fault else None):
            self.news = True
            self.log("fault", fault=str(fault) if fault else None, **(fault.row if fault else {}))
