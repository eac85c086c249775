"""Doses of one unit, from intent to end: media, then waste, each a job of the vendor with the dose's id; sent once.

While it is unknown whether a dose will run, no further dose begins. The end of a dose is recorded with its smallest and
largest volume, and corrects the volume that was booked when the dose began.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from conf.messages import Message
from hardware.messages import DoseUnderWay, NoDose, NoNewSample
from hardware.pioreactor import messages
from hardware.pioreactor.config import vial_ml
from hardware.pioreactor.mailbox import ALT, AUTOMATIONS, DOSING_JOBS, MEDIA, NAMES, NUMBERS, PUMPS, SPARE, WASTE, Event
from hardware.pioreactor.pumps import LATE_ML, OURS, SETTLE_S, STEP_S, Moved, Pumps, Request
from hardware.stations import Plan
from hardware.storage.doses import Ending, Given, feeds_by
from hardware.storage.history import History

DRAIN_ML = 4.0  # least volume of one drain while a media pump runs on
DRAINS = 5  # most drains of a vial after that


@dataclass(frozen=True)
class UnitHistory(History):
    """One unit's past. boot: when it was started. pump, id, task: of an open dose; the request's reply has the task."""

    boot: str = ""
    pump: int = 1
    id: str = ""
    task: str = ""

    KINDS: ClassVar = (*History.KINDS, "task")
    KEYS: ClassVar = {**History.KEYS, "boot": str}

    def after(self, row: Mapping[str, Any]) -> Self:
        known = super().after(row)
        if row["kind"] == "intent":
            return replace(known, pump=int(feeds_by(row)[-1]), id=str(row["id"]), task="")
        if row["kind"] == "task" and row["id"] == known.id:
            return replace(known, task=str(row["task"]), wasted=row["job"] == WASTE)
        return known


replay = UnitHistory.replay


class Doses:
    """The doses of one unit, one at a time, at most one per sample.

    Attributes: ended_s: real time at which the last dose ended. foreign: fault of a dose that this run did not command.
      extra: volumes given beyond those booked when doses began, until the caller books them. refused: why the last
      doses gave nothing, one entry each.
    """

    def __init__(self, pumps: Pumps) -> None:
        self.pumps, self._book, self._config, self._clock = pumps, pumps.book, pumps.config, pumps.clock
        self.ended_s = self._due = -math.inf
        self.extra: list[Given] = []
        self.foreign: messages.ForeignDose | None = None
        self.refused = list[Message]()
        self.sample: tuple[float, int] | None = None
        self.carry_ml, self._count = 0.0, 0
        self._room_ml = vial_ml(pumps.unit.volume_ml) - pumps.unit.volume_ml  # above the tube; more overflows
        self._course: Iterator[float] | None = None
        self._strange: list[Event] = []
        self._ran_s, self._strange_ml = dict.fromkeys(PUMPS, 0.0), dict.fromkeys(PUMPS, 0.0)
        self._job = MEDIA  # job of the last dose
        self._now_ml, self._told_ml = np.zeros(3), np.zeros(3)  # largest, smallest feed, rise: estimated; and booked
        self._base_ml, self._taken_ml, self._ran_on = np.zeros(2), 0.0, False  # fed before this dose; of this dose

    @property
    def running(self) -> bool:
        """Whether a dose is under way, or may still run."""
        return self._course is not None

    def restore(self, history: UnitHistory) -> None:
        """Restore the state before a resume; find the outcome of an open dose, but never request it again."""
        self.sample, self.carry_ml, self._count = history.sample, history.carry_ml, history.doses
        if history.open:
            plan, self._job = Plan(history.feed_ml, history.waste_ml), ALT if history.pump == SPARE else MEDIA
            self._course = self._drained(self._look_for(history, plan), plan, history.id)

    def plan(self, rate: float, pump: int = 1) -> Plan:
        """Plan the dose of one period from its mean rate, mL/s, and the number of its pump. Raises: ValueError."""
        if not (rate >= 0.0 and math.isfinite(rate)):
            raise ValueError(f"pump rate = {rate} mL/s: allowed finite numbers >= 0")
        carries = rate > 0.0 and pump != SPARE
        asked = rate * self.pumps.unit.bench.period_s + (self.carry_ml if carries else 0.0)
        if asked < self._config.min_dose_ml:
            return Plan(carry_ml=asked if carries else self.carry_ml)
        feed = min(asked, self._config.max_dose_ml)
        return Plan(feed, self._config.waste_factor * feed, 0.0 if carries else self.carry_ml)

    def begin(self, rate: float, sample: tuple[float, int] | None, refusal: Message | None, pump: int = 1) -> Plan:
        """Begin the dose for `sample`, or note the reason against it. Raises: as `plan`; what the log raises."""
        plan = self.plan(rate, pump)
        if reason := refusal or self._obstacle(sample):
            if plan.feed_ml > 0.0:
                self._book.tell(NoDose(why=reason))
            return Plan(carry_ml=self.carry_ml)
        dosing = plan.feed_ml > 0.0
        self._count += dosing
        self.sample, self.carry_ml = sample, plan.carry_ml
        dose, on_s = f"{self.pumps.ours}{self.pumps.unit.name}/{self._count}", self._book.elapsed()
        self._book.write(
            "intent", sample=sample, rate=rate, feed_ml=plan.feed_ml, waste_ml=plan.waste_ml, carry_ml=plan.carry_ml,
            doses=self._count, on_s=on_s, id=dose, **({"feed_pump": f"Pump{pump}"} if pump == SPARE else {}),
        )  # fmt: skip
        if dosing:
            self._job = ALT if pump == SPARE else MEDIA
            self._course = self._drained(self._dose(plan, dose, on_s), plan, dose)
            self.work()
        return plan

    def _obstacle(self, sample: tuple[float, int] | None) -> Message | None:
        if sample is None or sample == self.sample:
            return NoNewSample()
        if self.running:
            return DoseUnderWay()
        return messages.DosedElsewhere() if self.pumps.box.on() or self.pumps.box.live(*DOSING_JOBS) else None

    def work(self) -> None:
        if self._course is None:
            self._settle_pins()
            if job := next((job for job in self.pumps.jobs if self.pumps.odd(job)), ""):
                name = f"{self.pumps.short}/{self._book.elapsed():.0f}"
                self._course = self._drained(self._silence(job, name), Plan(), name)
        if self._course is None or self._clock.now() < self._due:
            return
        try:
            self._due = self._clock.now() + next(self._course)
        except StopIteration:
            self._course, self.ended_s = None, self._clock.now()
            self._ran_s = {job: self.pumps.pins[job].ran_s for job in PUMPS}
            self._settle_strange()

    def take(self, events: list[Event]) -> None:
        """Add dosing events; those that belong to no dose of this run are booked after the current dose."""
        for event in events:
            key = event.pump, event.source
            self.pumps.reported[key] = max(self.pumps.reported[key] + event.ml, 0.0)  # a correction is negative
            if math.isfinite(self.pumps.counted[key]):
                self._strange.append(event)
        if self._course is None:
            self._settle_strange()

    def _dose(self, plan: Plan, dose: str, on_s: float) -> Iterator[float]:
        self._book.log("feed_on", on_s=on_s, id=dose)  # before the request, which may be carried out
        media, waste = (yield from self.pumps.give(self._job, plan.feed_ml, dose)), Moved()
        most_ml = max(plan.waste_ml, plan.feed_ml + LATE_ML)  # a job that ended late is drained by its waste, too
        if 0.0 < media.high <= most_ml and not (WASTE in self.pumps.barred or self._ran_on):
            waste = yield from self.pumps.give(WASTE, plan.waste_ml, dose)
        self._conclude(plan, dose, on_s, media, waste)

    def _look_for(self, history: UnitHistory, plan: Plan) -> Iterator[float]:
        """Find the outcome of the dose that was open before a resume and may still run."""
        pumps, dose, asked_ml = self.pumps, history.id, plan.feed_ml
        media, waste = Moved(), Moved()
        if history.fed:
            pumps.counted[self._job, dose] = pumps.counted[WASTE, dose] = math.inf
            unseen = messages.EndUnseen()
            media, waste = Moved(0.0, asked_ml, unseen), Moved(0.0, plan.waste_ml)
            if history.boot == pumps.boot and not history.wasted:
                now, ago_s = self._clock.now(), pumps.unit.clock.to_real(self._book.elapsed() - history.on_s)
                pin = pumps.pins[self._job]
                found, there = Request(self._job, 0.0, dose, now, pin.ran_s), pin.on or pumps.box.live(self._job)
                asked = found._replace(ml=asked_ml, asked_s=now - ago_s, task=history.task)
                if lost := pumps.box.state(self._job).word == "lost":  # its pin may be on without a report
                    pin.inits.append(asked.asked_s)  # a later report is of another process
                seen = yield from pumps.follow(asked) if there else pumps.end(asked if lost else found)
                media = seen._replace(
                    low=0.0, high=max(seen.high, asked_ml), end=(seen.end if seen.high else None) or unseen
                )
        self._conclude(plan, dose, history.on_s, media, waste)

    def _conclude(self, plan: Plan, dose: str, on_s: float, media: Moved, waste: Moved) -> None:
        for job, moved, ml in ((self._job, media, media.high), (WASTE, waste, waste.low)):
            self.pumps.counted[job, dose] = ml
            if moved.end:
                self._book.tell(messages.DoseEnd(pump=NAMES[job], end=moved.end))
        taken_ml, end = self._taken_ml, media.end or waste.end
        self.refused = [*self.refused, media.end] if media.end and not media.high else []
        row = Ending(on_s, media.high, taken_ml + waste.low, pump=NUMBERS[self._job], feed_low_ml=media.low).row()
        self._book.log("dose_end", **row, waste_high_ml=taken_ml + waste.high, id=dose, end=str(end or ""))
        self._ran_on = self._ran_on or media.high > plan.feed_ml + LATE_ML
        self._fed(media.high, media.low, waste.low)

    def _fed(self, high_ml: float, low_ml: float, taken_ml: float = 0.0) -> None:
        """Update the feed of this dose and the volume removed since; book the changes once they exceed LATE_ML."""
        fed_ml = self._base_ml + np.array([high_ml, low_ml])
        rise_ml = min(self._now_ml[2] + max(fed_ml[0] - self._now_ml[0], 0.0), self._room_ml)
        self._now_ml = np.array([*fed_ml, max(rise_ml - taken_ml, 0.0)])
        rest_ml = self._now_ml - self._told_ml
        if np.abs(rest_ml).max() > LATE_ML:
            more, less, rise = rest_ml.tolist()
            self.extra.append(Given(self._book.elapsed(), more, less, more - rise, NUMBERS[self._job]))
            self._told_ml = self._now_ml

    def _drained(self, course: Iterator[float], plan: Plan, name: str) -> Iterator[float]:
        """Run the steps of a dose; if its media pump runs on, drain the vial during the dose and after it.

        The largest possible feed is booked as it flows. Args: plan: volumes booked at the start. name: id of drains.
        """
        self._base_ml, self._taken_ml, self._ran_on, self.pumps.flowed_ml = self._now_ml[:2], 0.0, False, 0.0
        rise_ml = max(self._told_ml[2] + plan.feed_ml - plan.waste_ml, 0.0)
        self._told_ml = np.array([*(self._told_ml[:2] + plan.feed_ml), rise_ml])
        pumps, over, portion, number, left = self.pumps, False, None, 0, DRAINS
        while True:
            over = over or next(course, None) is None
            if not over and (pumps.runs_on or pumps.flowed_ml > plan.feed_ml + LATE_ML):
                self._fed(max(pumps.flowed_ml, plan.feed_ml, self._now_ml[0] - self._base_ml[0]), 0.0)
            twice = self._config.waste_factor
            wanted_ml = twice * self._now_ml[2] if over else 0.5 * (twice * pumps.flowed_ml - self._taken_ml)
            due = wanted_ml > (LATE_ML if over else 0.5 * DRAIN_ML * self._ran_on) and WASTE not in pumps.barred
            if portion is None and left and due and (self._ran_on if over else pumps.runs_on):
                wanted_ml, self._ran_on, left = max(wanted_ml, DRAIN_ML * (not over)), True, left - over
                portion, number = self._portion(wanted_ml, f"{name}/drain{number}"), number + 1
            if over and portion is None:
                return
            if portion is not None and next(portion, None) is None:
                portion = None
            yield STEP_S

    def _portion(self, ml: float, name: str) -> Iterator[float]:
        """Drain `ml` by the waste pump; count the reported volume, at the end the known volume."""
        before_ml, course, over = self._taken_ml, self.pumps.give(WASTE, ml, name), False
        self._book.tell(messages.Drained(ml=ml))
        while not over:
            taken_ml = self.pumps.reported[WASTE, name]
            try:
                yield next(course)
            except StopIteration as ended:
                taken_ml, over = ended.value.low, True
            more_ml, self._taken_ml = before_ml + taken_ml - self._taken_ml, before_ml + taken_ml
            high_ml, low_ml = self._now_ml[:2] - self._base_ml
            self._fed(high_ml, low_ml, more_ml)

    def _silence(self, job: str, name: str) -> Iterator[float]:
        """End a pump that runs without a job, or whose job was killed, and record the volume that it moved."""
        pin = self.pumps.pins[job]
        since = pin.on_s if pin.on and pin.on_s > -math.inf else self._clock.now()
        moved = yield from self.pumps.end(Request(job, 0.0, name, since, pin.ran_s))
        if moved.high > 0.0:
            self._give(job, moved.low, moved.high, f"the pump of {job} ran without its job")
        if job != WASTE:
            self._job = job
            self._ran_on = self._ran_on or moved.high > LATE_ML
            self._told_ml = self._told_ml + np.array([moved.high, moved.low, moved.high])
            self._fed(moved.high, moved.low)

    def _settle_pins(self) -> None:
        """Book volumes that pumps gave between this run's doses by their pins and that no event reported.

        The waste pump's volume of that time is booked with the media, because its event may have been counted before.
        """
        beside_ml = (self.pumps.pins[WASTE].ran_s - self._ran_s[WASTE]) * self.pumps.flow_ml_s[WASTE]
        for job in self.pumps.jobs:
            pin, box, now = self.pumps.pins[job], self.pumps.box, self._clock.now()
            if self.pumps.odd(job) or not (pin.on or box.live(job, *AUTOMATIONS) or now < pin.off_s + SETTLE_S):
                ran_ml = (pin.ran_s - self._ran_s[job]) * self.pumps.flow_ml_s[job] - self._strange_ml[job]
                self._ran_s[job], self._strange_ml[job] = pin.ran_s, 0.0
                if ran_ml > LATE_ML:
                    self._theirs(job, ran_ml, "by its pin", 0.0 if job == WASTE else beside_ml)

    def _settle_strange(self) -> None:
        """Book volumes that events reported without a command of this run, beyond those counted already."""
        strange, self._strange = self._strange, []
        for job, source in dict.fromkeys((event.pump, event.source) for event in strange):
            counted = self.pumps.counted[job, source]
            over = self.pumps.reported[job, source] - counted
            ours = source.startswith(self.pumps.ours)  # more may be booked than reported
            if abs(over) <= 1e-6 or (ours and over < 0.0) or job not in PUMPS:
                continue
            self.pumps.counted[job, source] = counted + over
            self._strange_ml[job] += over
            if source == self.pumps.short:
                self._give(job, over, over, f"short run of {job} to switch its pin off")
                continue
            self._theirs(job, over, "an earlier request ran late" if source.startswith(OURS) else f"by {source[:60]}")

    def _theirs(self, job: str, ml: float, who: str, beside_ml: float = 0.0) -> None:
        self.foreign = messages.ForeignDose(job=job, ml=ml, who=who)
        self._give(job, ml, ml, self.foreign.sentence, beside_ml)

    def _give(self, job: str, low_ml: float, high_ml: float, why: str, beside_ml: float = 0.0) -> None:
        """Record a volume that a pump moved without a dose of this run, at the time it was noticed."""
        fed = job != WASTE
        waste_ml = beside_ml if fed else high_ml
        given = Given(self._book.elapsed(), fed * high_ml, fed * low_ml, waste_ml, NUMBERS[job])
        self.extra.append(given)
        self._book.tell(messages.GivenBeside(why=why, low_ml=low_ml, high_ml=high_ml))
        self._book.log("given", **given.row(why))
