"""One pump job of the vendor's from its request to its end, and what ends a pump that should not run.

The vendor's 202 says only that a request was written down. A job has begun when an event with its id arrives, and is
over when its events add up, the job is gone and its pin is off.
"""

import contextlib
import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass

from hardware.clock import Clock
from hardware.errors import ReactorError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.logbook import Logbook
from hardware.pioreactor.mailbox import Mailbox, Mqtt
from hardware.pioreactor.web import NotHeard, Web

__all__ = ["ASK_S", "LATE_ML", "MEDIA", "OURS", "UNSTARTED_S", "WASTE", "Course", "Given", "PumpJobs", "Steps"]

STEP_S, ASK_S, OVERRUN_S, SETTLE_S = 0.1, 0.5, 6.0, 1.0  # real seconds
UNSTARTED_S = 120.0  # real seconds that a process may take from the queue to its first word, on a busy unit
PROBE_S = 30.0  # real seconds between two harmless requests that show whether the task queue works
SHORT_S, AGAIN_S = 0.1, 6.0  # real seconds: a run of a pump that ends with its pin off; between two of them
LATE_ML = 0.1  # messages are late by some hundredths of a second
ROUNDED_S = 0.5  # a dose that is stopped early is told up to the next half second of its pump
OURS = "turbidostat/"
MEDIA, WASTE = "add_media", "remove_waste"


@dataclass(frozen=True)
class Given:
    """What a pump moved, mL: at least low, at most high. end: in words, "" for a dose that went as asked."""

    low: float
    high: float
    end: str = ""


Course = Iterator[float]
Steps = Generator[float, None, Given]


class Barrier:
    """Whether nothing older waits in the task queue any more: a harmless request behind it was taken.

    The request is made anew now and then, because a unit that boots forgets what was written down. Args: wait_s: real
    seconds until it is made first.
    """

    def __init__(self, web: Web, book: Logbook, clock: Clock, speed: float, wait_s: float = 0.0) -> None:
        self._web, self._book, self._clock, self._speed = web, book, clock, speed
        self._task, self._due = "", clock.now() + wait_s * speed

    def passed(self) -> bool:
        """Ask; trouble on the way is an answer that is not there yet."""
        with contextlib.suppress(ReactorError):
            if self._task and self._web.result(self._task) is not None:
                return True
            if self._clock.now() >= self._due:
                self._task = self._web.run(MEDIA, {"help": None}, self._book.env, [])
                self._due = self._clock.now() + PROBE_S * self._speed
        return False


class PumpJobs:
    """The pump jobs of one unit. Args: as of `Doses`.

    Attributes: flow_ml_s, of media and waste pump by their active calibrations; trouble, why no dose may be given, ""
      if one may.
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
        self.trouble = ""
        self.doubt: set[str] = set()  # jobs whose process was killed: whether their pumps run is not known
        self._cycled_s = -math.inf
        self._cycle: Barrier | None = None
        self._told: dict[tuple[str, str], float] = {}

    def pump(self, job: str, ml: float, dose: str) -> Steps:
        """Ask for one pump job and follow it; what it gave."""
        key, ml = (job, dose), round(ml, 4)
        breaks, asked, ran_s = self._mqtt.breaks, self._clock.now(), self._ran_s(job)
        task: str | None = None
        try:
            task = self._web.run(job, {"ml": ml, "source-of-event": dose}, self._book.env, [])
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
            return self._at_most((yield from self._unknown(key, ml, task, (breaks, asked))), job, ran_s)
        return self._at_most((yield from self._follow(key, ml, breaks)), job, ran_s)

    def _at_most(self, given: Given, job: str, before_s: float) -> Given:
        """What its pin's on-time says beyond its events: a job times itself, and on a busy unit it does that late."""
        ran_ml = (self._ran_s(job) - before_s) / self._config.speed * self.flow_ml_s[job]
        if not ran_ml > given.high + LATE_ML:
            return given
        return Given(
            given.low, ran_ml, given.end or f"its pin was on for {ran_ml:.2f} mL, {given.high:.2f} mL were told"
        )

    def _ran_s(self, job: str) -> float:
        """How long the pin of a job has run, clock seconds."""
        pin = self._config.pump_pins[0 if job == MEDIA else -1]
        return self._box.ran_s.get(pin, 0.0)

    def _follow(self, key: tuple[str, str], ml: float, breaks: int) -> Steps:
        """A pump that has begun, until its pin is off and its job gone."""
        job, began, flow = key[0], self._clock.now(), self.flow_ml_s[key[0]]
        expected_s = ml / flow if flow > 0.0 else 60.0
        late = began + (expected_s + OVERRUN_S) * self._config.speed
        while (self._box.running_pins(self._config.pump_pins) or self._box.live(job)) and not self._box.lost(job):
            if self._clock.now() > late and self._mqtt.connected:
                yield from self._overrun(job)
                break
            yield STEP_S
        told = self._told.get(key, 0.0)
        if self._mqtt.breaks != breaks or self._box.lost(job):
            if not self._box.lost(job):
                return Given(0.0, ml, "the broker was lost in a dose: counted whole")
            return (yield from self._killed(job, ml, began))
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
                f"pio cache clear pwm_locks {pins[0]} --as-int (it is then cycled from here)"
            )
            yield self._config.retry_s
        self.trouble = ""

    def _killed(self, job: str, ml: float, began: float) -> Steps:
        """What a job gave whose process was killed: at most what its pump moves until it is proven off."""
        yield from self.prove_off(job)
        ran_s = (self._clock.now() - began) / self._config.speed + ROUNDED_S
        why = "its process was killed: counted as if its pump had run until it was proven off"
        return Given(0.0, max(ml, ran_s * self.flow_ml_s[job]), why)

    def prove_off(self, job: str) -> Course:
        """Switch the pin of a killed job on and off until the unit says that it did.

        The process may have been killed between the pin and the word on it, so that what was told of the pin says
        nothing. The lock that it left refuses every further job of that pump, also this one, until the operator clears
        it; that is what the trouble says meanwhile.
        """
        self.doubt.add(job)
        pin, source = self._config.pump_pins[0 if job == MEDIA else -1], f"{OURS}{self._run}/{self.unit}/off"
        self.trouble = (
            f"pin {pin} may run on after {job}, whose process was killed; pull the pump's plug, or on the unit: "
            f"pio cache clear pwm_locks {pin} --as-int (it is then cycled from here)"
        )
        self._book.tell(self.trouble)
        while True:
            told, again = self._told.get((job, source), 0.0), self._clock.now() + AGAIN_S * self._config.speed
            self._switch(job)
            while self._clock.now() < again or self._box.live(job):
                yield STEP_S
                cycled = self._told.get((job, source), 0.0) > told and not self._box.lost(job)
                if cycled and not self._box.live(job) and pin not in self._box.running_pins([pin]):
                    self.doubt.discard(job)
                    self.trouble, self._cycle = "", None
                    return

    def _unknown(self, key: tuple[str, str], ml: float, task: str | None, at: tuple[int, float]) -> Steps:
        """A request that was, or may have been, written down and did nothing yet: wait until it can do nothing more.

        It is over when its task, or one that was queued behind it, was taken from the queue, no job of its name runs
        and no pin does. Without a break of the broker its events then are the truth. Args: at: breaks of the broker
        until it was asked for, and when that was.
        """
        job, (breaks, asked) = key[0], at
        self.trouble = f"the fate of a dose of {ml:.2f} mL ({job}) is unknown: task queue or broker do not answer"
        self._book.tell(self.trouble)
        barrier, taken, died = self._barrier(PROBE_S if task else 0.0), False, False
        while not taken:
            if self._told.get(key, 0.0) > 0.0:
                self.trouble = ""
                self._book.tell(f"{job} of {ml:.2f} mL ran late")
                return (yield from self._follow(key, ml, breaks))
            with contextlib.suppress(ReactorError):
                said = self._web.result(task) if task else None
                taken, died = said is not None, said is False  # False: its process is over and did nothing
            taken = taken or barrier.passed()
            yield ASK_S
        latest = self._clock.now() + UNSTARTED_S * self._config.speed  # a process may take long to start
        while not (died or self._box.been(job, asked) or self._clock.now() > latest) or not self.off():
            if self._box.lost(job):
                return (yield from self._killed(job, ml, asked))
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
        self._switch(jobs[pins[0]])

    def _switch(self, job: str) -> None:
        """Ask for a short run of a pump, unless an earlier one may still wait: requests do not expire."""
        if self._cycle is None or self._cycle.passed():
            self._cycle = self._barrier()
            source = f"{OURS}{self._run}/{self.unit}/off"
            with contextlib.suppress(ReactorError):
                self._web.run(job, {"duration": SHORT_S, "source-of-event": source}, self._book.env, [])

    def _barrier(self, wait_s: float = 0.0) -> Barrier:
        return Barrier(self._web, self._book, self._clock, self._config.speed, wait_s)

    def stop_by_web(self) -> None:
        """The same by HTTP, which rounds what was given. Raises: ReactorError."""
        for job in (MEDIA, WASTE):
            self._web.post(f"/jobs/stop?job_name={job}")

    def off(self) -> bool:
        """Whether no pump runs, no dosing job of ours is there and none was killed, by what the unit said last."""
        doubt = self.doubt or any(self._box.lost(job) for job in (MEDIA, WASTE))
        live = self._box.live(MEDIA) or self._box.live(WASTE)
        return not (self._box.running_pins(self._config.pump_pins) or live or doubt)
