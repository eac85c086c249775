"""One Chi.Bio reactor under control: start, targets, recovery, and its parts (docs/device.md).

Longer actions are tasks on the agenda that a station shares with its neighbours.
"""

import math
from collections.abc import Callable
from typing import Any

from conf.messages import Message
from hardware.chibio import messages
from hardware.chibio.agenda import Agenda, Task
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.diagnosis import describe, diagnose, fault_of, regulates
from hardware.chibio.dose_sequence import DoseSequence
from hardware.chibio.dosing import DosePlan, ReactorCalibration
from hardware.chibio.fluorescence import Fluorescence
from hardware.chibio.overflow_pump import OverflowPump
from hardware.chibio.protocol import FEED, PUMPS, DeviceState
from hardware.chibio.resume import ReactorHistory
from hardware.chibio.sampling import FIRST_SAMPLE_S, Sampling
from hardware.errors import DeviceStateError, LinkError, ProtocolError, ReactorError
from hardware.logbook import Logbook
from hardware.stations import Station

OLD_CYCLE_S = 70.0  # a stopped cycle thread wakes up to 65 s later and switches everything off once more
MEASURING_S = 20.0  # settling, four readings, three temperatures and three fluorescence slots take less
HELD_S = 30.0  # longest time that a new sample waits for the volume of the last dose
RETRY_S = 5.0  # before a failed request is repeated
STARTS = 3  # attempts to start an experiment before it counts as failed
AGAIN_S = 60.0  # pause after a restart that failed


class ChibioStation(Station):
    """One reactor under control.

    Args: volume_ml: volume of the culture, mL; the others as in `DoseSequence`.
    Attributes: sampling, doses, overflow_pump, fluorescence: its parts. busy: the reactor is being started or
      recovered. restored: `restore` has succeeded.
    """

    def __init__(
        self, connection: Connection, volume_ml: float, calibration: ReactorCalibration, config: ChiBioConfig,
        agenda: Agenda, book: Logbook, past: Callable[[], ReactorHistory],
    ) -> None:  # fmt: skip
        self.connection, self.book, self.name, self._clock = connection, book, connection.name, connection.clock
        self._volume_ml, self._calibration, self._config, self._agenda = volume_ml, calibration, config, agenda
        self._past, self.sampling = past, Sampling(config, connection.clock)
        self.doses = DoseSequence(connection, calibration, config, agenda, book, past)
        self.overflow_pump = OverflowPump(connection, self._config.overflow_pump, book)
        self.fluorescence = Fluorescence(connection, self._config.fluorescence, book)
        self.busy = self.restored = False
        self._held_s, self._restarts, self._again_s = math.nan, 0, -math.inf
        self._spoilt = False  # the run has reported that the device holds a nan
        self._ended = ""  # why this program ended the experiment, "" once it runs again
        self._target_c = self._config.temperature
        self._heat = True
        self._blank = math.nan

    def restore(self) -> None:
        """Restore the state before a resume; verify the pumps off, unless the on-board regulation runs as handed over.

        Raises: ReactorError if the reactor is not reachable, is another unit, or keeps a pump on.
        """
        history = self._past()
        self.connection.device_id = history.device_id
        if math.isfinite(history.temperature):
            self._target_c = history.temperature
        state = self.connection.read()
        self._blank = next((b for b in (history.blank, self._calibration.blank) if math.isfinite(b)), state.blank)
        self.overflow_pump.was_on, self.regulated_od = history.overflow_pump_on, history.handed_over
        self.doses.restore()
        if not regulates(state, self.regulated_od):
            if state.regulating:
                self._take_control()
            self.doses.settle(tries=3)
            if on := self._config.overflow_pump.others_on(state):
                self.book.tell(messages.PumpsFoundOn(pumps=on))
        self.restored = True

    def bring_up(self, waited: bool = False) -> Task:
        """Task: start the experiment with the run's settings, or adopt it. Args: waited: no old cycle still runs."""
        try:
            yield from self._let_measure()
            state = self.connection.read()
            if state.running and state.measuring:  # still, so the measurement is dead
                self.book.say(messages.MeasuresTooLong(seconds=MEASURING_S))
                self.connection.post(f"/Experiment/0/{self.name}")
                state = self.connection.read()
            if not state.running and state.cycles > 0 and not waited and not state.ended:
                self.book.say(messages.OldCycle(seconds=OLD_CYCLE_S))
                yield OLD_CYCLE_S
            self._prepare()
            state = self.fluorescence.keep_on(self.connection.read())
            self.sampling.pass_over(state)
            if not state.running:
                yield from self._start()
                if state.cycles == 0:
                    self.sampling.expect_first()
                if not self._heat:  # a start switches the thermostat on
                    self.heat_off()
            self.doses.escalated = False
            if self.handed_over:
                self._hand_over_again()
            state = self._keep_on(self.connection.read())
            self.sampling.arrived_s = self.sampling.next_look = self._clock.now()
            self.book.log(
                "device", device_id=self.connection.device_id, blank=self._blank, temperature=self._target_c,
                start_time=state.start_time,
            )  # fmt: skip
        finally:
            self.busy = False

    def take_over(self) -> Task:
        """Task: start the reactor in a run that continues meanwhile; report a failure. `poll` then tries again."""
        try:
            if not self.connection.read().running:
                self.book.say(messages.StoppedMeanwhile())
            yield from self.bring_up()
        except ReactorError as error:
            self.restored = False
            self.book.report(messages.NotTakenOver(error=error))

    def _let_measure(self) -> Task:
        """Task: wait until a measurement is over or takes too long, because a new blank would spoil the measurement.

        The device's flag is valid only while an experiment runs: an experiment that ends during a measurement leaves
        the flag set until the next start (docs/device.md, Cycle).
        """
        since = self._clock.now()
        while (state := self.connection.read()).running and state.measuring:
            if self._clock.now() - since > MEASURING_S:
                return
            yield 2.0

    def _prepare(self) -> None:
        """Set the run's blank and targets; switch the on-board regulation off, unless the run handed over to it."""
        connection, state = self.connection, self.connection.read()
        if state.pumping_modes:
            raise messages.ModeOn(reactor=self.name, modes=", ".join(state.pumping_modes))
        if state.regulating and not self.handed_over:
            self._take_control()
        if not abs(state.blank - self._blank) <= 0.5:  # also nan
            connection.set_blank(self._blank)
        for item, value, wanted in (
            ("Volume", state.volume_ml, self._volume_ml),
            ("Stir", state.stir_target, self._config.stir),
            ("Thermostat", state.temperature_target, self._target_c),
        ):
            if not abs(value - wanted) <= 1e-5:
                connection.target(item, wanted)
        state = connection.read()
        taken = abs(state.blank - self._blank) <= 0.5 and abs(state.temperature_target - self._target_c) <= 1e-3
        if not taken:
            raise messages.SettingsNotTaken(
                reactor=self.name, blank=state.blank, asked=self._blank, target=state.temperature_target,
                asked_c=self._target_c,
            )  # fmt: skip

    def _start(self) -> Task:
        """Task: start the experiment; read the state before every try, because a second start stops the experiment."""
        for _ in range(STARTS):
            if self.connection.read().running:
                return
            try:
                self.connection.post(f"/Experiment/1/{self.name}")
                self.overflow_pump.was_on = False  # a start switches every pump off
            except LinkError:
                yield RETRY_S
        if not self.connection.read().running:
            raise messages.DoesNotStart(reactor=self.name)

    def _recover(self, kind: str) -> Task:
        """Task: switch the pumps off and start the experiment again; stop it first if its thread is dead."""
        self._restarts += 1
        if self._restarts > 1:
            self.book.tell(messages.RestartedAgain(attempt=self._restarts))
        try:
            self.doses.settle(tries=3)
            if kind == "stalled":
                self._ended = "no more samples came"
                self.connection.post(f"/Experiment/0/{self.name}")
                yield OLD_CYCLE_S
            elif kind == "restarted":
                self.sampling.key = None  # the device's records begin anew, so any sample is new
                self.doses.acted = None
            yield from self.bring_up(waited=kind != "stopped")
            self.book.tell(messages.RestartedAfter(kind=kind))
        except ReactorError as error:
            self._again_s = self._clock.now() + AGAIN_S
            self.book.tell(messages.NotRestarted(kind=kind, error=error))
        finally:
            self.busy = False
            self.sampling.arrived_s = self._clock.now()  # delays a further recovery

    def poll(self) -> bool:
        """Read the reactor; return whether it has a new sample. An error becomes the logbook's fault."""
        self.sampling.next_look = self._clock.now() + RETRY_S
        try:
            if not self.restored:
                if not self.busy:
                    self.restore()
                    self.busy = True
                    self._agenda.add(self.take_over())
                return False
            state = self._keep_on(self.connection.read())
        except (LinkError, ProtocolError, DeviceStateError) as error:
            self.book.report(fault_of(error, present=self.connection.state is not None))
            self.sampling.not_taken(is_new=True)  # a sample may have appeared unseen
            return False
        return False if self.busy else self._judge(state)

    def _keep_on(self, state: DeviceState) -> DeviceState:
        return self.fluorescence.keep_on(self.overflow_pump.keep_on(state))

    def _judge(self, state: DeviceState) -> bool:
        now = self._clock.now()
        self.doses.watch(state, ours=not self.handed_over)
        self._unspoil(state)
        is_new = self.sampling.look(state, now)
        if is_new and now < self.doses.stray_s + FIRST_SAMPLE_S:  # measured before or after it: unknown
            self.sampling.key, self.sampling.arrived_s, is_new = (state.sample_s, state.cycles), now, False
        age = 0.0 if is_new else now - self.sampling.arrived_s
        fault = diagnose(
            state, self._config, age_s=age, start_time=self._past().start_time, blank=self._blank,
            setpoint=self.regulated_od, dosing=self.doses.running, stuck=self.doses.stuck,
            ended=self._why_ended(), overflow_trouble=self.overflow_pump.trouble,
        )  # fmt: skip
        self.book.report(fault)
        if state.running and not self.doses.running:
            self.doses.escalated, self._ended = False, ""  # a later stop is by somebody else
        if fault is not None and self._config.recover and now >= self._again_s and self._recoverable(fault.kind, age):
            self.busy = True
            self._agenda.add(self._recover(fault.kind))
        if is_new and (fault is None or fault.kind in ("mode", "pump", "overflow_pump")) and not self._held(now):
            self._take(state, now)
            return True
        self.sampling.not_taken(is_new)
        return False

    def _held(self, now: float) -> bool:
        """Whether a new sample must wait, because the volume of the last dose will soon be known."""
        if not self.doses.unsettled:
            self._held_s = math.nan
            return False
        self._held_s = now if math.isnan(self._held_s) else self._held_s
        return now - self._held_s < HELD_S

    def _recoverable(self, kind: str, age_s: float) -> bool:
        """Return whether this program repairs a fault; an experiment stopped by someone else stays stopped."""
        own_stop = kind == "stopped" and bool(self._why_ended()) and not self.doses.running
        return kind == "restarted" or own_stop or (kind == "stalled" and age_s > self._config.lost_s)

    def _why_ended(self) -> str:
        """Return why this program ended the experiment; "" if it did not, or if the experiment runs again."""
        return (self.doses.stuck or "its pumps could not be verified off") if self.doses.escalated else self._ended

    def _take(self, state: DeviceState, now: float) -> None:
        sampling, self._restarts = self.sampling, 0
        if note := sampling.take(state, now):
            self.book.tell(note)
        if self._config.fluorescence.measure:
            sampling.fluorescence = self.fluorescence.reading(state)
        light = {} if sampling.fluorescence is None else {"fluorescence": sampling.fluorescence}
        self.book.log(
            "sample", sample=sampling.key, od=sampling.od, temperature=sampling.temperature, raw=sampling.raw,
            blank=state.blank, late_s=sampling.late_s, read_s=self.connection.took_s, **light,
        )  # fmt: skip
        if sampling.late_s > 30.0 or self.doses.running:
            return  # the stirrer may be off for the next measurement already
        self._put_targets_right(state)

    def _put_targets_right(self, state: DeviceState) -> None:
        """Restore heating and stirring: a quick restart loses them silently, and a web page can change them."""
        connection, stir = self.connection, self._config.stir
        targets = (("Thermostat", state.temperature_target, self._target_c), ("Stir", state.stir_target, stir))
        for item, value, wanted in targets:
            if not abs(value - wanted) <= 1e-3:
                self._mend(f"set to {value:g}", f"set back to {wanted:g}", connection.target, item, wanted)
        for item, on, needed in (("Thermostat", state.heating, self._heat), ("Stir", state.stirring, stir > 0.0)):
            if needed and not on:
                self._mend("off", "switched on again", connection.switch, item, True)

    def _unspoil(self, state: DeviceState) -> None:
        """Replace a pump target of nan by 0 before the device uses it; report any nan that it has used."""
        for item in state.spoilt:
            if item in PUMPS and math.isnan(state.pump_targets[PUMPS.index(item)]):
                self._mend("set to nan by somebody", "set to 0", self.connection.target, item, 0.0)
            elif not self._spoilt:
                self.book.tell(messages.DumpWillFail(items=", ".join(state.spoilt)))
                self._spoilt = True
        self._spoilt = self._spoilt and bool(state.spoilt)

    def _mend(self, found: str, done: str, request: Callable[[str, Any], None], item: str, value: float) -> None:
        try:
            request(item, value)
            self.book.tell(messages.PutRight(item=item, found=found, done=done))
        except ReactorError as error:
            self.book.tell(messages.NotPutRight(item=item, found=found, done=done, error=error))

    def dose(self, rate: float, number: int) -> DosePlan:
        """Begin the dose for the newest sample, `rate` mL/s by pump `number`, unless none may be given now."""
        refusal: Message | None = self.book.fault
        pump = f"Pump{number}"
        if self.handed_over:
            refusal = messages.OnBoardRegulation()
        elif self.busy:
            refusal = refusal or messages.BeingStarted()
        elif refusal is None and pump not in (FEED, *self._config.supply.pumps):
            refusal = messages.NoTube(pump=pump, setting=f"{pump.lower()}_ml_s")
        return self.doses.begin(rate, self.sampling.key, self.sampling.appeared_s, refusal, pump)

    def pumps_off(self) -> None:
        """Switch all pumps but the overflow pump off, verified; this ends a dose. Raises: as `Connection.pumps_off`."""
        self.doses.settle()
        self.doses.drain()

    def give_up(self) -> None:
        """Switch all pumps and the on-board regulation off for the rest of the run, verified. Raises: ReactorError."""
        if self.handed_over:
            self.connection.switch("OD", False)
            self.book.log("regulate", setpoint=None)
            self.regulated_od = math.nan
            self.book.tell(messages.RegulationEnded())
        self.doses.settle()

    def regulate(self, setpoint: float) -> None:
        """Hand over to the on-board regulation (duty up to 0.02); write to the journal first. Raises: as `post`."""
        connection = self.connection
        connection.pumps_off(pumps=self._config.overflow_pump.others)
        self.book.log("regulate", setpoint=setpoint)
        connection.target("OD", setpoint)
        connection.switch("OD", True)
        state = connection.read()
        if not regulates(state, setpoint):
            raise messages.HandOverFailed(reactor=self.name, found=describe(state), setpoint=setpoint)
        self.regulated_od = setpoint

    def _hand_over_again(self) -> None:
        state, done = self.connection.read(), "unchanged"
        if not regulates(state, self.regulated_od):
            self.regulate(self.regulated_od)
            done = f"handed over again, because its {describe(state)}"
        self.book.tell(messages.StaysHandedOver(setpoint=self.regulated_od, done=done))

    def _take_control(self) -> None:
        self.connection.switch("OD", False)
        if not self.handed_over:
            self.book.tell(messages.RegulationFoundOn())

    def set_temperature(self, target_c: float) -> None:
        """Set the thermostat target, degC; nan leaves it unchanged. A failure becomes a note; the next call retries."""
        if math.isnan(target_c) or abs(target_c - self._target_c) < 1e-6:
            return
        try:
            self.connection.target("Thermostat", target_c)
        except ReactorError as error:
            self.book.tell(messages.TemperatureNotSet(target=target_c, error=error))
            return
        self._target_c = target_c
        self.book.log("temperature", temperature=target_c)

    def set_blank(self, raw: float) -> None:
        """Make `raw` counts read as OD 0, here and on the device. Raises: ReactorError, also outside 3000 to 60000."""
        self.connection.set_blank(raw)
        self._blank = raw

    def heat_off(self) -> None:
        """Switch thermostat and heater off for the rest of the run. Raises: ReactorError."""
        self._heat = False
        self.connection.switch("Thermostat", False)
        self.connection.switch("Heat", False)
