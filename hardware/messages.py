"""Messages of every kind of reactor or its link: faults, and notes on doses."""

import re
from typing import ClassVar

from conf.messages import Message
from hardware.errors import DeviceStateError


class Fault(Message):
    """Fault of one reactor: its kind, what was observed, the remedy.

    Attributes: response: what the interlock does, a key of `hardware.safety.config.WORDS`. kind: name of the fault in
      settings and records, from the class that declares the response: NoDilutionFault gives "no_dilution".
    """

    kind: ClassVar[str] = ""
    response: ClassVar[str] = ""

    def __init_subclass__(cls, response: str = "", **words: str) -> None:
        super().__init_subclass__(**words)
        if response:
            cls.response = response
            cls.kind = re.sub(r"\B([A-Z])", r"_\1", cls.__name__.removesuffix("Fault")).lower()

    def __str__(self) -> str:
        return f"{self.kind}: {super().__str__()}"

    def line(self, done: str) -> str:
        """Return the fault in one line: kind, sentence, what was done, remedy."""
        return f"{self.kind}: " + "; ".join(filter(None, (self.sentence, done, self.remedy)))


# fmt: off

class LinkFault(Fault, response="hold"): ...
class SelectionFault(Fault, response="hold"): ...
class IdentityFault(Fault, response="stop"): ...
class AbsentFault(Fault, response="hold"): ...
class RestartedFault(Fault, response="hold"): ...
class StoppedFault(Fault, response="pumps_off"): ...
class StalledFault(Fault, response="hold"): ...
class ModeFault(Fault, response="hold"): ...
class BlankFault(Fault, response="hold"): ...
class PumpFault(Fault, response="pumps_off"): ...
class OverflowPumpFault(Fault, response="hold"): ...
class UndosedFault(Fault, response="report"): ...
class NoDose(Message, says="no dose: {why}"):
    """No dose was begun for this sample; the culture grows undiluted."""
class NoNewSample(Message, says="no new sample"):
    """The newest sample was already used, or no sample has arrived yet."""
class DoseUnderWay(Message, says="the previous dose has not ended"):
    """Its pumps are not yet verified off; if this persists, see the fault of kind pump."""
class OpenDose(Message, says="a dose of {ml:.2f} mL was unfinished when the program ended",
    remedy="check the level and the bottle"):
    """The program was killed during a dose. A note with the volume follows if it was not as planned."""
class NotLeftOff(DeviceStateError, says="{why}; {failed}"): ...
class PumpsNotOff(DeviceStateError, says="pumps not verified off: {failed}",
    remedy="pull the plug of the pump boards now"): ...
class PreflightFailed(DeviceStateError, says="preflight: {count} of {of} checks failed, the first: {first}"): ...
class PumpsNotLookedAt(Message, says="stopped before the pumps were checked: pumps not verified off",
    remedy="look at the pumps, then resume the run"):
    """A pump may still be on from before the interruption."""
class ClockMoved(Message, says="this computer's clock was moved by {by_min:.1f} min since the run's last row; "
    "the run ignores this and continues at minute {minute:.1f}", remedy="correct the clock, check its battery"):
    """The run uses the device's cycles and the monotonic clock instead."""
class ClockDoubtful(Message,
    says="the length of the interruption is known only from this computer's clock, which may be wrong",
    remedy="compare the minute in the next line with a watch"):
    """Both the computer and the device were rebooted."""
