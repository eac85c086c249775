"""Faults that the interlock finds, each with its sentence, remedy and response."""

from hardware.messages import Fault, UndosedFault

# A reason that means the sensor is invalid may not regulate: the device would pump by the same reading.
# fmt: off


class FallsFault(Fault, says="OD fell from {before:.3f} to {od:.3f}: no dose explains that",
    remedy="does liquid flow? Pull the feed tube out of the bottle; else check vial and stirrer", response="pumps_off"):
    """A pump runs on, a leak, a moved vial or a stopped stirrer; once certain, no dose for some minutes."""
class SlowFallFault(FallsFault, says="ln OD is {below:.2f} below what growth and doses explain"):
    """OD fell in small steps."""
class FallsPause(FallsFault, says="no dose for another {minutes:.1f} min after the fall"):
    """The pause after such a fall."""
class OverflowFault(Fault, says="room for {left_ml:.2f} mL in the vial, {asked_ml:.2f} mL asked",
    remedy="check waste pump and tube; mark the level: python -m experiments.mark run=RUN reactor=NAME level_ml=ML",
    response="pumps_off"):
    """By the ledger the vial is too full."""
class NoDilutionFault(Fault, says="ln OD is {above:.2f} too high: some or all of the last {doubt_ml:.1f} mL was air",
    remedy="check bottle (filled: mark it, bottle_ml=ML), feed tube and gasket; clean the vial's wall",
    response="hold"):
    """OD rose as if no dose was given; no dose for some minutes, then tried again."""
class NoDilutionPause(NoDilutionFault, says="no dose for another {minutes:.1f} min after the failed dilution"):
    """The pause after a dose that did not dilute."""
class CannotHoldFault(Fault, says="full feed does not bring OD down to {setpoint:g}",
    remedy="check bottle and tube, weigh the doses; else start a new run that is colder or has a higher setpoint",
    response="report"):
    """The pump doses the permitted maximum; doses continue while this lasts."""
class DosesNotTaken(UndosedFault, says="{owed_ml:.2f} mL were allowed, nothing was dosed",
    remedy="read the notes of the run before this line"):
    """The device took none of the doses that were allowed: link too slow, or device not as set."""
class BottleFault(Fault, says="{left_ml:.2f} mL left in the bottle, {asked_ml:.2f} mL asked",
    remedy="fill the bottle, then: python -m experiments.mark run=RUN reactor=NAME bottle_ml=ML", response="hold"):
    """By the ledger the bottle is empty; no dose until it is marked as filled."""
class BudgetFault(Fault, says="{left_ml:.2f} mL left of the feed budget, {asked_ml:.2f} mL asked",
    remedy="check for a leak or wash-out; if the flow is right, a new run with more safety.ml_per_hour or ml_per_run",
    response="hold"):
    """The feed of a minute, an hour or the run is used up; no dose until there is room again."""
class JumpFault(Fault, says="OD rose from {before:.3f} to {od:.3f}: growth cannot do that",
    remedy="wait five minutes, then check for bubbles, foam and a moved vial", response="hold"):
    """As a rule a bubble; accepted after six readings that agree."""
class ImpossibleFault(Fault, says="OD {od:.3f} at {raw:.0f} counts is out of range; possible: {low:g} to {high:g}",
    remedy="check cable, vial and blank", response="hold"):
    """No culture or vial can give this reading."""
class SpectrometerFault(Fault, says="OD {od:.2f} at {raw:.0f} counts: the light sensor failed",
    remedy="check the spectrometer's cable; restart the device if it persists", response="pumps_off"):
    """The light sensor fails: OD 12 to 14, or hardly a count."""
class FrozenFault(Fault, says="OD exactly {od:.6f} in {samples:.0f} samples",
    remedy="look at the device's terminal: its measuring thread may be dead; restart its software and resume",
    response="hold"):
    """The same reading to the last digit, which no noisy sensor gives."""
class StaleFault(Fault, says="no new sample for {age_s:.0f} s", remedy="check link and device", response="hold"):
    """The newest sample is older than safety.stale_s."""
class LostFault(Fault, says="no new sample for {age_s:.0f} s",
    remedy="check link and device; pumps are swept off as soon as it answers", response="pumps_off"):
    """The newest sample is older than safety.lost_s; the pumps go off as soon as the device answers."""
class SilentFault(Fault, says="no new sample for {age_s:.0f} s",
    remedy="repair the link or the device, then start a new run; a stopped reactor stays so when resumed",
    response="stop"):
    """No sample for safety.silent minutes; a resumed run keeps the reactor stopped."""
class HotFault(Fault, says="{temperature:.1f} degC, target {target:.1f} degC: heating off",
    remedy="check heater and thermometer; heating stays off until a new run", response="hold"):
    """Two degrees above the target, or above 42 degC; thermostat and heater stay off in this run."""
class ThermometerFault(Fault, says="reads {temperature:.1f} degC: heating off",
    remedy="check that the vial is seated; heating stays off until a new run", response="report"):
    """The thermometer reads nonsense; the heater stays off in this run, doses go on."""
class SetpointFault(Fault, says="setpoint OD {setpoint:g}: allowed above 0 to {most:g}",
    remedy="correct the schedule, start a new run", response="hold"):
    """No culture can be held at this setpoint."""
class LimitFault(Fault, says="{rate:g} mL/s cut to {most:g} mL/s",
    remedy="ignore it if the controller requested too much; else raise bench.max_rate", response="report"):
    """The controller requested more than the largest rate: cut."""
class ControllerFault(Fault, says="proposed {rate:g} mL/s",
    remedy="if this happens once, ignore it; else see the policy's input and output in journal.jsonl", response="hold"):
    """The controller proposed no number, or a negative one."""
class ControllerLostFault(Fault, says="{count:.0f} unusable proposals in a row",
    remedy="replace the policy, then start a new run", response="regulate"):
    """The controller failed several times in a row: the device holds the last setpoint."""
class CommandLimitFault(Fault, says="{actuator}: {asked:.4g} {unit} asked, allowed {low:g} to {high:g}",
    remedy="ignore it if the controller requested too much; else set the limits of safety",
    response="report"):
    """A temperature or another command was out of range: cut."""
class FluorescenceFault(Fault, says="{counts:.0f} counts, the same in {samples:.0f} samples",
    remedy="if this happens once, ignore it; else check LED, spectrometer and the slot's gain", response="report"):
    """Impossible, frozen or missing (nan) reading; the controller does not see it."""
class FluorescenceLostFault(Fault, says="no valid reading for {minutes:.0f} min, now {counts:.0f} counts",
    remedy="check LED and spectrometer, then look at the device's FP slot", response="report"):
    """Fluorescence is unavailable; the share estimate continues from the model alone."""


PAUSES = (NoDilutionPause, FallsPause)
