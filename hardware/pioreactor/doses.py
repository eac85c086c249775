"""One dose from intent to its end: media, then waste, each a job of the vendor's with our id; never sent twice.

The vendor's 202 says only that a request was written down. A dose has begun when an event with its id arrives, and is
over when its events add up, its job is gone and its pin is off. One whose fate is not known is never sent again and
counted whole; nothing more is dosed until the unit's task queue has proved that it cannot run any more.
"""

import math
from dataclasses import dataclass, replace

from hardware.clock import Clock
from hardware.errors import ReactorError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.logbook import Logbook
from hardware.pioreactor.mailbox import DOSING_JOBS, Event, Mailbox, Mqtt
from hardware.pioreactor.pump_jobs import (
    ASK_S,
    LATE_ML,
    MEDIA,
    OURS,
    UNSTARTED_S,
    WASTE,
    Course,
    Given,
    PumpJobs,
    Steps,
)
from hardware.pioreactor.resume import History
from hardware.pioreactor.web import Web
from hardware.storage.doses import REPEAT_S

__all__ = ["Doses", "Plan"]

DRAINS, QUIET = 5, 1.5  # attempts to empty a vial; control periods without a stop before each

CYCLED = "/off"  # ends the id of a pin that we switched on and off
UNSEEN = "its end was not on record: counted whole, its waste as far as it was told"


@dataclass(frozen=True)
class Plan:
    """What was begun, mL; carry_ml is put off to the next dose."""

    feed_ml: float = 0.0
    waste_ml: float = 0.0
    carry_ml: float = 0.0


class Doses(PumpJobs):
    """The doses of one unit, one at a time, at most one per sample.

    Args: run: of this run, part of every id.
    Attributes: ended_s, clock time at which the last dose was over; stopped_s, at which pumps were last asked off;
      foreign, what was dosed without our command; extra, such volumes and corrections of booked doses: run time, feed
      and waste, mL, until somebody books and clears them.
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
        super().__init__(unit, web, mqtt, box, config, clock, book, run)
        self.ended_s = self.stopped_s = -math.inf
        self.extra: list[tuple[float, float, float]] = []
        self.foreign = ""
        self.sample: tuple[float, int] | None = None
        self.carry_ml, self._count = 0.0, 0
        self._course: Course | None = None
        self._due, self._waits = 0.0, False
        self._booked: dict[tuple[str, str], float] = {}
        self._strange: list[Event] = []

    @property
    def running(self) -> bool:
        """Whether a dose is under way, or the fate of one unknown."""
        return self._course is not None

    @property
    def at_rest(self) -> bool:
        """Whether the dose under way waits: for what is not known, or for pumps to be allowed again."""
        return bool(self.trouble) or self._waits

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
        if self._course is None and (lost := [job for job in (MEDIA, WASTE) if self._box.lost(job)]):
            self._course = self.prove_off(lost[0])
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
        for pump in (MEDIA, WASTE):
            self._booked[pump, dose] = -1.0  # under way: its events are expected
        media = yield from self.pump(MEDIA, plan.feed_ml, dose)
        waste, ran_on = Given(0.0, 0.0), media.high > plan.feed_ml + LATE_ML
        if media.high > 0.0 and not ran_on:
            waste = yield from self.pump(WASTE, plan.waste_ml, dose)
        self._conclude(dose, on_s, media, waste)
        if ran_on:  # on record before: it may wait for long
            waste = yield from self._drain(media, dose)
        self._correct(plan, media, waste)

    def _drain(self, media: Given, dose: str) -> Steps:
        """Waste after a media pump that ran on, until the vial is back at its tube; what was taken out.

        It waits while anybody asks for pumps off, and goes on where it was stopped: a vial that is too full by the
        ledger is given no dose, and so no waste, any more.
        """
        self._book.tell("the vial is drained of what the media pump gave while it ran on, before it is dosed again")
        wanted, taken, k = self._config.waste_factor * min(media.high, self._config.volume_ml), 0.0, 0
        while wanted - taken > LATE_ML and k < DRAINS:
            self._waits = self._clock.now() < self.stopped_s + QUIET * self._config.period_s
            if self._waits:
                yield ASK_S
                continue
            k += 1
            key = WASTE, f"{dose}/drain{k}"
            self._booked[key] = -1.0
            given = yield from self.pump(WASTE, wanted - taken, key[1])
            self._booked[key] = given.low
            taken += given.low
        return Given(taken, wanted)

    def _correct(self, plan: Plan, media: Given, waste: Given) -> None:
        """What was not as planned, for whoever booked the plan when the dose began: feed, and what the level rose."""
        more, rise = media.high - plan.feed_ml, max(media.high - waste.low, 0.0)
        if abs(more) > LATE_ML or rise > LATE_ML:
            self.extra.append((self._book.elapsed(), more, more - rise))

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

    def _look_for(self, history: History) -> Course:
        """The dose an earlier life left open: how it ended cannot be had any more; it is counted whole."""
        if not history.fed:
            self._conclude(history.id, history.on_s, Given(0.0, 0.0), Given(0.0, 0.0))
            return
        for pump in (MEDIA, WASTE):
            self._booked[pump, history.id] = -1.0
        self.trouble = f"a dose of {history.feed_ml:.2f} mL was left open"
        barrier, taken = self._barrier(), False
        while (
            not taken
            or self._box.running_pins(self._config.pump_pins)
            or self._box.live(MEDIA)
            or self._box.live(WASTE)
        ):
            taken = taken or barrier.passed()
            yield ASK_S
        yield UNSTARTED_S
        media, waste = Given(0.0, history.feed_ml), Given(0.0, history.waste_ml)
        if self._box.lost(WASTE):
            yield from self.prove_off(WASTE)
        if self._box.lost(MEDIA):
            yield from self.prove_off(MEDIA)
            on_s = (self._book.elapsed() - history.on_s) / self._config.speed
            media, waste = Given(0.0, max(history.feed_ml, on_s * self.flow_ml_s[MEDIA])), Given(0.0, 0.0)
        self.trouble = ""
        self._conclude(history.id, history.on_s, replace(media, end=UNSEEN), waste)
        if media.high > history.feed_ml:
            waste = yield from self._drain(media, history.id)
        self._correct(Plan(history.feed_ml, history.waste_ml), media, waste)

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
            ours = (
                "by which its pin was switched off" if event.source.endswith(CYCLED) else "an earlier request ran late"
            )
            who = ours if event.source.startswith(OURS) else f"by {event.source}"
            feed, waste = (0.0, over) if event.pump == WASTE else (over, 0.0)
            at_s = self._book.elapsed()
            self.extra.append((at_s, feed, waste))
            said = f"{event.pump} of {over:.2f} mL without our command ({who})"
            self.foreign = self.foreign if event.source.endswith(CYCLED) else said
            self._book.tell(said)
            self._book.note_down(
                "dose_end", verified_off=True, on_s=at_s - REPEAT_S, feed_ml=feed, waste_ml=waste,
                feed_times=int(feed > 0.0), waste_times=int(waste > 0.0), repeated_ml=feed, feed_low_ml=0.0,
                source=event.source,
            )  # fmt: skip
