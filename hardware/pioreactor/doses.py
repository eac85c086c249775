"""One dose from intent to its end: media, then waste, each a job of the vendor's with our id; never sent twice.

The vendor's 202 says only that a request was written down. A dose has begun when an event with its id arrives, and is
over when its events add up, its job is gone and its pin is off. One whose fate is not known is never sent again and
counted whole; nothing more is dosed until the unit's task queue has proved that it cannot run any more.
"""

import contextlib
import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any

from hardware.clock import Clock
from hardware.errors import ReactorError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.logbook import Logbook
from hardware.pioreactor.mailbox import DOSING_JOBS, Event, Mailbox, Mqtt
from hardware.pioreactor.resume import History
from hardware.pioreactor.web import NotHeard, Web

__all__ = ["Doses", "Given", "Plan"]

STEP_S, ASK_S, OVERRUN_S, SETTLE_S = 0.1, 0.5, 6.0, 1.0  # real seconds
UNSTARTED_S = 120.0  # real seconds that a process may take from the queue to its first word, on a busy unit
SHORT_S, AGAIN_S = 0.1, 6.0  # real seconds: a run of a pump that ends with its pin off; between two of them
ROUNDED_S = 0.5  # a dose that is stopped early is told up to the next half second of its pump
OURS = "turbidostat/"
MEDIA, WASTE = "add_media", "remove_waste"
REPEAT_S = 63.0  # the journal keeps a volume that nobody commanded as one repetition, so long after `on_s`


@dataclass(frozen=True)
class Plan:
    """What was begun, mL; carry_ml is put off to the next dose."""

    feed_ml: float = 0.0
    waste_ml: float = 0.0
    carry_ml: float = 0.0


@dataclass(frozen=True)
class Given:
    """What a pump moved, mL: at least low, at most high. end: in words, "" for a dose that went as asked."""

    low: float
    high: float
    end: str = ""


Course = Iterator[float]
Steps = Generator[float, None, Given]


class Doses:
    """The doses of one unit, one at a time, at most one per sample.

    Args: run: of this run, part of every id.
    Attributes: flow_ml_s, of media and waste pump by their active calibrations; ended_s, clock time at which the last
      dose was over; trouble, why no dose may be given, "" if one may; foreign, what was dosed without our command;
      extra, such volumes: run time, feed and waste, mL, until somebody books and clears them.
    """

    def __init__(
        self,
        unit: str,
        web: Web,
        mqtt: Mqtt,
        box: Mailbox,
        config: PioreactorConfig,
        clock: Clock,
        book: Logbook,
        run: str,
    ) -> None:
        self.unit, self._web, self._mqtt, self._box = unit, web, mqtt, box
        self._config, self._clock, self._book, self._run = config, clock, book, run
        self.flow_ml_s = {MEDIA: math.nan, WASTE: math.nan}
        self.ended_s, self.trouble = -math.inf, ""
        self.extra: list[tuple[float, float, float]] = []
        self.foreign = ""
        self.sample: tuple[float, int] | None = None
        self.carry_ml, self._count = 0.0, 0
        self._course: Course | None = None
        self._cycled_s = -math.inf
        self._due = 0.0
        self._told: dict[tuple[str, str], float] = {}
        self._booked: dict[tuple[str, str], float] = {}
        self._strange: list[Event] = []

    @property
    def running(self) -> bool:
        """Whether a dose is under way, or the fate of one unknown."""
        return self._course is not None

    def restore(self, history: History) -> None:
        """Continue as an earlier life of the run left it; a dose without an end is looked for, never sent again."""
        self.sample, self.carry_ml, self._count = history.sample, history.carry_ml, history.doses
        if history.open:
            self._course = self._look_for(history)

    def plan(self, rate: float) -> Plan:
        """What a mean rate comes to, mL. Args: rate: mL/s over a control period, >= 0. Raises: ValueError."""
        if not (rate >= 0.0 and math.isfinite(rate)):
            raise ValueError(f"pump rate = {rate} mL/s: allowed finite numbers >= 0")
        asked = rate * self._config.period_s + (self.carry_ml if rate > 0.0 else 0.0)
        if asked < self._config.min_dose_ml:
            return Plan(carry_ml=asked if rate > 0.0 else self.carry_ml)
        feed = min(asked, self._config.max_dose_ml)
        return Plan(feed, self._config.waste_factor * feed)

    def begin(self, rate: float, sample: tuple[float, int] | None, refusal: str) -> Plan:
        """Begin the dose for `sample`, if nothing stands against it; a note says what does.

        Raises: ValueError for a rate that is negative or not finite; what the intent's log raises.
        """
        plan = self.plan(rate)
        if reason := refusal or self._obstacle(sample, plan):
            if plan.feed_ml > 0.0:
                self._book.tell(f"no dose: {reason}")
            return Plan(carry_ml=self.carry_ml)
        dosing = plan.feed_ml > 0.0
        self._count += dosing
        self.sample, self.carry_ml = sample, plan.carry_ml
        dose, on_s = f"{OURS}{self._run}/{self.unit}/{self._count}", self._book.elapsed()
        self._book.write(
            "intent", sample=sample, rate=rate, feed_ml=plan.feed_ml, waste_ml=plan.waste_ml, carry_ml=plan.carry_ml,
            doses=self._count, on_s=on_s, id=dose,
        )  # fmt: skip
        if dosing:
            self._course = self._dose(plan, dose, on_s)
            self.work()
        return plan

    def _obstacle(self, sample: tuple[float, int] | None, plan: Plan) -> str:
        if sample is None or sample == self.sample:
            return "no new sample"
        if self.running:
            return "the previous dose has not ended"
        if self.trouble:
            return self.trouble
        if plan.feed_ml > 0.0 and self._strays():
            return "a pump or a dosing job of somebody else runs"
        return ""

    def _strays(self) -> bool:
        """Whether a pump or a dosing job of somebody else runs: asked of the unit itself, before every dose."""
        try:
            jobs = {job["job_name"] for job in self._web.running()} & set(DOSING_JOBS)
        except ReactorError as error:
            self._book.tell(f"the unit does not list its jobs: {error}")
            return True
        jobs = {job for job in jobs if self._box.live(job)}  # the list keeps a killed one for ever
        return bool(jobs or self._box.running_pins(self._config.pump_pins))

    # -- the course of a dose --------------------------------------------------------------------------------------

    def work(self) -> None:
        """Do what is due; called again and again."""
        if self._course is None or self._clock.now() < self._due:
            return
        try:
            pause = next(self._course)
        except StopIteration:
            self._course, self.ended_s = None, self._clock.now()
            self._settle_strange()
            return
        self._due = self._clock.now() + pause * self._config.speed

    def take(self, events: list[Event]) -> None:
        """Dosing events that arrived; those of nobody's dose wait until no dose is under way."""
        for event in events:
            key = event.pump, event.source
            self._told[key] = self._told.get(key, 0.0) + event.ml
            if key not in self._booked or self._booked[key] >= 0.0:
                self._strange.append(event)
        if self._course is None:
            self._settle_strange()

    def _dose(self, plan: Plan, dose: str, on_s: float) -> Course:
        """Media, then as much waste as the plan says; the end on record."""
        self._book.write("feed_on", on_s=on_s, id=dose)  # before it is done: it may have been done
        media = yield from self._pump(MEDIA, plan.feed_ml, dose)
        waste = Given(0.0, 0.0)
        if media.high > 0.0:
            waste = yield from self._pump(WASTE, plan.waste_ml, dose)
        self._conclude(dose, on_s, media, waste)

    def _conclude(self, dose: str, on_s: float, media: Given, waste: Given) -> None:
        self._booked[MEDIA, dose], self._booked[WASTE, dose] = media.high, waste.low
        for given, pump in ((media, "media"), (waste, "waste")):
            if given.end:
                self._book.tell(f"{pump}: {given.end}")
        self._book.note_down(
            "dose_end", verified_off=True, on_s=on_s, feed_ml=media.high, waste_ml=waste.low, feed_times=0,
            waste_times=0, repeated_ml=0.0, feed_low_ml=media.low, waste_high_ml=waste.high, id=dose,
            end=media.end or waste.end,
        )  # fmt: skip

    def _pump(self, job: str, ml: float, dose: str) -> Steps:
        """Ask for one pump job and follow it; what it gave."""
        key = job, dose
        self._booked[key] = -1.0  # under way: its events are expected
        breaks, asked = self._mqtt.breaks, self._clock.now()
        task: str | None = None
        try:
            task = self._web.run(job, {"ml": round(ml, 4), "source-of-event": dose}, self._book.env, [])
        except NotHeard as error:
            return Given(0.0, 0.0, f"not given: {error}")
        except ReactorError as error:
            self._book.tell(f"{job}: whether it was heard is unknown: {error}")
        deadline = asked + self._config.start_s * self._config.speed
        while self._told.get(key, 0.0) <= 0.0 and self._mqtt.breaks == breaks:
            if self._clock.now() > deadline and not self._box.live(job):  # one that is there is about to begin
                break
            yield STEP_S
        if self._told.get(key, 0.0) <= 0.0:
            return (yield from self._unknown(key, ml, task, (breaks, asked)))
        return (yield from self._follow(key, ml, breaks))

    def _follow(self, key: tuple[str, str], ml: float, breaks: int) -> Steps:
        """A pump that has begun, until its pin is off and its job gone."""
        job, began, flow = key[0], self._clock.now(), self.flow_ml_s[key[0]]
        expected_s = ml / flow if flow > 0.0 else 60.0
        late = began + (expected_s + OVERRUN_S) * self._config.speed
        while self._box.running_pins(self._config.pump_pins) or self._box.live(job):
            if self._clock.now() > late and self._mqtt.connected:
                yield from self._overrun(job)
                break
            yield STEP_S
        told = self._told.get(key, 0.0)
        if self._mqtt.breaks != breaks or self._box.lost(job):
            why = "its process was killed" if self._box.lost(job) else "the broker was lost"
            ran_s = (self._clock.now() - began) / self._config.speed + ROUNDED_S
            most = max(ml, ran_s * flow) if self._box.lost(job) and self._clock.now() > late else ml
            return Given(0.0, most, f"{why} in a dose: counted whole")
        if told >= ml - 1e-6:
            return Given(told, told)
        settled = self._clock.now() + SETTLE_S * self._config.speed
        while self._told.get(key, 0.0) < ml - 1e-6 and self._clock.now() < settled:
            yield STEP_S  # events are sent by a thread of the job and may come after its state
        told = self._told.get(key, 0.0)
        if told >= ml - 1e-6:
            return Given(told, told)
        return Given(
            max(told - ROUNDED_S * flow, 0.0),
            min(told + ROUNDED_S * flow, ml),
            f"{told:.2f} of {ml:.2f} mL told: ended early, or its last event was not sent",
        )

    def _overrun(self, job: str) -> Course:
        """A pump that runs on: stop it, again and again; while it runs, say what only the operator can do."""
        while pins := self._box.running_pins(self._config.pump_pins):
            self.stop_jobs()
            self.cycle_pins()
            self.trouble = (
                f"pin {pins[0]} runs on after {job} should have ended; pull the pump's plug, or on the unit: "
                f"pio cache clear pwm_locks {pins[0]} --as-int && pio run {job} --duration 0.1"
            )
            yield self._config.retry_s
        self.trouble = ""

    def _unknown(self, key: tuple[str, str], ml: float, task: str | None, at: tuple[int, float]) -> Steps:
        """A request that was, or may have been, written down and did nothing yet: wait until it can do nothing more.

        It is over when its task, or one that was queued behind it, was taken from the queue, no job of its name runs
        and no pin does. Without a break of the broker its events then are the truth. Args: at: breaks of the broker
        until it was asked for, and when that was.
        """
        job, (breaks, asked) = key[0], at
        self.trouble = f"the fate of a dose of {ml:.2f} mL ({job}) is unknown: task queue or broker do not answer"
        self._book.tell(self.trouble)
        taken = False
        while not taken:
            if self._told.get(key, 0.0) > 0.0:
                self.trouble = ""
                self._book.tell(f"{job} of {ml:.2f} mL ran late")
                return (yield from self._follow(key, ml, breaks))
            with contextlib.suppress(ReactorError):
                task = task or self._web.run(MEDIA, {"help": None}, self._book.env, [])  # stands behind it in the queue
                taken = self._web.result(task) is not None
            yield ASK_S
        latest = self._clock.now() + UNSTARTED_S * self._config.speed  # a process may take long to start
        while not (self._box.been(job, asked) or self._clock.now() > latest) or not self.off():
            if self._told.get(key, 0.0) > 0.0:
                self.trouble = ""
                return (yield from self._follow(key, ml, breaks))
            yield STEP_S
        yield SETTLE_S  # events are sent by a thread of the job and may come after its state
        self.trouble = ""
        if self._told.get(key, 0.0) > 0.0:
            return (yield from self._follow(key, ml, breaks))
        if self._mqtt.breaks != breaks:
            return Given(0.0, ml, "asked for while the broker was lost: counted whole")
        return Given(0.0, 0.0, f"accepted and not carried out: {self.locks}")

    @property
    def locks(self) -> str:
        """What to do about a lock that a killed process left."""
        pins = ", ".join(map(str, self._config.pump_pins))
        return (
            "look at the unit's log; a killed process leaves a lock on its pin, which ends with "
            f"pio cache clear pwm_locks PIN --as-int (pins {pins})"
        )

    def _look_for(self, history: History) -> Course:
        """The dose an earlier life left open: how it ended cannot be had any more; it is counted whole."""
        if not history.fed:
            self._conclude(history.id, history.on_s, Given(0.0, 0.0), Given(0.0, 0.0))
            return
        for pump in (MEDIA, WASTE):
            self._booked[pump, history.id] = -1.0
        self.trouble = f"a dose of {history.feed_ml:.2f} mL was left open"
        task, taken = "", False
        while (
            not taken
            or self._box.running_pins(self._config.pump_pins)
            or self._box.live(MEDIA)
            or self._box.live(WASTE)
        ):
            with contextlib.suppress(ReactorError):
                task = task or self._web.run(MEDIA, {"help": None}, self._book.env, [])
                taken = taken or self._web.result(task) is not None
            yield ASK_S
        yield UNSTARTED_S
        self.trouble = ""
        given = Given(0.0, history.feed_ml, "its end was not on record: counted whole, its waste not at all")
        self._conclude(history.id, history.on_s, given, Given(0.0, history.waste_ml))

    # -- what nobody commanded -------------------------------------------------------------------------------------

    def _settle_strange(self) -> None:
        """Book what was dosed without a command of this run, beyond what was counted already."""
        strange, self._strange = self._strange, []
        for event in strange:
            key = event.pump, event.source
            counted = max(self._booked.get(key, 0.0), 0.0)
            over = min(self._told[key] - counted, event.ml)
            if over <= 1e-6 or event.pump not in (MEDIA, "add_alt_media", WASTE):
                continue
            self._booked[key] = counted + over
            who = "an earlier request of ours ran late" if event.source.startswith(OURS) else f"by {event.source}"
            feed, waste = (0.0, over) if event.pump == WASTE else (over, 0.0)
            at_s = self._book.elapsed()
            self.extra.append((at_s, feed, waste))
            self.foreign = f"{event.pump} of {over:.2f} mL without our command ({who})"
            self._book.tell(self.foreign)
            self._book.note_down(
                "dose_end", verified_off=True, on_s=at_s - REPEAT_S, feed_ml=feed, waste_ml=waste,
                feed_times=int(feed > 0.0), waste_times=int(waste > 0.0), repeated_ml=feed, source=event.source,
            )  # fmt: skip

    # -- off -------------------------------------------------------------------------------------------------------

    def stop_jobs(self) -> list[str]:
        """Ask every dosing job of the unit to end, by MQTT and, where that leaves one, by HTTP; what failed."""
        failed = []
        for job in (MEDIA, WASTE):
            if not self._mqtt.publish(
                f"pioreactor/{self.unit}/{self._book.experiment}/{job}/$state/set", "disconnected"
            ):
                failed.append(f"{job}: the broker is not there")
        return failed

    def cycle_pins(self) -> None:
        """Switch a pin that runs although its job is gone on and off: what ends a pump that was left on.

        The vendor refuses it where a killed process left its lock. It moves a tenth of a second's volume, which is
        counted when its event comes. Asked for at most every few seconds; trouble is left to the next time.
        """
        jobs = dict(zip(self._config.pump_pins, (MEDIA, "add_alt_media", WASTE), strict=False))
        pins = [
            pin for pin in self._box.running_pins(self._config.pump_pins) if not self._box.live(jobs.get(pin, MEDIA))
        ]
        if not pins or self._clock.now() < self._cycled_s + AGAIN_S * self._config.speed:
            return
        self._cycled_s = self._clock.now()
        source = f"{OURS}{self._run}/{self.unit}/off"
        with contextlib.suppress(ReactorError):
            self._web.run(jobs[pins[0]], {"duration": SHORT_S, "source-of-event": source}, self._book.env, [])

    def stop_by_web(self) -> None:
        """The same by HTTP, which rounds what was given. Raises: ReactorError."""
        for job in (MEDIA, WASTE):
            self._web.post(f"/jobs/stop?job_name={job}")

    def off(self) -> bool:
        """Whether no pump runs and no dosing job of ours is there, by what the unit said last."""
        return not (self._box.running_pins(self._config.pump_pins) or self._box.live(MEDIA) or self._box.live(WASTE))

    def state(self) -> dict[str, Any]:
        """For the log."""
        return {"dose": self._count, "trouble": self.trouble}
