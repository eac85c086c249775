"""The pump jobs of one unit: each is requested once, followed to its end, and stopped if it does not end.

The vendor's reply 202 means only that the request was stored. A job has begun when an event with its id arrives or its
pin goes on. It has ended when it has reported its end and its pin is off. In all other cases `Pumps.end` stops the
pump. Times here are real seconds.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Generator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from conf.messages import Message
from envs.bench import Bench
from hardware.clock import Clock, DeviceClock
from hardware.errors import ReactorError
from hardware.logbook import Logbook
from hardware.messages import Fault
from hardware.pioreactor import messages
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import AUTOMATIONS, MEDIA, NAMES, PUMPS, WASTE, Cluster, Mailbox
from hardware.pioreactor.messages import NotHeard
from hardware.pioreactor.versions import Facts, flow
from hardware.pioreactor.web import PROBE_S, Barrier, Calls, Web

T = TypeVar("T")

OURS = "turbidostat/"
STEP_S = 0.1
SETTLE_S = 1.5  # longest delay of a report; the events of a dose are 0.5 s apart
OVERRUN_S = 3.0  # time beyond its dose after which a job is stopped
UNSTARTED_S = 60.0  # longest time of a process from the queue to its first report, on a busy unit
QUIET_S = 10.0  # a live unit reports more often, because it reads OD
LATE_ML = 0.1  # tolerance of volumes, because messages are late by some hundredths of a second
ROUNDED_S = 0.5  # a job reports its dose in parts of this length, each before it is pumped
PAST_S = 0.5  # time beyond its dose after which a media pump that is reported on is drained
PROOF_S = 20.0  # with a broker, time for the proof that a pump is off; then a user must look
NUDGE = 0.01  # change of the stirring duty, %, too small to matter
SHORT_S, SHORTS = 0.1, 3  # duration of a short run, which ends with the pin off; most short runs
AGAIN_S = 15.0  # between two short runs
UNTOLD = 2  # most runs in a row without a report of the pin

Steps = Generator[float, None, T]
"""A generator that yields pauses, s, and returns T."""


@dataclass(frozen=True)
class Unit:
    """One unit with its connections.

    name: name in the vendor's page. config: config of this unit. bench: period, bottle. volume_ml: of its culture, mL.
    web, leader, mqtt, box: connections to the unit and its leader. clock: clock of the run, whose `real` is the clock
    of messages and jobs. book: the unit's logbook. run: id of this run, part of every dose's id.
    """

    name: str
    config: PioreactorConfig
    bench: Bench
    volume_ml: float
    web: Web
    leader: Web
    mqtt: Cluster
    box: Mailbox
    clock: DeviceClock
    book: Logbook
    run: str

    @property
    def real(self) -> Clock:
        return self.clock.real

    def say(self, topic: str, payload: str) -> None:
        """Publish a message to the unit in this run's experiment."""
        self.mqtt.publish(f"pioreactor/{self.name}/{self.config.experiment}/{topic}", payload)


class Moved(NamedTuple):
    """Smallest and largest volume that a pump moved, mL. end: a note if it is not as requested, else None."""

    low: float = 0.0
    high: float = 0.0
    end: Message | None = None


class Request(NamedTuple):
    """A requested run of a pump, or one that was found (ml 0). asked_s: its time. ran_s: total time of the pin then."""

    job: str
    ml: float
    dose: str
    asked_s: float
    ran_s: float
    task: str = ""


def boot_of(rows: list[dict[str, Any]]) -> str:
    """Return when a unit was started, from its list of running jobs; "" if the list does not have it."""
    return next((str(row.get("started_at", "")) for row in rows if row["job_name"] == "monitor"), "")


class Pumps:
    """The pumps of one unit.

    Attributes: jobs: pump jobs that this run uses. ours: prefix of every id of this run. short: id of short runs, which
      only switch a pin off. flow_ml_s: by job, from the active calibrations. reported: mL by job and source of events.
      counted: mL by job and source that are booked with a dose, inf while it is under way. facts: facts on the unit's
      version. boot: when the unit was started. proven: times at which `end` proved pumps off. trouble: fault against
      any dose, or None. barred: jobs that must end. waits: the current dose waits for unit or user. flowed_ml:
      largest volume so far of a media pump that is not proven off. runs_on: this pump must be drained.
    """

    def __init__(self, unit: Unit) -> None:
        self.unit, self.web, self.mqtt, self.box = unit, unit.web, unit.mqtt, unit.box
        self.config, self.clock, self.book, self.pins = unit.config, unit.real, unit.book, unit.box.pins
        self.jobs = PUMPS if unit.config.alt_media else (MEDIA, WASTE)
        self.flow_ml_s = dict.fromkeys(self.jobs, 1.0)  # until the calibrations are read
        self.reported = defaultdict[tuple[str, str], float](float)
        self.counted = defaultdict[tuple[str, str], float](float)
        self.facts, self.boot = Facts(), ""
        self.trouble: Fault | None = None
        self.barred, self.waits = tuple[str, ...](), False
        self.flowed_ml, self.runs_on, self._untold = 0.0, False, 0
        self.proven: dict[str, float] = {}
        self._calls = Calls(self.web, self.clock)
        self.ours = f"{OURS}{unit.run}/"
        self.short = f"{self.ours}{unit.name}/off"

    def odd(self, job: str) -> bool:
        """Return whether a pump must be ended: it runs without a job, or its job was lost and it is not proven off."""
        pin, state, now = self.pins[job], self.box.state(job), self.clock.now()
        settled = now > max(pin.on_s, pin.ended_s) + SETTLE_S
        new = state.at > self.proven.get(job, -math.inf) or job not in self.proven
        return (pin.on and settled and not self.box.live(job, *AUTOMATIONS)) or (state.word == "lost" and new)

    def rebooted(self, rows: list[dict[str, Any]]) -> bool:
        return boot_of(rows) not in ("", self.boot)

    def told_on(self, job: str) -> bool:
        """Return whether the unit has reported a pump on since the broker connected, except for a short run."""
        pin, broke_s, before_s = self.pins[job], self.mqtt.broke_s, self.clock.now() - SETTLE_S
        return pin.on and pin.on_s < before_s and (broke_s <= pin.on_s or broke_s < self.box.dc_s < before_s)

    def ask_pins(self) -> None:
        """Make stirring report all pins: change its duty slightly, because newer versions report only changes."""
        if not math.isnan(duty := self.box.stir_duty):
            self.unit.say("stirring/duty_cycle/set", f"{duty + NUDGE * (-1) ** round(duty / NUDGE):g}")

    def said(self, request: Request) -> float:
        return self.reported[request.job, request.dose]

    def answer(self, what: Callable[..., T], *given: Any) -> Steps[T]:
        """Wait for the answer to a request, in steps. Raises: as the request."""
        future = self.web.ask(what, *given)
        while not future.done():
            yield STEP_S
        return future.result()

    def calibrate(self) -> Steps[None]:
        """Read the flow of each pump from its active calibration. Raises: ReactorError."""
        said = yield from self.answer(self.web.get, "/active_calibrations")
        self.flow_ml_s = {job: flow(said, f"{NAMES[job]}_pump") for job in self.jobs}

    def give(self, job: str, ml: float, dose: str) -> Steps[Moved]:
        """Request one pump job, once, and follow it; return the volume that it gave."""
        try:
            yield from self.calibrate()
            if not self.mqtt.connected:
                raise messages.NobodyFollows()
        except ReactorError as error:
            return Moved(end=messages.NotGiven(error=error))
        request = Request(job, round(ml, 4), dose, self.clock.now(), self.pins[job].ran_s)
        self.counted[job, dose] = math.inf
        try:
            task = yield from self.answer(self.web.run, job, {"ml": request.ml, "source-of-event": dose})
            request = request._replace(task=task)
            self.book.log("task", id=dose, job=job, task=request.task)
        except NotHeard as error:
            self.counted[job, dose] = 0.0
            return Moved(end=messages.NotGiven(error=error))
        except ReactorError as error:
            self.book.tell(messages.PerhapsHeard(job=job, error=error))
        moved = yield from self.follow(request)
        self.counted[job, dose] = moved.low if job == WASTE else moved.high
        return moved

    def follow(self, request: Request) -> Steps[Moved]:
        """Follow a job to its end; return the volume that it gave."""
        job = request.job
        if why := (yield from self._begins(request)):
            return Moved(0.0, request.ml if self.broke(request) else 0.0, why)
        late = self.clock.now() + request.ml / self.flow_ml_s[job] + OVERRUN_S
        while not self._is_over(request):
            if job in self.barred or self.odd(job) or self.broke(request) or self.clock.now() > late:
                return (yield from self.end(request))
            if job != WASTE and (gave_ml := self._beyond(request)):
                self.flowed_ml, self.runs_on = gave_ml, True
            yield STEP_S
        self.runs_on = False
        self._untold = 0 if self.pins[job].on_s >= request.asked_s else self._untold + 1
        if self._untold > UNTOLD:
            self.box.dc_s = -math.inf  # until the unit reports its pins again
        return self._moved(request)

    def _beyond(self, request: Request) -> float:
        """Return the volume of a pump that is on past the end of its dose, mL; 0 if it is not, or without reports."""
        pin, flow, now = self.pins[request.job], self.flow_ml_s[request.job], self.clock.now()
        on_s = max(pin.on_s, request.asked_s)
        end_s = on_s + request.ml / flow
        if not pin.on or now < end_s + PAST_S:
            return 0.0
        if self._calls.due("pins", 1.0):
            self.ask_pins()
        return (now - on_s) * flow if self.box.heard_s > end_s else 0.0

    def broke(self, request: Request) -> bool:
        """Return whether the connection to the broker was lost after the request."""
        return self.mqtt.broke_s >= request.asked_s

    def _begins(self, request: Request) -> Steps[Message | None]:
        """Wait until the pump of a request begins (return None) or certainly never will (return the reason)."""
        job, asked_s = request.job, request.asked_s
        calls, barrier = Calls(self.web, self.clock), Barrier(self.web, self.clock, PROBE_S * bool(request.task))
        why: Message | None = None
        never_s, late = math.inf, False  # time after which it cannot begin; whether it should have begun
        fate = messages.FateUnknown(ml=request.ml, job=job)
        while not (
            why or self.said(request) > 0.0 or self.pins[job].on or self.pins[job].on_s >= asked_s
            or (self.box.state(job).word == "lost" and self.box.state(job).at >= asked_s)
        ):  # fmt: skip
            now, state, taken = self.clock.now(), self.box.state(job), None
            if now > asked_s + self.config.start_s and not (late or self.box.live(job)):
                late = True
                self.trouble = self.trouble or fate
                self.book.tell(fate)
            self.waits = self.waits or late
            if request.task and (answer := calls.ask("task", 0.5, self.web.result, request.task)):
                taken = answer[0]
            if late and taken is None and math.isinf(never_s) and barrier.passed():
                taken = True
            if taken is not None:
                never_s = min(never_s, now + (UNSTARTED_S if taken else SETTLE_S))
            if state.word == "disconnected" and state.at >= asked_s:
                never_s = min(never_s, state.at + SETTLE_S)
            if now > never_s and not self.box.live(job):
                why = messages.NotCarriedOut(purge=self.facts.purge, pin=self.box.jobs[job])
            if late and (rows := calls.ask("rows", 5.0, self.web.running)) and self.rebooted(rows[0]):
                why = messages.ForgottenByRestart()
            if job in self.barred and calls.due("stop", 1.0):  # works once the job listens
                self.unit.say(f"{job}/$state/set", "disconnected")
            yield STEP_S
        if late:
            self.trouble, self.waits = None if self.trouble is fate else self.trouble, False
            if not why:
                self.book.tell(messages.RanLate(job=job, ml=request.ml))
        return why

    def last_word(self, request: Request) -> str:
        """Return the last state that the job reported; "" if unknown: two processes, or the connection was lost."""
        pin, state = self.pins[request.job], self.box.state(request.job)
        alone = sum(at >= request.asked_s for at in pin.inits) <= 1 and not self.broke(request)
        return state.word if request.ml > 0.0 and alone and state.at >= request.asked_s else ""

    def _is_over(self, request: Request) -> bool:
        """Return whether a job reported its end, its pin is off, and its last event has come or will not come."""
        state, pin, asked_s = self.box.state(request.job), self.pins[request.job], request.asked_s
        told = pin.on_s >= asked_s and state.word == "disconnected" and state.at >= asked_s  # of any process
        ended = (told or self.last_word(request) == "disconnected") and not pin.on
        return ended and (self.said(request) >= request.ml - 1e-6 or self.clock.now() > state.at + SETTLE_S)

    def _moved(self, request: Request) -> Moved:
        """Return the volume of a job that ended normally, from its events and its pin's time on."""
        flow, ml, said_ml = self.flow_ml_s[request.job], request.ml, self.said(request)
        end: Message | None = None
        low = high = said_ml
        ran_ml = (self.pins[request.job].ran_s - request.ran_s) * flow
        if said_ml < ml - 1e-6:  # a stop by HTTP reports up to 0.5 s too much; an event may be missing
            slack = LATE_ML if ran_ml > 0.0 else ROUNDED_S * flow
            low, high = max(min(said_ml, ran_ml or said_ml) - slack, 0.0), min(max(said_ml, ran_ml) + slack, ml)
            end = messages.ToldLess(told_ml=said_ml, ml=ml)
        if ran_ml > high + LATE_ML:
            end = end or messages.RanLonger(ran_ml=ran_ml, told_ml=said_ml)
        return Moved(low, max(high, round(ran_ml, 4)), end)  # on a busy unit a job ends late

    def end(self, request: Request) -> Steps[Moved]:
        """Stop a pump that has begun, or may have; once it is proven off, return the volume that it moved."""
        job, ending, pin = request.job, ForcedEnd(self, request), self.pins[request.job]
        while math.isnan(off_s := ending.off_s()):
            ending.act()
            late = (now := self.clock.now()) > ending.began + OVERRUN_S
            heard = self.box.heard_s > max(ending.began, now - QUIET_S)  # else the unit or its broker hangs
            if late:
                ended = "which lost the broker" if self.broke(request) else "which should have ended"
                how = "whose process was killed or hangs" if ending.lost else ended
                seen = {"pump": NAMES[job], "pin": self.box.jobs[job], "job": job, "how": how}
                if heard and self.told_on(job):
                    self.trouble = messages.RunsOn(**seen, purge=self.facts.purge)
                elif ending.failed:
                    self.trouble = messages.MayRunOn(**seen, purge=self.facts.purge)
                else:
                    self.trouble = messages.BeingVerified(**seen)
            self.waits = late or self.waits
            if job != WASTE:
                self.flowed_ml = ending.flowed() if heard else 0.0
                drain = late or (self.box.state(job).word == "lost" and pin.on) or self._beyond(request) > 0.0
                self.runs_on = self.flowed_ml > 0.0 and drain
            yield STEP_S
        self.trouble, self.waits, self.runs_on = None, False, False
        self.proven[job] = self.clock.now()
        return ending.moved(off_s)


class Seen(NamedTuple):
    """Evidence about a pump that should be off."""

    boot: bool  # its unit was started since
    pin: str  # "on" or "off" as reported since, "" without a report
    short: str  # of a short run: "", "asked", or "ended" by its own event and a later report of its job
    word: str  # as `last_word`


PROOFS: tuple[dict[str, tuple[Any, ...]], ...] = (
    {"boot": (True,)},  # a boot sets all pins to 0
    {"short": ("ended",), "pin": ("off", "")},  # a short run sets the pin to 0 at its begin and its end
    {"short": ("",), "word": ("disconnected",), "pin": ("off",)},  # later reports may be of the short run
)
"""Proofs that a pump is off: a row holds if each of its keys has one of the listed values."""


def is_off(seen: Seen) -> bool:
    return any(all(getattr(seen, key) in values for key, values in row.items()) for row in PROOFS)


class ForcedEnd:
    """Attempts to switch one pump off until it is proven off (docs/pioreactor.md, Ending).

    At most `SHORTS` short runs are carried out; none is requested while an earlier one may still wait.
    """

    def __init__(self, pumps: Pumps, request: Request) -> None:
        self._p, self._request, self._job, self._since = pumps, request, request.job, request.asked_s
        self.began, self._calls = pumps.clock.now(), Calls(pumps.web, pumps.clock)
        told_s = pumps.pins[request.job].event_s
        self._from_s = max(request.asked_s, told_s if told_s < math.inf else -math.inf)
        self._listed: bool | None = None
        self._shorts_before, self._short_s, self._barrier = self._shorts(), math.inf, Barrier(pumps.web, pumps.clock)
        self._quiet_s = self._still_s = math.inf
        self._apart_s = self.began
        self._short: Future[str] | None = None
        self._rebooted = self.lost = self._held = False

    def _shorts(self) -> float:
        return self._p.reported[self._job, self._p.short]

    def act(self) -> None:
        """Send the requests that are due; a running job first has some seconds to end."""
        p, job, passed, calls = self._p, self._job, self._p.clock.now() - self.began, self._calls
        self._apart_s = self._apart_s if p.mqtt.connected and not p.told_on(job) else p.clock.now()
        if calls.due("mqtt", 1.0):
            p.unit.say(f"{job}/$state/set", "disconnected")
        if passed > 1.0 and calls.due("pins", 5.0):
            p.ask_pins()
        if passed > 2.0 and self._listed is not False:
            calls.ask("stop", 20.0, p.web.stop, job)
        if self._short is not None and self._short.done():
            if not isinstance(self._short.exception(), NotHeard):
                self._barrier = Barrier(p.web, p.clock, AGAIN_S)
            self._short = None
        may_run = self._shorts() - self._shorts_before < (SHORTS - 0.5) * SHORT_S * p.flow_ml_s[job]
        may_run = may_run and p.mqtt.connected and self._short is None  # without a broker its reports are lost
        soon = not (p.box.live(job) or p.pins[job].on or self._request.ml > 0.0)
        if may_run and (soon or passed > 5.0) and self._barrier.passed() and calls.due("short", 2.0):
            self._short_s = min(self._short_s, p.clock.now())
            self._short = p.web.ask(p.web.run, job, {"duration": SHORT_S, "source-of-event": p.short})

    def _look(self) -> Seen:
        p, pin, state = self._p, self._p.pins[self._job], self._p.box.state(self._job)
        self.lost = self.lost or (state.word == "lost" and not p.broke(self._request))  # a broker also loses live jobs
        self._held = self._held or (bool(self._listed) and pin.on and pin.on_s == -math.inf)
        if p.clock.now() > p.box.heard_s + QUIET_S:
            self._quiet_s = min(self._quiet_s, p.box.heard_s)
        told = "off" if p.box.dc_s > self.began and pin.doubt_s == -math.inf else ""
        if told and not pin.on and not self._untold:
            self._still_s = min(self._still_s, p.box.dc_s)
        if rows := self._calls.ask("rows", 2.0, p.web.running):
            self._listed = any(row["job_name"] == self._job for row in rows[0])
            self._rebooted = not self._listed and p.rebooted(rows[0])
            p.boot = boot_of(rows[0]) if self._rebooted else p.boot
        ended = self._shorts() > self._shorts_before and state.word == "disconnected"
        short = "" if math.isinf(self._short_s) else "ended" if ended else "asked"
        told = "on" if pin.on else told or ("off" if pin.off_s >= self._since else "")
        return Seen(self._rebooted, told, short, p.last_word(self._request))

    @property
    def failed(self) -> bool:
        """Whether the proof failed: a short run found a lock, or the proof takes too long."""
        now, state = self._p.clock.now(), self._p.box.state(self._job)
        refused = state.word == "disconnected" and self._short_s < state.at < now - SETTLE_S
        return now > self._apart_s + PROOF_S or (refused and self._shorts() == self._shorts_before)

    def off_s(self) -> float:
        """Return the latest time at which the pump can have gone off, nan while it is not proven off."""
        pin, now = self._p.pins[self._job], self._p.clock.now()
        if not is_off(self._look()):
            return math.nan
        if self._rebooted:  # its pins are 0 since it lost its power, which was after its last message
            pin.ends(booted_s := max(min(self._quiet_s, now), self._since))
            if self._untold:
                return booted_s  # an earlier report of off did not know that it was on
        return pin.off_s if pin.off_s >= self._since else now

    @property
    def _untold(self) -> bool:
        """Whether the pin of a dose may have been on without a report, because a job switches before it reports."""
        heard = self._since <= self._p.pins[self._job].on_s < self._short_s
        return self._request.ml > 0.0 and not heard and self._p.last_word(self._request) != "disconnected"

    def flowed(self) -> float:
        """Return the volume so far of a pump that is not proven off, mL; 0 once its bottle must be empty."""
        p, pin, now = self._p, self._p.pins[self._job], self._p.clock.now()
        broke = p.broke(self._request) and not self.lost
        began = self._from_s if self._untold else pin.on_s if pin.on else pin.event_s
        flowed = max(now - max(self._since, began), 0.0) * p.flow_ml_s[self._job]
        return flowed if not broke and flowed < p.unit.bench.bottle_ml else 0.0

    def moved(self, off_s: float) -> Moved:
        """Return the volume that the pump moved since the request. Args: off_s: result of `off_s`."""
        p, pin, flow = self._p, self._p.pins[self._job], self._p.flow_ml_s[self._job]
        ml, said_ml = self._request.ml, p.said(self._request)
        longest = min(max(min(off_s, self._still_s) - self._from_s, 0.0) * flow, p.unit.bench.bottle_ml)
        ran = min((pin.ran_s - self._request.ran_s) * flow - (self._shorts() - self._shorts_before), longest)
        if self._held or self._untold or (ran <= 0.0 and self.lost):  # its start was never reported
            ran = longest
        low, end = max(said_ml - ROUNDED_S * flow, 0.0), messages.EndedFromHere()
        if ran <= 0.0:  # its pin was never reported, so the job's own time counts
            return Moved(low, max(ml, said_ml), end)
        if self._rebooted:
            most = max(ran, min(ml, ran + p.config.reading_s * flow))
            return Moved(low, most, messages.StartedAgainInDose())
        if p.broke(self._request) and not self.lost:  # it ends with the broker, unreported
            ran = min(ran, max(ml, said_ml))
        return Moved(low, max(ran, said_ml), end)
