"""The pump jobs of one unit: asked for once, followed to their end, and ended where they do not end by themselves.

The vendor's 202 says only that a request was written down. A job has begun when an event with its id arrives or its pin
goes on, and is over when it has said so and its pin is off. Every other course leads into one routine, `Pumps.end`.
Times here are real seconds.
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
SETTLE_S = 1.5  # between two events of a dose .5 s pass; a word on a pin that was overtaken comes within that
OVERRUN_S = 3.0  # beyond its time a job is given to end by itself
UNSTARTED_S = 60.0  # that a process may take from the queue to its first word, on a busy unit
QUIET_S = 10.0  # without a word a unit that lives is never: it reads OD
LATE_ML = 0.1  # messages are late by some hundredths of a second
ROUNDED_S = 0.5  # a dose is told in slices of so long, before each is pumped
PAST_S = 0.5  # beyond its dose a media pump that is told on is drained
PROOF_S = 20.0  # with a broker, in which a pump is proven off, or a hand must look at it
NUDGE = 0.01  # of a duty, %: nobody sees it
SHORT_S, SHORTS = 0.1, 3  # a run of a pump that ends with its pin off, whatever it was; of those at most
AGAIN_S = 15.0  # between two of them
UNTOLD = 2  # runs in a row of which no pin was told; with one more no pump is followed

Steps = Generator[float, None, T]
"""A course that yields what to wait, s, and returns T."""


@dataclass(frozen=True)
class Unit:
    """One unit's surroundings.

    name: as in the vendor's page. config: of this unit. bench: period, bottle. volume_ml: of its culture. web, leader,
    mqtt, box: the ways to it and to its leader. clock: of the run, whose `real` is that of messages and jobs. book:
    what it reports. run: of this run, part of every dose's id.
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
        """Publish below our experiment."""
        self.mqtt.publish(f"pioreactor/{self.name}/{self.config.experiment}/{topic}", payload)


class Moved(NamedTuple):
    """What a pump moved, mL, at least and at most; end, what is not as asked, or None."""

    low: float = 0.0
    high: float = 0.0
    end: Message | None = None


class Request(NamedTuple):
    """A run of a pump that was asked for (ml), or found (0): its id, when that was, its pin's time then, the answer."""

    job: str
    ml: float
    dose: str
    asked_s: float
    ran_s: float
    task: str = ""


def boot_of(rows: list[dict[str, Any]]) -> str:
    """When a unit was started, by its list of running jobs; "" where that does not say it."""
    return next((str(row.get("started_at", "")) for row in rows if row["job_name"] == "monitor"), "")


class Pumps:
    """The pumps of one unit.

    Attributes: jobs, of those that this run drives; ours, how every id of this run begins; short, that of a run that
      only ends with its pin off; flow_ml_s, by the active calibrations; reported, mL by job and source of the events;
      counted, mL of them that whoever asked for them books, inf while they are under way; facts, of the unit's version;
      boot, when it was started; proven, when pumps were ended here; trouble, why no dose may be given, None if one may;
      barred, jobs that are to end; waits, whether what is under way waits for somebody or something else; flowed_ml,
      the most that a media pump gave up to now that is not proven off, and runs_on, whether it is to be drained.
    """

    def __init__(self, unit: Unit) -> None:
        self.unit, self.web, self.mqtt, self.box = unit, unit.web, unit.mqtt, unit.box
        self.config, self.clock, self.book, self.pins = unit.config, unit.real, unit.book, unit.box.pins
        self.jobs = PUMPS if unit.config.alt_media else (MEDIA, WASTE)
        self.flow_ml_s = dict.fromkeys(self.jobs, 1.0)  # about what the vendor's pumps give, until it was read
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
        """Whether a pump has to be ended: it runs without a job, or its job was lost and it is not proven off since."""
        pin, state, now = self.pins[job], self.box.state(job), self.clock.now()
        settled = now > max(pin.on_s, pin.ended_s) + SETTLE_S
        new = state.at > self.proven.get(job, -math.inf) or job not in self.proven
        return (pin.on and settled and not self.box.live(job, *AUTOMATIONS)) or (state.word == "lost" and new)

    def rebooted(self, rows: list[dict[str, Any]]) -> bool:
        return boot_of(rows) not in ("", self.boot)

    def told_on(self, job: str) -> bool:
        """Return whether the unit reports a pump on since the broker is connected, except by a short run."""
        pin, broke_s, before_s = self.pins[job], self.mqtt.broke_s, self.clock.now() - SETTLE_S
        return pin.on and pin.on_s < before_s and (broke_s <= pin.on_s or broke_s < self.box.dc_s < before_s)

    def ask_pins(self) -> None:
        """Have stirring report all pins again: change its duty a little, as newer versions report only changes."""
        if not math.isnan(duty := self.box.stir_duty):
            self.unit.say("stirring/duty_cycle/set", f"{duty + NUDGE * (-1) ** round(duty / NUDGE):g}")

    def said(self, request: Request) -> float:
        return self.reported[request.job, request.dose]

    def answer(self, what: Callable[..., T], *given: Any) -> Steps[T]:
        """Wait for a request while the other units go on. Raises: as the request."""
        future = self.web.ask(what, *given)
        while not future.done():
            yield STEP_S
        return future.result()

    def calibrate(self) -> Steps[None]:
        """Read what each pump gives by its calibration now. Raises: ReactorError."""
        said = yield from self.answer(self.web.get, "/active_calibrations")
        self.flow_ml_s = {job: flow(said, f"{NAMES[job]}_pump") for job in self.jobs}

    def give(self, job: str, ml: float, dose: str) -> Steps[Moved]:
        """Ask for one pump job and follow it; what it gave. It is never asked for again."""
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
        """Follow a job to its end; return what it gave."""
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
            self.box.dc_s = -math.inf  # until the unit tells its pins again
        return self._moved(request)

    def _beyond(self, request: Request) -> float:
        """Return what a pump gave that is on past the end of its dose, mL; 0 before that, or while nothing is heard."""
        pin, flow, now = self.pins[request.job], self.flow_ml_s[request.job], self.clock.now()
        on_s = max(pin.on_s, request.asked_s)
        end_s = on_s + request.ml / flow
        if not pin.on or now < end_s + PAST_S:
            return 0.0
        if self._calls.due("pins", 1.0):
            self.ask_pins()
        return (now - on_s) * flow if self.box.heard_s > end_s else 0.0

    def broke(self, request: Request) -> bool:
        """Whether the connection to the broker was lost since a run was asked for."""
        return self.mqtt.broke_s >= request.asked_s

    def _begins(self, request: Request) -> Steps[Message | None]:
        """Wait until a request's pump begins, then None; or until it certainly never will, then why (as below)."""
        job, asked_s = request.job, request.asked_s
        calls, barrier = Calls(self.web, self.clock), Barrier(self.web, self.clock, PROBE_S * bool(request.task))
        why: Message | None = None
        never_s, late = math.inf, False  # from when on it cannot begin any more; whether it should have begun
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
            if job in self.barred and calls.due("stop", 1.0):  # heard once the job listens
                self.unit.say(f"{job}/$state/set", "disconnected")
            yield STEP_S
        if late:
            self.trouble, self.waits = None if self.trouble is fate else self.trouble, False
            if not why:
                self.book.tell(messages.RanLate(job=job, ml=request.ml))
        return why

    def last_word(self, request: Request) -> str:
        """Return the last state that the job reported; "" is unknown: two processes share a topic, or it broke."""
        pin, state = self.pins[request.job], self.box.state(request.job)
        alone = sum(at >= request.asked_s for at in pin.inits) <= 1 and not self.broke(request)
        return state.word if request.ml > 0.0 and alone and state.at >= request.asked_s else ""

    def _is_over(self, request: Request) -> bool:
        """Return whether a job reported its end, its pin is still, and its last event is there or will not come."""
        state, pin, asked_s = self.box.state(request.job), self.pins[request.job], request.asked_s
        told = pin.on_s >= asked_s and state.word == "disconnected" and state.at >= asked_s  # whoever's word that was
        ended = (told or self.last_word(request) == "disconnected") and not pin.on
        return ended and (self.said(request) >= request.ml - 1e-6 or self.clock.now() > state.at + SETTLE_S)

    def _moved(self, request: Request) -> Moved:
        """Return what a job that ended by itself gave, by its events and by how long its pin was on."""
        flow, ml, said_ml = self.flow_ml_s[request.job], request.ml, self.said(request)
        end: Message | None = None
        low = high = said_ml
        ran_ml = (self.pins[request.job].ran_s - request.ran_s) * flow
        if said_ml < ml - 1e-6:  # a stop by HTTP tells up to half a second too much; a last event may be missing
            slack = LATE_ML if ran_ml > 0.0 else ROUNDED_S * flow
            low, high = max(min(said_ml, ran_ml or said_ml) - slack, 0.0), min(max(said_ml, ran_ml) + slack, ml)
            end = messages.ToldLess(told_ml=said_ml, ml=ml)
        if ran_ml > high + LATE_ML:
            end = end or messages.RanLonger(ran_ml=ran_ml, told_ml=said_ml)
        return Moved(low, max(high, round(ran_ml, 4)), end)  # a job times itself, and on a busy unit it does that late

    def end(self, request: Request) -> Steps[Moved]:
        """End a pump that has begun, or may have, until it is proven off; return what it moved."""
        job, ending, pin = request.job, ForcedEnd(self, request), self.pins[request.job]
        while math.isnan(off_s := ending.off_s()):
            ending.act()
            late = (now := self.clock.now()) > ending.began + OVERRUN_S
            heard = self.box.heard_s > max(ending.began, now - QUIET_S)  # else a unit or its broker stands still
            if late:
                ended = "which lost the broker" if self.broke(request) else "which should have ended"
                how = "whose process was killed or stands still" if ending.lost else ended
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
    """What is known of a pump that is to be off."""

    boot: bool  # its unit was started since
    pin: str  # "on" or "off" as told since, "" untold
    short: str  # of a run to switch it off: "", "asked", or "ended" by its own event and its job's word after it
    word: str  # as of `last_word`


PROOFS: tuple[dict[str, tuple[Any, ...]], ...] = (
    {"boot": (True,)},  # which sets all pins to 0
    {"short": ("ended",), "pin": ("off", "")},  # it set the pin to 0 as it began and as it ended
    {"short": ("",), "word": ("disconnected",), "pin": ("off",)},  # later words may be those of the short run
)
"""What proves a pump off: each of a row's values is among those that it names."""


def is_off(seen: Seen) -> bool:
    return any(all(getattr(seen, key) in values for key, values in row.items()) for row in PROOFS)


class ForcedEnd:
    """One pump on its way to being proven off: what is tried, and what proves it (docs/pioreactor.md, Ending).

    Of short runs at most `SHORTS` are carried out, and none is asked for while an earlier one may still wait.
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
        """Ask what is due; a job that is there is given some seconds to end by itself."""
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
        may_run = may_run and p.mqtt.connected and self._short is None  # what it tells, else it runs unseen
        soon = not (p.box.live(job) or p.pins[job].on or self._request.ml > 0.0)
        if may_run and (soon or passed > 5.0) and self._barrier.passed() and calls.due("short", 2.0):
            self._short_s = min(self._short_s, p.clock.now())
            self._short = p.web.ask(p.web.run, job, {"duration": SHORT_S, "source-of-event": p.short})

    def _look(self) -> Seen:
        p, pin, state = self._p, self._p.pins[self._job], self._p.box.state(self._job)
        self.lost = self.lost or (state.word == "lost" and not p.broke(self._request))  # a broker takes live ones too
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
        """Whether no proof came: a short run found a lock, or it takes too long."""
        now, state = self._p.clock.now(), self._p.box.state(self._job)
        refused = state.word == "disconnected" and self._short_s < state.at < now - SETTLE_S
        return now > self._apart_s + PROOF_S or (refused and self._shorts() == self._shorts_before)

    def off_s(self) -> float:
        """When the pump was off at the latest, nan while that is not proven."""
        pin, now = self._p.pins[self._job], self._p.clock.now()
        if not is_off(self._look()):
            return math.nan
        if self._rebooted:  # its pins are 0 since it lost its power, and that was after its last word
            pin.ends(booted_s := max(min(self._quiet_s, now), self._since))
            if self._untold:
                return booted_s  # whoever told it off before did not know that it was on
        return pin.off_s if pin.off_s >= self._since else now

    @property
    def _untold(self) -> bool:
        """Whether the pin of a dose that had to be ended was not said to be on: its job switches first."""
        heard = self._since <= self._p.pins[self._job].on_s < self._short_s
        return self._request.ml > 0.0 and not heard and self._p.last_word(self._request) != "disconnected"

    def flowed(self) -> float:
        """Return the volume so far of a pump that runs on or reported no end, mL; 0 once its bottle is empty."""
        p, pin, now = self._p, self._p.pins[self._job], self._p.clock.now()
        broke = p.broke(self._request) and not self.lost
        began = self._from_s if self._untold else pin.on_s if pin.on else pin.event_s
        flowed = max(now - max(self._since, began), 0.0) * p.flow_ml_s[self._job]
        return flowed if not broke and flowed < p.unit.bench.bottle_ml else 0.0

    def moved(self, off_s: float) -> Moved:
        """Return what the pump moved since it was asked. Args: off_s: as of `off_s`."""
        p, pin, flow = self._p, self._p.pins[self._job], self._p.flow_ml_s[self._job]
        ml, said_ml = self._request.ml, p.said(self._request)
        longest = min(max(min(off_s, self._still_s) - self._from_s, 0.0) * flow, p.unit.bench.bottle_ml)
        ran = min((pin.ran_s - self._request.ran_s) * flow - (self._shorts() - self._shorts_before), longest)
        if self._held or self._untold or (ran <= 0.0 and self.lost):  # since when it runs was never heard
            ran = longest
        low, end = max(said_ml - ROUNDED_S * flow, 0.0), messages.EndedFromHere()
        if ran <= 0.0:  # its pin was never seen: a job times itself
            return Moved(low, max(ml, said_ml), end)
        if self._rebooted:
            most = max(ran, min(ml, ran + p.config.reading_s * flow))
            return Moved(low, most, messages.StartedAgainInDose())
        if p.broke(self._request) and not self.lost:  # a job that loses the broker ends; when was not heard
            ran = min(ran, max(ml, said_ml))
        return Moved(low, max(ran, said_ml), end)
