"""What one reactor has to report: rows for the journal, notes for the next receipt, its present fault."""

import logging
from collections.abc import Callable
from typing import Any

from hardware.chibio.connection import Log
from hardware.reactor import Fault

__all__ = ["Logbook"]

screen = logging.getLogger(__name__)


class Logbook:
    """One reactor's journal, notes and fault.

    Args:
      name: position, the `reactor` of every row.
      log: takes a row; must never raise (see `ChiBioReactors`).
      intend: takes the row of an intent; may raise, and then nothing is dosed.
      elapsed: run time, s.
    Attributes: fault; news, whether its kind changed since someone last looked; notes for the next receipt.
    """

    def __init__(self, name: str, log: Log, intend: Log, elapsed: Callable[[], float]) -> None:
        self.name, self.elapsed = name, elapsed
        self.fault: Fault | None = None
        self.news = False
        self.notes: list[str] = []
        self._log, self._intend = log, intend

    def log(self, kind: str, **fields: Any) -> None:
        """Write a row."""
        self._log(kind, {"reactor": self.name, **fields})

    def intend(self, **fields: Any) -> None:
        """Write what is about to be dosed. Raises: what the journal raises."""
        self._intend("intent", {"reactor": self.name, **fields})

    def tell(self, note: str) -> None:
        """Write a note, and keep it for the next receipt."""
        self.notes.append(note)
        self.log("note", note=note)

    def say(self, note: str) -> None:
        """Write a note and show it at once: of a wait, which no receipt would tell of before it is over."""
        screen.info("%s: %s", self.name, note)
        self.log("note", note=note)

    def report(self, fault: Fault | None) -> None:
        """Set or clear the fault; a change of its kind is written."""
        before, self.fault = self.fault, fault
        if (before.kind if before else None) != (fault.kind if fault else None):
            self.news = True
            self.log("fault", fault=str(fault) if fault else None)
