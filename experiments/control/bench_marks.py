"""What somebody measured at the bench: levels read off a vial, shares counted in a sample. No device can know them."""

import logging

from experiments.loop.loop import ClosedLoop
from experiments.record.record import Record
from hardware.errors import RecordingError
from hardware.storage.marks import NAME, Mark, read_marks

__all__ = ["BenchMarks"]

log = logging.getLogger(__name__)


class BenchMarks:
    """The levels and shares that were marked in a run's folder, each taken over once, also over a resume."""

    def __init__(self, record: Record) -> None:
        self._record, self._size = record, -1
        self._taken = sum(row["kind"] in ("level", "share") for row in record.journal.rows)

    def take(self, loop: ClosedLoop) -> None:
        """Tell the loop what was marked since the last call; a damaged file of marks is only reported.

        Raises: RecordingError of the journal.
        """
        path = self._record.folder / NAME
        size = path.stat().st_size if path.is_file() else -1
        if size == self._size:
            return
        self._size = size
        try:
            marked = [mark for mark in read_marks(self._record.folder) if mark.measured]
        except RecordingError as error:
            log.warning("%s", error)
            return
        for mark in marked[self._taken :]:
            self._taken += 1
            self._tell(loop, mark)

    def _tell(self, loop: ClosedLoop, mark: Mark) -> None:
        known, journal = mark.reactor in loop.reactors.names, self._record.journal
        if mark.level_ml is not None:
            journal.append("level", {"reactor": mark.reactor, "level_ml": mark.level_ml})
            if known:
                before = loop.set_level(mark.reactor, mark.level_ml)
                log.info("%s: %.1f mL in the vial by its mark, %.1f by the ledger", mark.reactor, mark.level_ml, before)
        if mark.share is not None and mark.sd is not None:
            counted = {"share": mark.share, "sd": mark.sd, "minute": mark.time_min}
            journal.append("share", {"reactor": mark.reactor, **counted})
            if known:
                said = f"{mark.reactor}: share {mark.share:g} +- {mark.sd:g} at minute {mark.time_min:.0f} by its mark"
                answer, doubtful = loop.counted(mark.reactor, **counted)
                log.log(logging.WARNING if doubtful else logging.INFO, "%s, %s", said, answer)
