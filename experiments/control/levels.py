"""Levels that somebody read off a vial: no ledger can know what was mended, spilled or filled by hand."""

import logging

from experiments.loop.loop import ClosedLoop
from experiments.record.record import Record
from hardware.errors import RecordingError
from hardware.storage.marks import NAME, read_marks

__all__ = ["Levels"]

log = logging.getLogger(__name__)


class Levels:
    """The levels that were marked in a run's folder, each taken over once, also over a resume."""

    def __init__(self, record: Record) -> None:
        self._record, self._size = record, -1
        self._taken = sum(row["kind"] == "level" for row in record.journal.rows)

    def take(self, loop: ClosedLoop) -> None:
        """Put the loop's ledger, and the device's own, to what was marked since the last call. Raises: RecordingError
        of the journal; a damaged file of marks is only said."""
        path = self._record.folder / NAME
        size = path.stat().st_size if path.is_file() else -1
        if size == self._size:
            return
        self._size = size
        try:
            marked = [mark for mark in read_marks(self._record.folder) if mark.level_ml is not None]
        except RecordingError as error:
            log.warning("%s", error)
            return
        for mark in marked[self._taken :]:
            assert mark.level_ml is not None
            self._taken += 1
            self._record.journal.append("level", {"reactor": mark.reactor, "level_ml": mark.level_ml})
            if mark.reactor in loop.reactors.names:
                before = loop.set_level(mark.reactor, mark.level_ml)
                log.info("%s: %.1f mL in the vial by its mark, %.1f by the ledger", mark.reactor, mark.level_ml, before)
