"""One unit: its jobs brought up and kept, its samples, its doses, what is wrong with it."""

import math
from collections.abc import Callable

from hardware.clock import Clock
from hardware.errors import DeviceStateError, LinkError, ReactorError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.doses import Doses, Plan
from hardware.pioreactor.jobs import AUTOMATION, HEAT, OD, STIR, flow, gone, request
from hardware.pioreactor.logbook import Log, Logbook
from hardware.pioreactor.mailbox import Mailbox, Mqtt
from hardware.pioreactor.pump_jobs import MEDIA, WASTE
from hardware.pioreactor.resume import History
from hardware.pioreactor.sampling import Sampling
from hardware.pioreactor.web import Web
from hardware.reactor import Fault

__all__ = ["Station"]

GRACE_S = 20.0  # real seconds in which a job that was asked for may come up
TELL_S = 3.0  # real seconds between two words on the same target
WEB_STOP_S = 5.0  # real seconds between two stops by HTTP


class Station:
    """One unit of a cluster. Args: as of `PioreactorReactors`; run: part of every dose's id."""

    def __init__(
        self, unit: str, config: PioreactorConfig, mqtt: Mqtt, box: Mailbox, clock: Clock, log: Log,
        elapsed: Callable[[], float], run: str,
    ) -> None:  # fmt: skip
        self.name, self._config, self._mqtt, self._box, self._clock = unit, config, mqtt, box, clock
        self.web = Web(config.address(unit))
        self.book = Logbook(unit, config.experiment, log, elapsed)
        self.doses = Doses(unit, self.web, mqtt, box, config, clock, self.book, run)
        self.sampling = Sampling(config, clock.now())
        self.handed_over = math.nan
        self.given_up, self.heat_is_off, self.news = False, False, False
        self.fault: Fault | None = None
        self._target = math.nan
        self._asked_s: dict[str, float] = {}
        self._gone, self._been = set[str](), set[str]()
        self._asked_web_s, self._told_s = -math.inf, math.inf
        self._tried = False
        self._web_error = ""

    # -- bringing up -----------------------------------------------------------------------------------------------

    def bring_up(self, history: History) -> None:
        """Pumps off, calibrations read, jobs adopted or started, an open dose of an earlier life looked for.

        Raises: ReactorError for what no waiting can mend.
        """
        self.handed_over = history.handed_over
        calibrations = self.web.get("/active_calibrations")
        for job, pump in ((MEDIA, "media_pump"), (WASTE, "waste_pump")):
            self.doses.flow_ml_s[job] = flow(calibrations, pump, self.name)
        if self._box.live(AUTOMATION) and math.isnan(self.handed_over):
            raise DeviceStateError(f"{self.name}: {self._automation()}")
        self.doses.restore(history)
        if not history.open and math.isnan(self.handed_over):
            self._flush()
        self.ask_for(OD)
        if self._config.stirring:
            self.ask_for(STIR)
        target = history.temperature if math.isfinite(history.temperature) else self._config.temperature
        if self._config.thermostat:
            self.set_temperature(target)
        self.book.note_down("device", device_id=self.name, url=self.web.url, flows=self.doses.flow_ml_s)

    def _topic(self, job: str, setting: str) -> str:
        return f"pioreactor/{self.name}/{self._config.experiment}/{job}/{setting}/set"

    def _flush(self) -> None:
        """Prove that the task queue takes what is written down, and that nothing older waits in it.

        Raises: LinkError if it does not.
        """
        task, deadline = self.web.run(MEDIA, {"help": None}, self.book.env, []), self._now_in(GRACE_S)
        while self.web.result(task) is None:
            if self._clock.now() > deadline:
                raise LinkError(
                    f"{self.name}: the task queue takes nothing, so a dose would run at any later time; on the unit: "
                    "sudo systemctl restart huey"
                )
            self._clock.sleep(0.2 * self._config.speed)

    def _now_in(self, real_s: float) -> float:
        return self._clock.now() + real_s * self._config.speed

    def ask_for(self, job: str) -> None:
        """Start one of the vendor's jobs unless it is there. Raises: ReactorError."""
        if self._box.live(job):
            return
        options, overrides = request(job, self._config, self._target, self.handed_over)
        if self._box.lost(job):  # the vendor still counts a killed job as running, and would refuse another
            self.web.post(f"/jobs/stop?job_name={job}")
        self.web.run(job, options, self.book.env, overrides)
        self._asked_s[job] = self._clock.now()
        self.book.note_down("command", job=job, options=options)

    # -- what happens ----------------------------------------------------------------------------------------------

    def go_on(self) -> None:
        """Take in what the unit said, and go on with a dose."""
        readings, events = self._box.drain()
        self.sampling.take(readings)
        self.doses.take(events)
        self.doses.work()
        self._steer()

    def poll(self) -> bool:
        """Go on; whether there is a new sample, which whoever asked has to act on."""
        self.go_on()
        undisturbed_s = self.doses.ended_s + self._config.mix_s * (self.doses.ended_s > 0.0)
        dosing = self.doses.running and not self.doses.at_rest  # a dose in doubt may take hours to be known
        found = self.sampling.look(self._clock.now(), undisturbed_s, dosing)
        self._judge()
        if found is None:
            return False
        age = self._clock.now() - found.at
        self.book.note_down(
            "sample", sample_s=round(self.book.elapsed() - age, 3), od=found.od, spread=found.spread,
            readings=found.number, temperature=self._box.temperature,
        )  # fmt: skip
        return True

    @property
    def temperature(self) -> float:
        """Of the culture, degC, nan while none was told."""
        return self._box.temperature

    @property
    def key(self) -> tuple[float, int] | None:
        """Of the newest sample, None before the first."""
        return (round(self.sampling.newest.at, 3), self.sampling.count) if self.sampling.count else None

    def _judge(self) -> None:
        """What is wrong now."""
        fault = self._wrong()
        if (fault and fault.kind) != (self.fault and self.fault.kind):
            self.news = True
            self.book.note_down("fault", fault=str(fault) if fault else "none")
        self.fault = fault

    def _wrong(self) -> Fault | None:
        if not self._mqtt.connected:
            return Fault("link", "no MQTT broker", "the leader is off or its network is; doses wait")
        if self.doses.trouble:
            return Fault("pump", self.doses.trouble, "nothing is dosed until that is known")
        if other := self._mqtt.holder(self.name):
            who, _, done = other.partition("; ")
            return Fault("mode", who, done)
        if self._box.live(AUTOMATION) and math.isnan(self.handed_over):
            return Fault("mode", "a dosing automation runs", "stop it in the vendor's page")
        if not self.doses.running and self._box.running_pins(self._config.pump_pins) and math.isnan(self.handed_over):
            return Fault("pump", "a pump runs without our command", self.doses.locks)
        if self.doses.foreign and math.isnan(self.handed_over):
            return Fault("mode", self.doses.foreign, "one client per unit; it is counted")
        if missing := [job for job in self._wanted() if self._is_gone(job)]:
            remedy = "asked for again; one that was killed bars its successor: reboot the unit"
            return Fault("stopped", gone(missing[0]), remedy)
        if self._web_error:
            return Fault("link", self._web_error, "check the unit's web server")
        return None

    def _wanted(self) -> list[str]:
        """The jobs that this run keeps going."""
        heated = self._config.thermostat and not self.heat_is_off and math.isfinite(self._target)
        wanted = {OD: True, STIR: self._config.stirring, HEAT: heated, AUTOMATION: math.isfinite(self.handed_over)}
        return [job for job, it_is in wanted.items() if it_is]

    def _is_gone(self, job: str) -> bool:
        """Whether a job should run and does not: readings stopped in whatever way; others killed, or never there.

        It is asked for again, and again; until it is there it is gone. What somebody stopped in the vendor's page stays
        stopped.
        """
        if self._box.live(job):
            self._gone.discard(job)
            self._been.add(job)
            return False
        due = self._asked_s.get(job, -math.inf) + GRACE_S * self._config.speed
        if (job == OD or job not in self._been or self._box.lost(job)) and self._clock.now() > due:
            self._gone.add(job)
            self._again(job)
        return job in self._gone

    def _again(self, job: str) -> None:
        try:
            self.ask_for(job)
            self._web_error = ""
        except ReactorError as error:
            self._web_error, self._asked_s[job] = str(error), self._clock.now()

    @staticmethod
    def _automation() -> str:
        return "a dosing automation of the vendor's runs, which would dose beside us; stop it in the vendor's page"

    # -- commands --------------------------------------------------------------------------------------------------

    def dose(self, rate: float) -> Plan:
        """Begin the dose for the newest sample. Raises: ValueError; what the journal raises."""
        refusal = ""
        if self.given_up:
            refusal = "the unit was given up"
        elif math.isfinite(self.handed_over):
            refusal = "the unit regulates itself"
        elif self.fault is not None:
            refusal = str(self.fault)
        elif self._clock.now() - self.sampling.newest.at > self._config.stale_s:
            refusal = "its sample is stale"
        plan = self.doses.begin(rate, self.key, refusal)
        self.doses.foreign = ""
        return plan

    def set_temperature(self, target: float) -> None:
        """Thermostat to a target, degC; nan leaves it. Trouble becomes a note."""
        if not math.isfinite(target) or not self._config.thermostat or self.heat_is_off or target == self._target:
            return
        self._target, self._told_s = target, -math.inf
        self.book.note_down("temperature", temperature=target)
        try:
            self.ask_for(HEAT)
        except ReactorError as error:
            self._target = math.nan
            self.book.tell(f"thermostat: {error}")

    def _steer(self) -> None:
        """Tell the thermostat its target until it says it: what is told while it starts is not heard."""
        if not self._told_s < math.inf or not self._box.live(HEAT):
            return
        if self._box.target == self._target:
            self._told_s = math.inf
        elif self._clock.now() > self._told_s + TELL_S * self._config.speed:
            self._told_s = self._clock.now()
            self._mqtt.publish(self._topic(HEAT, "target_temperature"), str(self._target))

    def pumps_off(self, real_s: float) -> None:
        """Every dosing job ended and every pump off, by MQTT first, then by HTTP, verified.

        A dose under way is stopped and followed to its end. Raises: DeviceStateError, LinkError.
        """
        deadline, self.doses.stopped_s = self._now_in(real_s), self._clock.now()
        while True:
            self.go_on()
            if self._mqtt.connected and self.doses.off() and (self.doses.at_rest or not self.doses.running):
                break
            if self._clock.now() > deadline:
                raise DeviceStateError(self._still_on())
            if not self.doses.off() or not self._mqtt.connected:
                self._stop()
            self._clock.sleep(0.3 * self._config.speed)

    def _stop(self) -> None:
        """By MQTT every time; by HTTP, which costs the unit two processes, seldom."""
        self.doses.cycle_pins()
        if not self.doses.stop_jobs() and not self._tried:
            self._tried, self._asked_web_s = True, self._clock.now()  # MQTT first
        elif self._clock.now() > self._asked_web_s + WEB_STOP_S * self._config.speed:
            self._asked_web_s = self._clock.now()
            try:
                self.doses.stop_by_web()
            except ReactorError as error:
                self.book.tell(f"stop: {error}")

    def _still_on(self) -> str:
        pins = self._box.running_pins(self._config.pump_pins)
        seen = f"pin {pins[0]} on" if pins else ("not verified off" if self._mqtt.connected else "no broker to ask")
        return f"pumps of {self.name}: {seen}; pull the plug of its pumps. {self.doses.locks}"

    def give_up(self) -> None:
        """No dose in this run any more, by us or by the vendor's turbidostat. Raises: as `pumps_off`."""
        self.given_up, self.handed_over = True, math.nan
        if self._box.live(AUTOMATION):
            self._mqtt.publish(
                f"pioreactor/{self.name}/{self._config.experiment}/{AUTOMATION}/$state/set", "disconnected"
            )
        self.pumps_off(3.0)

    def heat_off(self) -> None:
        """Thermostat ended for the rest of the run. Raises: DeviceStateError."""
        self.heat_is_off = True
        self._mqtt.publish(self._topic(HEAT, "$state"), "disconnected")
        deadline = self._now_in(5.0)
        while self._box.live(HEAT):
            if self._clock.now() > deadline:
                raise DeviceStateError("the thermostat does not end; stop it in the vendor's page")
            self._clock.sleep(0.2 * self._config.speed)

    def regulate(self, setpoint: float) -> None:
        """Hand over to the vendor's turbidostat for good. Raises: ReactorError if it does not come up."""
        self.pumps_off(self._config.stop_s)
        self.handed_over = setpoint
        try:
            self.ask_for(AUTOMATION)
            deadline = self._now_in(GRACE_S)
            while not self._box.live(AUTOMATION):
                if self._clock.now() > deadline:
                    raise DeviceStateError("the vendor's turbidostat does not start; look at its log")
                self._clock.sleep(0.2 * self._config.speed)
        except ReactorError:
            self.handed_over = math.nan
            raise
        self.book.write("regulate", setpoint=setpoint)
