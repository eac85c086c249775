"""What a Chi.Bio and its driver tell while a run goes on: faults, notes on doses and on the device, failed requests."""

from conf.messages import Message
from hardware import messages as any_kind
from hardware.errors import DeviceStateError, IdentityError, LinkError, ProtocolError

# fmt: off

class NoAnswer(any_kind.LinkFault, says="{error}", remedy="asks again every few seconds"):
    """No answer, or none that is readable; no dose meanwhile."""
class SelectedElsewhere(any_kind.SelectionFault, says="{error}", remedy="close the device's web page everywhere"): ...
class ReactorsExchanged(any_kind.IdentityFault, says="{error}",
    remedy="reactors were exchanged: put them back, start a new run"): ...
class ReactorMissing(any_kind.AbsentFault, says="{error}", remedy="plug it in with the server stopped"):
    """No reactor at this position; nothing is sent to it. Never plug while the server runs."""
class ExperimentGone(any_kind.RestartedFault,
    says="the experiment of {start_time} is gone, cycles {cycles}, blank {blank:.0f}",
    remedy="blank and targets are restored and the experiment is started again; check the board's power"):
    """A restart or a power cut of the device."""
class EndedByUs(any_kind.StoppedFault, says="this program ended the experiment: {why}", remedy="it is started again"):
    """Pumps did not stop, or no sample came; started again every minute."""
class EndedBySomebody(any_kind.StoppedFault, says="the experiment was stopped by someone",
    remedy="start it in the device's web page, close the page"):
    """It stays ended until somebody starts it."""
class NotTakenOver(any_kind.StoppedFault, says="not taken over: {error}",
    remedy="the others go on and this one is tried again"):
    """A resumed run cannot have one reactor."""
class BlankChanged(any_kind.BlankFault, says="the blank was changed from {before:.1f} to {now:.1f}",
    remedy="set it back (raw {before:.1f}, OD 0) or start a new run"):
    """Somebody calibrated the OD."""
class PumpStaysOn(any_kind.PumpFault, says="{why}", remedy="switch the pump board off by hand"):
    """A pump was told to stop and not verified off; after four tries the device's experiment is ended."""
class StrayPump(any_kind.PumpFault, says="pumps on: {pumps}, and no dose has them",
    remedy="close the device's web page everywhere; look for a proxy that repeats requests"):
    """Another program switched a pump on, or a command was late or repeated on the way; booked."""
class ForeignMode(any_kind.ModeFault, says="{mode}: not as this program left it",
    remedy="set it back in the device's web page, close the page"):
    """The device regulates by itself."""
class NoSamples(any_kind.StalledFault, says="no new sample for {age_s:.0f} s, cycles {cycles}",
    remedy="after {lost_s:.0f} s its experiment is restarted; look at the device's terminal"):
    """The device answers and takes no samples."""
class NoNumber(any_kind.StalledFault, says="no new sample for {age_s:.0f} s, cycles {cycles}: {items} holds no number",
    remedy="only a restart of the device's software helps; then resume"):
    """Somebody set a pump to nan; the app cannot write its records any more."""
class OverflowPumpAmiss(any_kind.OverflowPumpFault,
    says="the overflow pump, {pump}, is {found} after it was set to {duty:g} and on",
    remedy="close the device's web page everywhere; look at the pump's plug; restart the device"):
    """The overflow pump cannot be had on; no dose until it runs."""
class SampleTooOld(Message,
    says="{past_s:.0f} s after its sample appeared it would not end before the next measurement",
    remedy="close web pages; use a faster link"): ...
class UnknownAge(Message, says="its sample is of unknown age, the next one is waited for"): ...
class OnBoardRegulation(Message, says="handed over to the on-board regulation"): ...
class BeingStarted(Message, says="being started"): ...
class NoTube(Message, says="{pump} has no tube", remedy="weigh it and give backend.supply.{setting}"): ...
class TooSlow(DeviceStateError, says="the device answers too slowly ({past_s:.0f} s after the sample)",
    remedy="close web pages; use a faster link"): ...
class NotAsSet(DeviceStateError, says="targets {targets}, pumps on: {pumps}: not as set",
    remedy="close the device's web page everywhere"): ...
class KeptForNextDose(Message, says="{ml:.3f} mL is less than the pump can deliver: kept for the next dose"):
    """Below what the motor can do; nothing to do."""
class DoseCut(Message, says="the dose was cut by {ml:.3f} mL to the feed limit"):
    """More was asked than one dose may be; if it is not rare, weigh the pump."""
class CommandLost(Message, says="the command to {pump} was lost or refused, what it did is looked for: {error}"): ...
class SlowLink(Message, says="the link is slow: the feed pump's command was answered after {took_s:.1f} s",
    remedy="close web pages; use a faster link"):
    """The dose is counted from the answer."""
class DoseRepeated(Message,
    says="a dose of {ml:.2f} mL was repeated up to {times} times by the device, {low_ml:.2f} to {most_ml:.2f} mL",
    remedy="booked at their times; look at link and level"):
    """The device repeats a dose every 63 s until it hears the off command."""
class DoseGave(Message, says="a dose of {ml:.2f} mL gave {low_ml:.2f} to {most_ml:.2f} mL, booked as the latter"):
    """Cut short, or not known exactly; alarms go by the least."""
class DoseGaveNothing(Message, says="a dose of {ml:.2f} mL gave no medium"): ...
class DosePerhapsTwice(Message,
    says="a dose gave {ml:.2f} to {twice_ml:.2f} mL, booked as the former: a lost command may have come late"):
    """For an hour after a lost command each dose may have been given twice."""
class GivenWithoutDose(Message,
    says="{pump} gave {low_ml:.2f} to {most_ml:.2f} mL without a dose, booked as the latter: {cause}",
    remedy="close the device's web page everywhere; look at the link"):
    """A pump was on without a dose; switched off, booked, and the vial drained."""
class ChangedInDose(Message, says="{pump} in a dose: {cause}",
    remedy="close the device's web page everywhere; look at the link"):
    """The next note says what the dose gave."""
class TargetChanged(Message, says="its target was changed from {before:.4g} to {now:.4g}"): ...
class RanAgain(Message,
    says="it ran again, as a command was repeated or late on the way, or another program gave one"): ...
class AgentSwitchedOff(Message, says="the board agent switched off in a dose: {pumps}", remedy="look at the link"): ...
class AgentSaysNothing(Message, says="the board agent does not say what it switched off: {error}",
    remedy="check the cable; update the board agent"):
    """The link failed, or the agent is of another version; what the pumps may have given is booked."""
class RestartedInDose(Message, says="the device was restarted in a dose, which ended it",
    remedy="look at the power supply"):
    """A restart switches all pumps off, nobody knows when; the most is booked."""
class PumpsFoundOn(Message, says="pumps were found on and switched off: {pumps}"): ...
class MeasuresTooLong(Message, says="the device has measured for {seconds:.0f} s, which is too long: started anew"): ...
class OldCycle(Message, says="an experiment was stopped, its last cycle may still end: waits {seconds:.0f} s"): ...
class StoppedMeanwhile(Message, says="its experiment was stopped meanwhile and is started again"): ...
class StartsInTurn(Message, says="its experiment starts in {seconds:.0f} s, one reactor after the other"): ...
class RestartedAfter(Message, says="restarted after: {kind}"):
    """The experiment was started again, with blank and targets."""
class RestartedAgain(Message, says="the restart before brought no sample, attempt {attempt} follows",
    remedy="look at the device's terminal: a thermometer or the spectrometer may be dead"): ...
class NotRestarted(Message, says="the experiment could not be restarted after {kind}, tried again: {error}"): ...
class PutRight(Message, says="{item} was {found} and was {done}", remedy="close the device's web page everywhere"):
    """A restart or a web page changed it. A fluorescence slot's cycle has no reading."""
class NotPutRight(Message, says="{item} was {found} and could not be {done}: {error}"):
    """Tried again with the next sample."""
class TemperatureNotSet(Message,
    says="thermostat target {target} degC not set, tried again with the next sample: {error}"):
    """Look at the link if it stays."""
class DumpWillFail(Message, says="{items} hold no number, and measuring will end at the device's next dump",
    remedy="restart the device's software within ten minutes; the run goes on then"):
    """The device has measured or heated with a nan; every tenth cycle it writes that to its disk, and cannot."""
class SampleLate(Message, says="a sample came {late_s:.0f} s late, or the board's clock was set back by that",
    remedy="nothing if it is once; else look at the board's disk and terminal"):
    """One cycle took so long, or the clock was set; no dose for that sample."""
class SampleBeforeLate(Message,
    says="the sample before came {late_s:.0f} s late, or the board's clock was set forward by that",
    remedy="nothing if it is once; else switch clock corrections off on the board"):
    """The run goes on by this computer's clock."""
class RegulationFoundOn(Message,
    says="the on-board OD regulation was found on and switched off: this run controls"): ...
class RegulationEnded(Message, says="on-board regulation switched off: the reactor is given up"):
    """Stopped after it had been handed over; see why it was stopped."""
class StaysHandedOver(Message,
    says="handed over to the on-board regulation at OD {setpoint:g} earlier in this run: {done}"):
    """A resumed run or restarted device leaves it so, or restores it."""
class SlotAmiss(Message, says="the fluorescence slot {slot} is {found} after it was switched on",
    remedy="update the device's software or the board agent"):
    """Tried again; no reading of the light until then."""
class NotReady(DeviceStateError, says="{reactor}: {trouble}", remedy="run the preflight"): ...
class ModeOn(DeviceStateError, says="{reactor}: {modes} is on",
    remedy="switch it off in the device's web page, close the page"): ...
class SettingsNotTaken(DeviceStateError,
    says="{reactor} took other settings: blank {blank:.1f}, not {asked:.1f}, thermostat {target} degC, not {asked_c}",
    remedy="run the preflight"):
    """The run does not start, or the recovery ends."""
class DoesNotStart(DeviceStateError, says="{reactor}: the experiment does not start",
    remedy="look at the device's terminal; restart the device"):
    """Three tries; the run does not start, or the recovery ends."""
class DoesNotEnd(DeviceStateError, says="{reactor}: the experiment does not end",
    remedy="stop it in the device's web page"):
    """After a blank: the experiment goes on."""
class HandOverFailed(DeviceStateError, says="{reactor}: {found} after it was switched on at {setpoint:g}",
    remedy="close web pages; if it stays, end the run"):
    """The hand-over did not take; tried again."""
class StillOn(DeviceStateError, says="{reactor}: {pumps} still on after the off command{refused}"):
    """Tried again, then the experiment is ended; the waste pump runs beside a feed pump that may run."""
class CannotBeRead(DeviceStateError,
    says="{reactor} cannot be read: the device shows {shown}; another client keeps selecting reactors"):
    """Each read showed another reactor: no dose."""
class OtherIdentity(IdentityError, says="{reactor} answers with identity {found}, pinned is {pinned}"):
    """Reactors were exchanged, or the device is an emulated one, new each time: such a run cannot be resumed."""
class Absent(DeviceStateError, says="{reactor} is absent (present: {present})"):
    """The device does not see it; nothing is sent, as a command would end the device's software."""
class NotSent(DeviceStateError, says="refused to send POST {path}: {reactor} was not seen present"): ...
class NoReactor(DeviceStateError, says="the device has no reactor", remedy="plug one in with the server stopped"): ...
class Forbidden(DeviceStateError,
    says="refused to send POST {path}: not among the commands that may be sent to {reactors}",
    remedy="report it"):
    """An error in the program; not sent."""
class OldAnswer(LinkError, says="an answer of an earlier time came again",
    remedy="look for a proxy or tunnel that keeps answers; connect without it"):
    """Something between here and the device answers from its memory; not believed."""
class WrongStatus(ProtocolError, says="{request}: status {status}, expected {expected}",
    remedy="check the address; restart the device's software"):
    """Something else answers, or the device's software is ill; a proxy may take a header away (403)."""
class NotUnderstood(ProtocolError, says="device state: {what}"):
    """A torn answer, or another software: nothing if it is once; else look at the software's version."""
class ExperimentRuns(DeviceStateError, says="{reactor}: an experiment is running",
    remedy="stop it before pumps are weighed"): ...
