"""One unit: starting and keeping its jobs, its samples, its doses, its faults.

Messages and jobs have real time; samples have the run's device time. A longer action is a generator: it yields pauses,
real seconds, in which the other units continue.
"""

import math
from collections.abc import Iterator
from contextlib import suppress

from conf.messages import Message
from hardware.errors import ReactorError
from hardware.messages import Fault, UndosedFault
from hardware.pioreactor import messages
from hardware.pioreactor.doses import Doses, UnitHistory
from hardware.pioreactor.mailbox import ALT, AUTOMATIONS, MEDIA, NAMES, PUMPS, WASTE
from hardware.pioreactor.pumps import STEP_S, UNSTARTED_S, Pumps, Unit, boot_of
from hardware.pioreactor.sampling import UnitSampling
from hardware.pioreactor.versions import AUTOMATION, GONE, HEAT, OD, STIR, facts, regulates, request, target_of
from hardware.pioreactor.web import Barrier, Calls
from hardware.stations import Plan, Station

GRACE_S = 20.0  # time in which a requested job may start; pause between two attempts to start a unit
RESEND_S, RESENDS = 3.0, 6  # between two sends of the same target; sends before the job is restarted
SETTLED_S = 2.0  # time after which a turbidostat with wrong settings has ended
SILENT_S = 45.0  # time without a reading after which a reader counts as stopped
PUMPS_S = 10.0  # time to verify pumps off while a run continues
FRESH = 4.0  # a reader that runs delivers a reading within this many reading periods


class PioreactorStation(Station):
    """One unit of a cluster.

    Attributes: level_ml: volume to set in the unit's own ledger, nan if none. up: the unit was started.
    """

    def __init__(self, unit: Unit) -> None:
        self.unit, self.name, self.book, self._web = unit, unit.name, unit.book, unit.web
        self._config, self._mqtt, self._box = unit.config, unit.mqtt, unit.box
        self._clock, self._real = unit.clock, unit.real
        self._pumps = Pumps(unit)
        self.doses = Doses(self._pumps)
        self._answer = self._pumps.answer
        self.sampling = UnitSampling(unit.config, unit.bench.period_s, self._clock.now())
        self._target = self.level_ml = math.nan
        self.given_up = self.heat_is_off = self.up = self._listened = False
        self._calls, self._leads, self._astray = Calls(self._web, self._real), Calls(unit.leader, self._real), ""
        self._course: Iterator[float] | None = None
        self._gone, self._been, self._ended = set[str](), set[str](), set[str]()
        self._asked_s: dict[str, float] = {}
        self._listed = set[str]()
        self._target_sent_s, self._target_sends = math.inf, 0

    def bring_up(self, history: UnitHistory) -> Iterator[float]:
        """Read version and calibrations, adopt or start jobs, find an open dose's outcome. Raises: ReactorError."""
        self.regulated_od = history.handed_over
        self._pumps.facts = facts(str((yield from self._answer(self._web.get, "/versions/app")).get("version")))
        yield from self._pumps.calibrate()
        rows = yield from self._answer(self._web.running)
        self._pumps.boot, self._listed = boot_of(rows), {str(row["job_name"]) for row in rows}
        if history.boot not in ("", self._pumps.boot):  # a boot sets all pins to 0
            self._pumps.proven = dict.fromkeys(self._pumps.jobs, self._real.now())
        if AUTOMATION in self._listed and not self.handed_over:
            raise messages.AutomationRuns()
        self.doses.restore(history)
        barrier, deadline = Barrier(self._web, self._real), self._real.now() + GRACE_S
        while not (history.open or self.handed_over or barrier.passed()):
            if self._real.now() > deadline:
                raise messages.QueueStuck()
            yield STEP_S
        target = history.temperature if math.isfinite(history.temperature) else self._config.temperature
        self._target, self._target_sent_s = target if self._config.thermostat else math.nan, -math.inf
        for job in self._wanted():
            if not self._there(job):
                yield from self._start(job)
        p, url = self._pumps, self._web.url
        self.book.log("device", device_id=self.name, url=url, flows=p.flow_ml_s, boot=p.boot, run=self.unit.run)
        self.book.log("temperature", temperature=self._target)
        yield from () if history.open else self.hear_pins()
        self.up, self.sampling.arrived_s = True, self._clock.now()  # the wait for a sample begins

    def hear_pins(self) -> Iterator[float]:
        """Switch the stirring pin until the unit reports it, for at most a minute."""
        until_s, box = self._real.now() + UNSTARTED_S, self._box
        own = math.isinf(box.dc_s) and not box.live(STIR) and STIR not in self._asked_s
        with suppress(ReactorError):
            yield from self._start(STIR) if own else ()
            while math.isinf(box.dc_s) and self._real.now() < until_s:
                if self._calls.due("pins", RESEND_S):
                    self._pumps.ask_pins()
                yield STEP_S
            yield from self._end_job(STIR) if own else ()
        self._listened = True

    def postpone_start(self, error: ReactorError, history: UnitHistory) -> None:
        """Note that the unit could not be started; the run continues without it and tries again after a pause."""
        self.book.report(messages.NotBroughtUp(error=error))
        self._course = self._rise(history)

    def _rise(self, history: UnitHistory) -> Iterator[float]:
        again = self._real.now() + GRACE_S
        while self._real.now() < again:
            yield STEP_S
        try:
            yield from self.bring_up(history)
        except ReactorError as error:
            self.postpone_start(error, history)

    def _start(self, job: str) -> Iterator[float]:
        options, overrides = request(job, self._config, self._pumps.facts, self._target, self.regulated_od)
        yield from self._answer(self._web.run, job, options, overrides)
        self._asked_s[job] = self._real.now()
        self.book.log("command", job=job, options=options)

    def go_on(self) -> None:
        """Take the unit's reports; continue the dose and other tasks under way."""
        course = self._course
        if course is not None and next(course, None) is None and self._course is course:
            self._course = None
        if not self.up and WASTE not in self._pumps.barred:
            return
        readings, events, ignored = self._box.drain()
        for note in ignored:
            self.book.tell(note)
        self.sampling.take([r._replace(at=self._clock.of_real(r.at)) for r in readings])
        self.doses.take(events)
        self.doses.work()
        if not self.up:
            return
        if rows := self._calls.ask("rows", GRACE_S / 2.0, self._web.running):
            self._listed = {str(row["job_name"]) for row in rows[0]}
            if self._pumps.rebooted(rows[0]) and not self.doses.running:
                self._pumps.boot = boot_of(rows[0])
                self.book.log("device", device_id=self.name, url=self._web.url, boot=self._pumps.boot)
            for job in PUMPS:  # a restarted broker may repeat old retained messages
                old = self._box.live(job) and self._box.state(job).at < self._real.now() - GRACE_S
                if old and job not in self._listed and not self.doses.running:
                    self._box.take(f"pioreactor/{self.name}/{self._config.experiment}/{job}/$state", b"lost", False)
        if said := self._leads.ask("assigned", GRACE_S / 2.0, self.unit.leader.astray, self.name):
            self._astray = said[0]
        unsent = self._pumps.facts.ledger and not math.isnan(self.level_ml)
        if unsent and (said := self._calls.ask("level", RESEND_S, self._web.set_level, self.level_ml)):
            self.book.tell(messages.LedgerSet(level=said[0] or f"{self.level_ml:g} mL"))
            self.level_ml = math.nan
        if any(pin.doubt_s > -math.inf for pin in self._box.pins.values()) and self._calls.due("pins", RESEND_S):
            self._pumps.ask_pins()
        if math.isinf(self._box.dc_s):
            self._course = self._course or self.hear_pins()
        for job in self._wanted() if self._mqtt.connected else ():
            self._keep(job)
        self._steer()

    def poll(self) -> bool:
        """Process reports and tasks; return whether there is a new sample, which the caller must act on."""
        self.go_on()
        if not self.up:
            return False
        undisturbed_s = self._clock.of_real(self.doses.ended_s) + self._config.mix_s
        dosing = self.doses.running and not self._pumps.waits  # an unknown dose may last hours
        is_new, s = not dosing and self.sampling.look(self._clock.now(), undisturbed_s), self.sampling
        s.temperature = c = self._box.temperature
        self.book.report(self._wrong())
        if is_new:
            t = self.book.elapsed() - self._clock.now() + s.at
            self.book.log("sample", sample_s=round(t, 3), od=s.od, spread=s.spread, readings=s.number, temperature=c)
        return is_new

    def _wrong(self) -> Fault | None:
        if not self._mqtt.connected:
            return messages.NoBroker(broker=self._config.broker, why=self._mqtt.lost or "nothing comes")
        if found := self._pumps.trouble or self._mqtt.holder(self.name):
            return found
        theirs = [job for job in AUTOMATIONS if self._box.live(job)]
        if self._astray:
            return messages.Astray(why=self._astray, experiment=self._config.experiment)
        if theirs and not (self.handed_over and theirs == [AUTOMATION]):
            return messages.VendorDoses(job=theirs[0])
        if self.doses.foreign and not self.handed_over:
            return self.doses.foreign
        if job := next((job for job in self._wanted() if job in self._gone), ""):
            twice = job in self._ended and self._real.now() > self._asked_s.get(job, -math.inf) + GRACE_S
            again = "the job ended twice, start it in the vendor's page" if twice else "the program requests it again"
            if job == OD and (said := self._box.complaint):
                return messages.ReaderComplains(log=said)
            if self._real.now() > self._box.heard_s + SILENT_S:
                return messages.UnitSilent(gone=GONE[job], again=again)
            forget = self._pumps.facts.forget
            command = f"{forget} --job-name {job}, else reboot it" if forget else "reboot it"
            return messages.JobGone(gone=GONE[job], again=again, command=command)
        if self._listened and math.isinf(self._box.dc_s):
            return messages.PinsUntold()
        since_s, why = self._calls.failed.get("rows", (math.inf, ""))
        if self._real.now() > since_s + GRACE_S:
            return messages.WebServerSilent(why=why)
        return messages.DoseNotTaken(why=self.doses.refused[-1]) if self.doses.refused[1:] else None

    def _wanted(self) -> list[str]:
        heated = self._config.thermostat and not self.heat_is_off and math.isfinite(self._target)
        wanted = {OD: True, STIR: self._config.stirring, HEAT: heated, AUTOMATION: self.handed_over}
        return [job for job, it_is in wanted.items() if it_is]

    def _there(self, job: str) -> bool:
        """Return whether a job runs: from its readings, from its reported state, else from the unit's list of jobs."""
        longest_s = self._clock.of_real(FRESH * self._config.reading_s)
        if job == OD and (self.sampling.count or self.up):
            silent_s = self._clock.now() - self.sampling.read_s
            if silent_s < longest_s or silent_s > self._clock.of_real(SILENT_S):
                return silent_s < longest_s
        return self._box.live(job) if self._box.state(job).at > -math.inf else job in self._listed

    def _keep(self, job: str) -> None:
        """Request a job again if it should run and does not; only once if the job reported its own end."""
        if self._there(job):
            self._gone.discard(job)
            self._been.add(job)
        elif self._real.now() > self._asked_s.get(job, -math.inf) + GRACE_S:
            self._gone.add(job)
            ended = job != OD and self._box.state(job).word == "disconnected" and job in self._been and not self._astray
            if self._course is None and not (ended and job in self._ended):
                self._asked_s[job], self._course = self._real.now(), self._again(job)
                self._ended |= {job} if ended else set()

    def _again(self, job: str) -> Iterator[float]:
        """Start a job; if it runs but does nothing, end it first."""
        with suppress(ReactorError):
            yield from self._answer(self._web.stop, job) if self._box.live(job) else self._start(job)

    def dose(self, rate: float, pump: int) -> Plan:
        """Begin the dose for the newest sample. Raises: ValueError; what the journal raises."""
        fault = self.book.fault
        refusal: Message | None = None if isinstance(fault, UndosedFault) else fault
        if self.given_up:
            refusal = messages.GivenUp()
        elif self.handed_over:
            refusal = messages.RegulatesItself()
        elif refusal is None and self._clock.now() - self.sampling.at > self.unit.bench.stale_s:
            refusal = messages.SampleStale()
        elif refusal is None and math.isinf(self._box.dc_s):
            refusal = messages.PinsUntold()
        key = (round(self.sampling.at, 3), self.sampling.count) if self.sampling.count else None
        plan = self.doses.begin(rate, key, refusal, pump)
        self.doses.foreign = None
        return plan

    def set_temperature(self, target: float) -> None:
        if not math.isfinite(target) or not self._config.thermostat or self.heat_is_off or target == self._target:
            return
        self._target, self._target_sent_s, self._target_sends = target, -math.inf, 0
        self.book.log("temperature", temperature=target)

    def _steer(self) -> None:
        """Send the target until the thermostat reports it; restart a thermostat that does not respond."""
        if not self._target_sent_s < math.inf or not self._there(HEAT) or self.heat_is_off:
            return
        if self._box.target == self._target:
            self._target_sent_s, self._target_sends = math.inf, 0
        elif self._real.now() > self._target_sent_s + RESEND_S:
            self._target_sent_s, self._target_sends = self._real.now(), self._target_sends + 1
            self.unit.say(f"{HEAT}/target_temperature/set", str(self._target))
        if self._target_sends > RESENDS and self._calls.ask("deaf", GRACE_S, self._web.stop, HEAT):
            self._target_sends = 0
            self._listed.discard(HEAT)

    def pumps_off(self, real_s: float = PUMPS_S, final: bool = False) -> Iterator[float]:
        """Switch every pump off, verified. A dose ends; its waste still runs unless final. Raises: DeviceStateError."""
        deadline, pumps, box = self._real.now() + real_s, self._pumps, self._box
        pumps.barred = PUMPS if final else (MEDIA, ALT)
        try:
            while (
                not self._mqtt.connected or self.doses.running or box.on()
                or any(box.live(job) or pumps.odd(job) for job in pumps.jobs)
            ):  # fmt: skip
                if self._real.now() > deadline or (pumps.trouble and not final):
                    heard = box.heard_s > self._real.now() - PUMPS_S
                    on = [job for job in PUMPS if heard and pumps.told_on(job)]
                    why = (pumps.trouble or "look at the unit's log") if self._mqtt.connected else "no broker to ask"
                    if on:
                        raise messages.UnitPumpOn(unit=self.name, pump=NAMES[on[0]], pin=box.jobs[on[0]], why=why)
                    off = "look at its pumps, pull the plug of one that runs" if final else "still being verified"
                    raise messages.UnitPumpsUnproven(unit=self.name, why=why, off=off)
                self.go_on()
                yield STEP_S
        finally:
            pumps.barred = PUMPS if final else ()

    def give_up(self) -> Iterator[float]:
        """End all dosing for the rest of the run, also by the vendor's turbidostat. Raises: as `pumps_off`."""
        self.given_up, self.regulated_od = True, math.nan
        if self._there(AUTOMATION):
            yield from self._end_job(AUTOMATION)
        yield from self.pumps_off(self._config.stop_s, final=True)

    def heat_off(self) -> Iterator[float]:
        """End the thermostat for the rest of the run. Raises: DeviceStateError."""
        self.heat_is_off = True
        yield from self._end_job(HEAT)

    def _end_job(self, job: str) -> Iterator[float]:
        """End one of the vendor's jobs by MQTT and HTTP. Raises: DeviceStateError if the job still runs after 8 s."""
        deadline = self._real.now() + 8.0
        while self._box.live(job):
            if self._real.now() > deadline:
                raise messages.JobDoesNotEnd(job=job, unit=self.name)
            if self._calls.due(f"end {job}", 1.0):
                self.unit.say(f"{job}/$state/set", "disconnected")
            self._calls.ask(f"stop {job}", 4.0, self._web.stop, job)
            yield STEP_S

    def regulate(self, setpoint: float) -> Iterator[float]:
        """Hand the vial over to the vendor's turbidostat; done when its settings are right. Raises: ReactorError."""
        yield from self.pumps_off(self._config.stop_s)
        self.regulated_od, asked = setpoint, target_of(self._config, self._pumps.facts, setpoint)
        try:
            yield from self._start(AUTOMATION)
            deadline, ready_s, settings = self._real.now() + GRACE_S, math.inf, None
            while not (self._real.now() > ready_s + SETTLED_S and regulates(settings, asked)):
                if self._real.now() > deadline:
                    raise messages.DoesNotRegulate()
                ready = self._box.state(AUTOMATION).word == "ready"
                ready_s = min(ready_s, self._real.now()) if ready else math.inf
                if said := self._calls.ask("settings", 0.5, self._web.get, f"/jobs/settings/job_name/{AUTOMATION}"):
                    settings = said[0]
                yield STEP_S
        except ReactorError:
            self.regulated_od = math.nan
            raise
        self.book.write("regulate", setpoint=setpoint)
