"""What a run's record tells: alarms that ended, who decides, what was repaired, files that cannot be used."""

from conf.messages import Message
from hardware.errors import RecordingError

# fmt: off

class WellAgain(Message, says="interlock: all well again"):
    """Doses again."""
class AlarmsTold(Message, says="{reactor}: the interlock told: {kinds}"):
    """At the end of a run: how often and when each kind was said."""
class SupervisorActs(Message, says="the supervisor's law acts, the estimate is in doubt, from minute {minute:.0f}"):
    """The estimate is out of the bounds of the proof, or readings do not fit it: a one-line controller doses."""
class PolicyActs(Message, says="the policy acts again from minute {minute:.0f}"):
    """The estimate is back within the bounds."""
class RecordingGone(Message, says="{path}: deleted or moved in the run",
    remedy="leave it: rows go on into the journal; resume=RUN writes the file anew once the run has ended"): ...
class RowCompleted(Message, says="{reactor}: the row of minute {minute} was completed from the journal"):
    """A kill or a power cut while a row was written; nothing else is lost."""
class TornJournal(Message, says="journal: cut a torn last line of {length} bytes"):
    """The same."""
class Resumed(Message, says="resumed at minute {minute:.1f}; {doses} dose(s) booked from the journal"): ...
class NoState(RecordingError, says="{path}: no state to resume from ({why})",
    remedy="journal and recordings are kept; start a new run, or put back the file as the run wrote it"): ...
class RecordingUnreadable(RecordingError, says="{path}: {why}",
    remedy="resume the run: it is written anew from the last 20 MB of the journal"): ...
class RecordingDamaged(RecordingError, says="{path}: damaged near line {line} ({why})",
    remedy="move it away and resume again: it is written anew from the last 20 MB of the journal"): ...
