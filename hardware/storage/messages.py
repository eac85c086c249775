"""Errors of a run's files: each one ends the run, with the pumps verified off, or prevents a resume."""

from conf.messages import Message
from hardware.errors import RecordingError

# fmt: off

class NotWritten(RecordingError, says="{path}: {why}", remedy="free disk space, then resume the run"):
    """The disk is full or gone; the run ends."""
class NotOpened(RecordingError, says="{path}: {why}", remedy="check folder, rights and disk"): ...
class JournalTaken(RecordingError, says="journal {path}: another program writes this run", remedy="end it first"):
    """Two programs would write one run; nothing was changed."""
class JournalMissing(RecordingError, says="journal {path}: missing or empty",
    remedy="restore it or start a new run"): ...
class RowDamaged(RecordingError, says="{path}: {what}",
    remedy="the file was changed by hand: restore what the run wrote, or start a new run"): ...
class NotRecording(RecordingError, says="{path}: {why}", remedy="{help}"):
    """The path holds a file that is not this recording. The run is not resumed."""
class WrongRow(RecordingError, says="{path}: row lacks columns {missing} and has unknown columns {unknown}",
    remedy="report it"):
    """An error in the program; the run ends."""
class MarksDamaged(RecordingError, says="{path}: damaged ({why})", remedy="repair it or move it away"): ...
class TornLine(Message, says="{path}: removed an incomplete last line of {length} bytes"):
    """The program was killed or lost power while it wrote a row. Nothing else is lost."""
