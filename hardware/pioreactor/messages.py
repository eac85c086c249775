"""What a Pioreactor and its driver tell while a run goes on: faults, notes on doses, failed requests."""

from conf.messages import Message
from hardware import messages as any_kind
from hardware.errors import DeviceStateError, LinkError, ProtocolError

# fmt: off

class NoBroker(any_kind.LinkFault, says="no MQTT broker at {broker}: {why}; doses wait",
    remedy="look at the leader's power and network; on the leader: sudo systemctl restart mosquitto"):
    """No readings, and nothing is heard of the pumps; connects again by itself."""
class WebServerSilent(any_kind.LinkFault, says="its web server: {why}; doses wait", remedy="else reboot the unit"):
    """The unit took no request for 20 s; asked again."""
class NotBroughtUp(any_kind.LinkFault, says="{error}", remedy="the others go on, and this one is tried again"):
    """A resumed run cannot have one unit; tried again every 20 s."""
class FateUnknown(any_kind.PumpFault, says="a dose of {ml:.2f} mL ({job}) was not seen to begin: its fate is unknown",
    remedy="nothing is dosed until that is known; on the unit: sudo systemctl restart huey"):
    """Nothing came of the request; it is never sent again."""
class BeingVerified(any_kind.PumpFault, says="the {pump} pump (pin {pin}) is being verified off after {job}, {how}",
    remedy="wait a minute"):
    """A pump job ended without a word or does not end, and its unit does not tell its pump on."""
class RunsOn(any_kind.PumpFault, says="the {pump} pump (pin {pin}) runs on after {job}, {how}",
    remedy="pull its plug, or on the unit: {purge} pwm_locks {pin} --as-int"):
    """The unit tells that the pump is on; the waste pump prevents an overflow. The alarm ends by itself."""
class MayRunOn(any_kind.PumpFault, says="the {pump} pump (pin {pin}) may run on after {job}, {how}",
    remedy="look at it; if it runs, pull its plug, or on the unit: {purge} pwm_locks {pin} --as-int"):
    """Nothing proved it off in 20 s, and the unit may not know that it is on. The alarm ends by itself."""
class PinsUntold(any_kind.PumpFault, says="the unit told nothing of its pins when one was switched",
    remedy="stop and start stirring in the vendor's page, else reboot the unit"):
    """No dose can be followed; stirring is switched and listened to again."""
class OtherClient(any_kind.ModeFault, says="process {pid} on {host} controls {unit}: one client per unit",
    remedy="end one of the two; if it is not there any more: mosquitto_pub -r -n -t {topic}"):
    """Another program controls the unit."""
class Astray(any_kind.ModeFault, says="{why}", remedy="assign it to {experiment}, active, in the vendor's page"):
    """The unit is in another experiment, inactive or removed: the vendor's jobs do not run there."""
class VendorDoses(any_kind.ModeFault, says="{job} of the vendor's runs", remedy="stop it in the vendor's page"):
    """A job that drives several pumps; counted by its events and by the pumps' pins."""
class ForeignDose(any_kind.ModeFault, says="{job} of {ml:.2f} mL more without our command ({who})",
    remedy="one client per unit; find who it was; it is counted"):
    """Somebody else dosed."""
class ReaderComplains(any_kind.StoppedFault, says="the unit takes no OD readings, its log says: {log}",
    remedy="do what that says, else reboot the unit; doses wait"):
    """The reader runs and publishes nothing. Below the blank: clear or renew the experiment's OD blank."""
class UnitSilent(any_kind.StoppedFault, says="the unit {gone}, nor says anything",
    remedy="look at its power and network; {again}"):
    """A job stopped, and nothing else comes from the unit by MQTT; the job is asked for every 20 s."""
class JobGone(any_kind.StoppedFault, says="the unit {gone}",
    remedy="{again}; a killed job blocks restarts, on the unit: {command}"):
    """Readings, stirring, heating or the vendor's turbidostat stopped; asked for every 20 s."""
class DoseNotTaken(any_kind.UndosedFault, says="{why}", remedy="tried again"):
    """The unit began no pump for two doses in a row: as a rule a lock that a killed process left."""
class GivenUp(Message, says="the unit was given up"): ...
class RegulatesItself(Message, says="the unit regulates itself"): ...
class SampleStale(Message, says="its sample is stale"): ...
class DosedElsewhere(Message, says="a pump or a dosing job of somebody else runs"): ...
class MessageIgnored(Message, says="a message was ignored, {topic!r}: {why}"):
    """Its kind is told once; nothing if it is once."""
class LedgerSet(Message, says="its own ledger: {level}"):
    """The unit's own ledger was put to a level, or refuses it: then give a level that the vial can hold."""
class DoseEnd(Message, says="{pump}: {end}"):
    """A dose did not end as asked."""
class NotGiven(Message, says="not given, the next sample is dosed: {error}"): ...
class NotCarriedOut(Message, says="accepted and not carried out",
    remedy="if the unit's log names a lock on the pin, on the unit: {purge} pwm_locks {pin} --as-int"): ...
class ForgottenByRestart(Message, says="not carried out: the unit was started again, which forgets requests",
    remedy="look at the unit's power supply"): ...
class ToldLess(Message, says="{told_ml:.2f} of {ml:.2f} mL told: ended early, or its last event was not sent"):
    """Counted with the least and the most."""
class RanLonger(Message, says="its pin was on for {ran_ml:.2f} mL, {told_ml:.2f} mL were told"):
    """Counted with the least and the most."""
class EndedFromHere(Message, says="ended from here"): ...
class StartedAgainInDose(Message, says="the unit was started again in it"): ...
class EndUnseen(Message, says="its end was not on record: at most what was asked, unless its pump was found on"): ...
class PerhapsHeard(Message, says="{job}: whether it was heard is unknown: {error}", remedy="look at the network"):
    """The answer was lost; waits until the request can do nothing more."""
class RanLate(Message, says="{job} of {ml:.2f} mL ran late", remedy="look at the unit's load"): ...
class Drained(Message, says="{ml:.1f} mL of waste: the vial is drained of what the media pump gives that runs on",
    remedy="look at the level; if it is not at its tube: python -m experiments.mark run=RUN reactor=NAME level_ml=ML"):
    """Too full: the waste pump runs, once nothing asks for pumps off."""
class GivenBeside(Message, says="{why}: {low_ml:.2f} to {high_ml:.2f} mL"):
    """A pump gave what no dose of this run asked for; counted. See the faults of kind mode."""
class NotHeard(LinkError):
    """A request that certainly was not carried out: nobody was reached, or it was turned away."""
class NobodyReached(NotHeard, says="{error}",
    remedy="check the unit's power and network, then on the unit: sudo systemctl restart pioreactor-web.target"): ...
class NoReply(LinkError, says="{error}",
    remedy="check the unit's power and network, then on the unit: sudo systemctl restart pioreactor-web.target"): ...
class TurnedAway(NotHeard, says="{url}: its web server answered with status {status}: {reason}"): ...
class ServerFailed(ProtocolError, says="{url}: its web server answered with status {status}: {reason}",
    remedy="if that stays, on the unit: sudo systemctl restart pioreactor-web.target"): ...
class UnknownReply(ProtocolError, says="{url}: {what}"):
    """An unknown answer of the unit's web server; no dose; look at its version."""
class NobodyFollows(LinkError, says="no MQTT broker, so nobody would follow it"):
    """The dose was not asked for."""
class UnitTaken(DeviceStateError, says="{other}"):
    """Another program controls the unit; the run does not begin."""
class BrokerRefuses(LinkError, says="MQTT broker {broker}: {why}",
    remedy="check backend.username, and its password in backend.password_file or the environment"):
    """The run does not begin."""
class QueueStuck(LinkError, says="the task queue takes nothing, so a dose would run at any time",
    remedy="on the unit: sudo systemctl restart huey"):
    """The run does not begin."""
class AutomationRuns(DeviceStateError, says="a dosing automation of the vendor's runs, and would dose too",
    remedy="stop it in its page"):
    """The run does not begin."""
class NotCalibrated(DeviceStateError, says="no active calibration of the {pump} that gives mL per second",
    remedy="calibrate it in the vendor's page (Calibrations, {pump}); doses in mL are refused without"):
    """The run does not begin."""
class UnitPumpOn(DeviceStateError, says="pumps of {unit}: {pump} on: {why}", remedy="pull its plug"):
    """The unit tells a pump on, though it was told off."""
class UnitPumpsUnproven(DeviceStateError, says="pumps of {unit} not verified off: {why}", remedy="{off}"):
    """None is told on, and the proof is under way, or backend.stop_s at the end of a run is over."""
class JobDoesNotEnd(DeviceStateError, says="{job} of {unit} does not end", remedy="stop it in the vendor's page"): ...
class DoesNotRegulate(DeviceStateError, says="the vendor's turbidostat does not regulate",
    remedy="look at its log"): ...
