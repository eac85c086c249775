"""Faults that the interlock finds, each with its sentence, remedy and response."""

from hardware.messages import Fault, UndosedFault

# A reason that means the sensor is invalid may not regulate: the device would pump by the same reading.
# fmt: off


class FallsFault(Fault, says="OD fell from {before:.3f} to {od:.3f}: no dose explains that",
    remedy="if liquid flows, pull the feed tube out of the bottle; else check vial and stirrer", response="pumps_off"):
    """A pump runs on, the vial leaks or was moved, or the stirrer stopped. Once confirmed, no dose for some minutes."""
class SlowFallFault(FallsFault, says="ln OD is {below:.2f} below what growth and doses explain"):
    """OD fell in small steps."""
class FallsPause(FallsFault, says="no dose for another {minutes:.1f} min after the OD fell"):
    """The pause after an unexplained fall of the OD."""
class OverflowFault(Fault, says="room for {left_ml:.2f} mL in the vial, {asked_ml:.2f} mL requested",
    remedy="check waste pump and tube; mark the level: python -m experiments.mark run=RUN reactor=NAME level_ml=ML",
    response="pumps_off"):
    """By the run's ledger the vial is too full."""
class NoDilutionFault(Fault, says="ln OD is {above:.2f} too high: some or all of the last {doubt_ml:.1f} mL was air",
    remedy="check bottle, feed tube and gasket (after filling the bottle, mark bottle_ml=ML); clean the vial's wall",
    response="hold"):
    """OD rose as if no dose was given. No dose for some minutes, then the run tries again."""
class NoDilutionPause(NoDilutionFault, says="no dose for another {minutes:.1f} min after the failed dilution"):
    """The pause after a dose that did not dilute."""
class CannotHoldFault(Fault, says="full feed does not bring OD down to {setpoint:g}",
    remedy="check bottle and tube, weigh a dose; else start a new run that is colder or has a higher setpoint",
    response="report"):
    """The pump doses the permitted maximum. Doses continue while this lasts."""
class DosesNotTaken(UndosedFault, says="{owed_ml:.2f} mL were allowed, nothing was dosed",
    remedy="read the run's notes above this line"):
    """The device gave none of the allowed doses: the link is too slow, or its settings were changed."""
class BottleFault(Fault, says="{left_ml:.2f} mL left in the bottle, {asked_ml:.2f} mL requested",
    remedy="fill the bottle, then: python -m experiments.mark run=RUN reactor=NAME bottle_ml=ML", response="hold"):
    """By the run's ledger the bottle is empty. No dose until you mark the bottle as filled."""
class BudgetFault(Fault, says="{left_ml:.2f} mL left of the feed budget, {asked_ml:.2f} mL requested",
    remedy="check for a leak or wash-out; if the flow is right, start a run with more safety.ml_per_hour or ml_per_run",
    response="hold"):
    """The feed budget of a minute, an hour or the run is used up. No dose until it has room again."""
class JumpFault(Fault, says="OD rose from {before:.3f} to {od:.3f}: growth cannot do that",
    remedy="wait five minutes, then check for bubbles, foam and a moved vial", response="hold"):
    """Usually a bubble. The new OD is accepted after six readings that agree."""
class ImpossibleFault(Fault, says="OD {od:.3f} at {raw:.0f} counts is out of range; possible: {low:g} to {high:g}",
    remedy="check cable, vial and blank", response="hold"):
    """No culture or vial can give this reading."""
class SpectrometerFault(Fault, says="OD {od:.2f} at {raw:.0f} counts: the light sensor failed",
    remedy="check the spectrometer's cable; restart the device if it persists", response="pumps_off"):
    """A failed light sensor reads OD 12 to 14, or almost no counts."""
class FrozenFault(Fault, says="OD exactly {od:.6f} in {samples:.0f} samples",
    remedy="look at the device's terminal: its measuring thread may be dead; restart its software and resume",
    response="hold"):
    """A working sensor has noise and does not repeat a reading to the last digit."""
class StaleFault(Fault, says="no new sample for {age_s:.0f} s", remedy="check link and device", response="hold"):
    """The newest sample is older than safety.stale_s."""
class LostFault(Fault, says="no new sample for {age_s:.0f} s",
    remedy="check link and device", response="pumps_off"):
    """The newest sample is older than safety.lost_s. The pumps are switched off as soon as the device answers."""
class SilentFault(Fault, says="no new sample for {age_s:.0f} s",
    remedy="repair the link or the device, then start a new run; a resumed run keeps the reactor stopped",
    response="stop"):
    """No sample for safety.silent minutes."""
class HotFault(Fault, says="{temperature:.1f} degC, target {target:.1f} degC: heating off",
    remedy="check heater and thermometer; heating stays off until a new run", response="hold"):
    """The vial is two degrees above the target, or above 42 degC."""
class ThermometerFault(Fault, says="reads {temperature:.1f} degC: heating off",
    remedy="check that the vial is seated; heating stays off until a new run", response="report"):
    """The reading is impossible. Doses continue."""
class SetpointFault(Fault, says="setpoint OD {setpoint:g}: allowed above 0, at most {most:g}",
    remedy="correct the schedule, start a new run", response="hold"):
    """No culture can be held at this setpoint."""
class LimitFault(Fault, says="{rate:g} mL/s cut to {most:g} mL/s",
    remedy="ignore it if the controller requested too much; else raise bench.max_rate", response="report"):
    """The controller requested more than the largest rate."""
class ControllerFault(Fault, says="proposed {rate:g} mL/s",
    remedy="if this happens once, ignore it; else see the policy's input and output in journal.jsonl", response="hold"):
    """The controller proposed no number, or a negative one."""
class ControllerLostFault(Fault, says="{count:.0f} unusable proposals in a row",
    remedy="replace the policy, then start a new run", response="regulate"):
    """The controller failed several times in a row. The device holds the last setpoint."""
class CommandLimitFault(Fault, says="{actuator}: {asked:.4g} {unit} requested, allowed {low:g} to {high:g}",
    remedy="ignore it if the controller requested too much; else change the limit in safety or bench.max_rate",
    response="report"):
    """A command was out of range. The nearest limit is sent instead."""
class FluorescenceFault(Fault, says="{counts:.0f} counts in {samples:.0f} samples in a row",
    remedy="if this happens once, ignore it; else check LED, spectrometer and the slot's gain", response="report"):
    """Impossible, frozen or missing (nan) reading; the controller does not see it."""
class FluorescenceLostFault(Fault, says="no valid reading for {minutes:.0f} min, now {counts:.0f} counts",
    remedy="check LED and spectrometer, then look at the device's FP slot", response="report"):
    """Fluorescence is unavailable; the share estimate continues from the model alone."""


PAUSES = (NoDilutionPause, FallsPause)
