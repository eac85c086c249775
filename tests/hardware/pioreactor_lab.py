"""A unit and its broker in virtual time, as the vendor's software behaves in the rig: what days of faults need.

What a job says and when (init, ready, duty, event, duty off, disconnected), who says all pins again, what a lock, a
kill -9, a freeze, a power cut and a lost broker leave behind are those of the versions that were tried, as measured in
the rig (docs/pioreactor.md, Peculiarities of the vendor's software). Written from those measurements, not the driver.
"""

import heapq
import itertools
import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from hardware.clock import VirtualClock
from hardware.errors import LinkError, ReactorError
from hardware.pioreactor import reactors
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.doses import UnitHistory, replay
from hardware.pioreactor.mailbox import Mailbox
from hardware.pioreactor.messages import NotHeard, OtherClient, ServerFailed, TurnedAway
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.web import Web
from hardware.reactor import Command, Measurement
from hardware.safety.budget import FeedBudget
from hardware.safety.config import SafetyConfig

UNIT, EXPERIMENT, MEDIA_PIN, ALT_PIN, WASTE_PIN = "pio01", "turbidostat", 13, 16, 12
PINS = {"add_media": MEDIA_PIN, "add_alt_media": ALT_PIN, "remove_waste": WASTE_PIN}
FLOW = {"add_media": 0.7, "add_alt_media": 0.5, "remove_waste": 1.6}  # mL/s
BEGIN_S = 0.25  # from the answer 202 to the pin
STIR_S, OD_S = 26.0, 5.0
TUBE_ML, RIM_ML = 20.0, 40.0  # of the vial


class World(VirtualClock):
    """Time, the unit's processes and its pumps; `sleep` lets happen what is due.

    Switches: web, queue, broker (up or not); stirs (stirring runs, and says all pins); locks, of pins; heard (how a
    POST of a dose is answered); kill_after_s, freeze_after_s (after the pump of `strikes` began; frozen for frozen_s),
    stop_after_s (somebody stops it); late_s (a job ends its pump so much late); mute (a pin that goes on is not told);
    dies (a job is over at once); barred (jobs beside the readings do not start); begin_s; unkept (a job that is
    killed or frozen had not yet written down that its pin is on: the chip is told first); blind (no pins are told).

    Attributes: truth, mL by job; level_ml, in the vial when a pump last went on or off; asked, what was asked for.
    """

    def __init__(self, version: str = "26.11.1") -> None:
        super().__init__(1000.0)
        self.version, self.boot = version, "boot1"
        self.assigned: dict[str, Any] = {"experiment": EXPERIMENT, "is_active": 1}
        self.number, self.duty = tuple(map(int, version.split("."))), "30"
        self.box: Mailbox | None = None
        self.mqtt: Any = None
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self.web = self.queue = self.broker = self.stirs = True
        self.dies = self.mute = self.barred = self.deaf = self.stands = self.unkept = self.blind = False
        self.locks: set[int] = set()
        self.heard, self.begin_s, self.strikes = "yes", BEGIN_S, "add_media"
        self.holder: OtherClient | None = None
        self.kill_after_s = self.freeze_after_s = self.stop_after_s = np.inf
        self.frozen_s = self.late_s = 0.0
        self.reading, self.od_alive, self.od_s = 0.5, False, OD_S
        self.cache: dict[int, float] = {}  # what every message about pins says
        self.since: dict[int, float] = {}  # when a pin really went on
        self.truth, self.level_ml, self._level_s = dict.fromkeys(PINS, 0.0), TUBE_ML, self.now()
        self.rows: dict[str, int] = {"monitor": 1}  # listed jobs
        self.run_now: dict[str, list[Any]] = {}  # running pump jobs by name: [stopped, options]
        self.before: list[str] = []
        self.asked: list[tuple[str, Mapping[str, Any]]] = []
        self.accepted: dict[str, float] = {}
        self.waiting: list[Callable[[], None]] = []
        self.results: dict[str, bool] = {}
        self.retained: dict[str, str] = {}
        self.life = 0  # of the unit's power: what belongs to an earlier one does not happen any more

    def later(self, seconds: float, what: Callable[[], None]) -> None:
        life = self.life
        heapq.heappush(
            self._queue, (self.now() + seconds, next(self._order), lambda: what() if life == self.life else None)
        )

    def sleep(self, seconds: float) -> None:
        until = self.now() + seconds
        while self._queue and self._queue[0][0] <= until:
            at, _, what = heapq.heappop(self._queue)
            super().sleep(max(at - self.now(), 0.0))
            what()
        super().sleep(max(until - self.now(), 0.0))

    # -- messages --------------------------------------------------------------------------------------------------

    def say(self, rest: str, payload: str, retained: bool = False, experiment: str = EXPERIMENT) -> None:
        """A message; `retained`: it comes because somebody subscribes, not because it is said now."""
        topic = f"pioreactor/{UNIT}/{experiment}/{rest}"
        if rest.endswith(("$state", "_dc", "/dc", "target_temperature", "duty_cycle")) and (self.broker or self.stands):
            self.retained[topic] = payload
        if self.broker and self.box is not None:
            self.box.take(topic, payload.encode(), retained)

    def state(self, job: str, word: str) -> None:
        self.say(f"{job}/$state", word)

    def pins(self) -> None:
        """All pins of the unit, by whichever process."""
        self.say_pins({**self.cache, **({17: 30.0} if self.stirs else {})})

    def say_pins(self, duties: Mapping[int, float], **how: Any) -> None:
        """In the form of this version."""
        said = {str(channel): duties[pin] for channel, pin in enumerate((17, 13, 16, 12, 18), 1) if pin in duties}
        new = {"timestamp": self.stamp(), "channels": said}
        rest, what = ("pwms/dc", duties) if self.number < (26, 11) else ("pwms/channel_dc", new)
        if not self.blind:
            self.say(rest, json.dumps(what), **how)

    def stir(self) -> None:
        if self.stirs:
            if self.number < (26, 11):  # a newer one tells changes only
                self.pins()
            self.later(STIR_S, self.stir)

    def stamp(self) -> str:
        return f"t{self.now():.3f}/{next(self._order)}"

    def event(self, job: str, ml: float, source: str) -> None:
        body = {"volume_change": ml, "event": job, "source_of_event": source, "timestamp": self.stamp()}
        self.say("dosing_events", json.dumps(body))

    @staticmethod
    def od(value: float, stamp: str) -> str:
        return json.dumps({"timestamp": stamp, "ods": {"2": {"od": value, "channel": "2", "calibrated": 0}}})

    def _read(self) -> None:
        if self.od_alive:
            self.say("od_reading/ods", self.od(self.reading, f"t{self.now():.3f}"))
            self.later(self.od_s, self._read)

    # -- a pump and its job ----------------------------------------------------------------------------------------

    def pin(self, job: str, on: bool, told: bool = True) -> None:
        """A pin really goes on or off."""
        number, flows = PINS[job], {PINS[j]: ml_s if j != "remove_waste" else -ml_s for j, ml_s in FLOW.items()}
        rise_ml = sum(flows[pin] for pin in self.since) * (self.now() - self._level_s)
        self.level_ml, self._level_s = min(max(self.level_ml + rise_ml, TUBE_ML), RIM_ML), self.now()
        if on:
            self.cache[number] = 100.0
            self.since.setdefault(number, self.now())
        else:
            self.cache.pop(number, None)
            if number in self.since:
                self.truth[job] += (self.now() - self.since.pop(number)) * FLOW[job]
        if told:
            self.pins()

    def dose(self, job: str, options: Mapping[str, Any]) -> None:
        """What a pump job does from its process's start on."""
        self.rows[job] = self.rows.get(job, 0) + 1
        self.state(job, "init")
        self.later(0.04, lambda: self.state(job, "ready"))
        if PINS[job] in self.locks:  # refused with nothing but a line in a log
            self.later(0.1, lambda: self.over(job))
            return
        me: list[Any] = [False, options]
        self.run_now[job] = me
        seconds = float(options["duration"]) if "duration" in options else float(options["ml"]) / FLOW[job]
        self.pin(job, False, told=False)  # whoever takes a pin switches it off first
        self.later(0.05, lambda: self._pumps(job, me, seconds))

    def _pumps(self, job: str, me: list[Any], seconds: float) -> None:
        source, flow, began, told = str(me[1].get("source-of-event", "CLI")), FLOW[job], self.now(), [0.0]
        short = "duration" in me[1]
        self.locks.add(PINS[job])
        self.pin(job, True, told=False)
        thawed = [-np.inf]

        def tell() -> None:
            if not self.mute and self.run_now.get(job) is me:
                late = thawed[0] - self.now() - 1e-3
                self.pins() if late <= 0.0 else self.later(late, tell)

        kill = np.inf if short or job != self.strikes else self.kill_after_s
        freeze = np.inf if short or job != self.strikes else self.freeze_after_s
        if min(kill, freeze) < np.inf and self.unkept:
            self.cache.pop(PINS[job])
        stop = np.inf if job != self.strikes else self.stop_after_s

        def slice_() -> None:
            nonlocal freeze
            if self.run_now.get(job) is not me:
                return
            passed = self.now() - began
            if passed >= freeze:
                freeze, thawed[0] = np.inf, self.now() + self.frozen_s
                self.later(15.0 + 1.0, lambda: self._lost(job, me))
                ends = passed + self.frozen_s > seconds
                self.later(self.frozen_s, (lambda: self._thaws(job, me)) if ends else slice_)
                return
            if me[0] or passed >= seconds + self.late_s - 1e-9 or passed >= stop - 1e-9:
                self._ends(job, me, flow * min(passed, seconds) if me[0] or stop < seconds else None, told)
                return
            if passed >= kill:
                self.killed(job)
                return
            if passed >= 0.5 * len(told[1:]) - 1e-9 and told[0] < flow * seconds - 1e-9:
                part = min(0.5 * flow, flow * seconds - told[0])
                told[0] += part
                told.append(part)
                self.event(job, part, source)
            stops = (x for x in (seconds + self.late_s, kill, freeze, stop, 0.5 * len(told[1:])) if x > passed)
            self.later(max(min(min(stops) - passed, 0.1), 1e-3), slice_)

        slice_()
        self.later(0.015, tell)

    def circulate(self, seconds: float) -> None:
        """The vendor's job that runs waste, and media now and then, and tells nothing of what media gave."""
        job, end = "circulate_media", self.now() + seconds

        def spell(on: bool) -> None:
            self.pin("add_media", on)
            if self.now() < end or on:
                self.later(0.8, lambda: spell(not on))
            else:
                self.pin("remove_waste", False)
                self.say(f"{job}/$state", "disconnected", experiment="another")

        self.say(f"{job}/$state", "ready", experiment="another")
        self.event("remove_waste", 20.0, "CLI")
        self.pin("remove_waste", True)
        spell(True)

    def _ends(self, job: str, me: list[Any], really: float | None, told: list[float]) -> None:
        """A job ends by itself or by MQTT: pin off, then the correction of what was told."""
        del self.run_now[job]
        self.locks.discard(PINS[job])
        self.pin(job, False)
        if really is not None and abs(really - told[0]) > 1e-9:
            self.event(job, really - told[0], str(me[1].get("source-of-event", "CLI")))
        self.later(0.03, lambda: self.over(job))

    def over(self, job: str) -> None:
        self._unlist(job)
        self.state(job, "disconnected")

    def _unlist(self, job: str) -> None:
        self.rows[job] = self.rows.get(job, 1) - 1
        if self.rows[job] <= 0:
            self.rows.pop(job)

    def killed(self, job: str) -> None:
        """kill -9 of a pump job: its lock and its row stay, and its pin as it was."""
        self.run_now.pop(job, None)
        self.state(job, "lost")

    def _lost(self, job: str, me: list[Any]) -> None:
        if self.run_now.get(job) is me:
            me.append("lost")
            self.state(job, "lost")

    def _thaws(self, job: str, me: list[Any]) -> None:
        """A job that was frozen goes on: it has missed its end. One that the broker gave up says nothing any more."""
        del self.run_now[job]
        self.locks.discard(PINS[job])
        self.pin(job, False, told=len(me) < 3)
        self._unlist(job)
        if len(me) < 3:
            self.state(job, "disconnected")

    def heard_set(self, topic: str, payload: str) -> None:
        """What a client says to jobs."""
        _, _, _, job, *rest = topic.split("/")
        if job in self.run_now and rest == ["$state", "set"] and self.freeze_after_s == np.inf:
            self.run_now[job][0] = True
        elif job in ("temperature_automation", "dosing_automation", "stirring") and rest == ["$state", "set"]:
            self.later(0.2, lambda: self.over(job))
        elif (job, rest) == ("stirring", ["duty_cycle", "set"]) and self.stirs and not self.deaf:
            if payload != self.duty or self.number < (26, 11):
                self.later(0.3, self.pins)
            self.duty = payload
            self.say("stirring/duty_cycle", payload)
        ready = self.retained.get(f"pioreactor/{UNIT}/{EXPERIMENT}/{job}/$state") == "ready"
        if rest == ["target_temperature", "set"] and ready and not self.deaf:
            self.say(f"{job}/target_temperature", payload)

    # -- task queue, power, broker ---------------------------------------------------------------------------------

    def take(self, task: str, job: str, options: Mapping[str, Any]) -> None:
        """The task queue takes a request."""
        if (self.dies and "help" not in options) or ("help" in options and self.version < "26"):
            self.results[task] = False
            return
        self.results[task] = True
        if job in PINS and "help" not in options:
            self.later(self.begin_s - 0.05, lambda: self.dose(job, options))
        elif job == "od_reading":
            self.od_alive = True
            self.rows[job] = 1
            self.state(job, "ready")
            self.later(self.od_s, self._read)
        elif "help" not in options and not self.barred:
            self.rows[job] = 1
            self.later(1.0, lambda: self.state(job, "init"))
            self.later(2.0, lambda: self.ready(job, options))

    def ready(self, job: str, options: Mapping[str, Any]) -> None:
        self.state(job, "ready")
        if job == "temperature_automation":
            self.say(f"{job}/target_temperature", str(options["target-temperature"]))
        if job == "stirring":
            self.stirs, self.duty = True, "30"
            self.pins()
            self.say("stirring/duty_cycle", "30")
            self.stir()

    def revive(self) -> None:
        """The task queue comes back and runs what waits in it."""
        self.queue, waiting, self.waiting = True, self.waiting, []
        for what in waiting:
            what()

    def cut(self) -> None:
        """The unit loses its power: everything ends, and nobody says so."""
        for job in PINS:
            self.pin(job, False, told=False)
        self.life += 1
        self.cache, self.rows, self.run_now, self.waiting, self.results = {}, {}, {}, [], {}
        self.locks.clear()
        self.od_alive = self.stirs = self.web = False
        self.later(60.0, self._given_up)

    def _given_up(self) -> None:
        """The broker gives up clients that it has not heard for long."""
        for job in ("od_reading", "stirring", "temperature_automation", *PINS):
            if self.retained.get(f"pioreactor/{UNIT}/{EXPERIMENT}/{job}/$state") in ("init", "ready"):
                self.state(job, "lost")

    def power(self) -> None:
        """The unit boots; its jobs are lost since the broker noticed."""
        self.boot, self.rows, self.web, self.queue = f"boot{self.now():.0f}", {"monitor": 1}, True, True
        self._given_up()

    def lose_broker(self, back_s: float) -> None:
        """The broker dies: pump jobs end with it, what it retained is gone; it is back after a while."""
        self.broker = False
        self.mqtt.broke_s = self.now()
        self.retained.clear()
        for job in list(self.run_now):
            del self.run_now[job]
            self.locks.discard(PINS[job])
            self.pin(job, False)
            self._unlist(job)
        self.later(back_s, self._broker_back)

    def freeze_broker(self, for_s: float) -> None:
        """The broker stands still: who asks it often leaves it, what is said meanwhile is there when it goes on."""
        self.broker, self.stands = False, True
        ours = (f"pioreactor/{UNIT}/{EXPERIMENT}/{job}/$state" for job in PINS)
        self.before = [topic for topic in ours if self.retained.get(topic) in ("init", "ready")]
        self.mqtt.broke_s = self.now()
        self.later(for_s, self._broker_goes_on)

    def _broker_goes_on(self) -> None:
        self.broker, self.stands = True, False
        assert self.box is not None
        self.box.forget()
        for topic in self.before:  # who left it meanwhile is taken for lost
            self.retained[topic] = "lost"
        for topic, payload in self.retained.items():
            self.box.take(topic, payload.encode(), True)

    def _broker_back(self) -> None:
        self.broker = True
        assert self.box is not None
        self.box.forget()
        if self.version < "26":  # the newer one says nothing any more
            for job in ("od_reading", "stirring", "temperature_automation"):
                if job in self.rows:
                    self.state(job, "ready")
        else:
            self.deaf = True


class FakeWeb:
    """`hardware.pioreactor.web.Web` of the unit; what is asked for is answered a moment later."""

    def __init__(self, world: World) -> None:
        self.world, self.url, self._count = world, "http://pio01.local", itertools.count()
        poly: Any = {"type": "poly", "coefficients": [0.0, 0.0]}
        self.active: dict[str, Any] = {}
        for job, pump in zip(FLOW, ("media_pump", "alt_media_pump", "waste_pump"), strict=True):
            line = [FLOW[job], 0.0]
            curve = line if world.version < "26" else {**poly, "coefficients": line}
            self.active[pump] = {"curve_data_": curve}
        self.settings: dict[str, Any] = {}
        self.levels: list[float] = []

    def ask(self, what: Callable[..., Any], *given: Any) -> "Future[Any]":
        future: Future[Any] = Future()

        def answer() -> None:
            try:
                future.set_result(what(*given))
            except ReactorError as error:
                future.set_exception(error)

        heapq.heappush(self.world._queue, (self.world.now() + 0.01, next(self.world._order), answer))
        return future

    def _up(self) -> None:
        if not self.world.web:
            raise NotHeard("http://pio01.local: refused")

    def get(self, path: str, below: str = "/unit_api") -> Any:
        self._up()
        if path == "/active_calibrations":
            return self.active
        if path.startswith("/jobs/settings"):
            if "dosing_automation" not in self.world.rows:
                raise TurnedAway(url="http://pio01.local", status=404, reason="no")
            return {"settings": self.settings}
        if path == f"/workers/{UNIT}/experiment":
            if not self.world.assigned:
                raise TurnedAway(url="http://pio01.local", status=404, reason="no")
            return self.world.assigned
        return {
            "/health": {"pioreactor_unit": UNIT, "utc_time": "2026-11-21T00:00:00Z"},
            "/versions/app": {"version": self.world.version},
        }[path]

    def run(self, job: str, options: Mapping[str, Any], overrides: Any = ()) -> str:
        self._up()
        w, task = self.world, f"task{next(self._count)}"
        dose = "ml" in options
        if dose and w.heard == "429":
            raise TurnedAway(url="http://pio01.local", status=429, reason="no")
        if dose and w.heard == "500":
            raise ServerFailed(url="http://pio01.local", status=500, reason="no")
        if w.now() < w.accepted.get(job, -np.inf) + 1.0:  # one request a second for each job
            raise TurnedAway(url="http://pio01.local", status=429, reason="no")
        w.accepted[job] = w.now()
        w.asked.append((job, options))
        if job == "dosing_automation":
            self.settings = {key.replace("-", "_"): value for key, value in options.items()}
        if not (dose and w.heard == "nobody"):
            if w.queue:
                w.take(task, job, options)
            else:
                w.waiting.append(lambda: w.take(task, job, options))
        if dose and w.heard in ("lost answer", "nobody"):
            raise LinkError("timed out")
        return task

    astray = Web.astray
    _experiment = EXPERIMENT

    def set_level(self, level_ml: float) -> str:
        self._up()
        self.levels.append(level_ml)
        return ""

    def stop(self, job: str) -> None:
        self._up()
        if job == "od_reading" and job in self.world.rows:
            self.world.later(0.5, lambda: self.world.over(job))
        if job in self.world.run_now and self.world.freeze_after_s == np.inf:
            self.world.later(0.1, lambda: self.world.run_now.get(job, [False]).__setitem__(0, True))

    def result(self, task: str) -> bool | None:
        self._up()
        results = self.world.results
        return results.pop(task, None) if self.world.version < "26" else results.get(task)

    def running(self) -> list[dict[str, Any]]:
        self._up()
        return [
            {"job_name": job, "started_at": self.world.boot} for job, n in self.world.rows.items() for _ in range(n)
        ]

    def close(self) -> None:
        pass


class FakeCluster:
    """`hardware.pioreactor.mailbox.Cluster`."""

    def __init__(self, config: PioreactorConfig, boxes: dict[str, Mailbox], name: str, clock: World) -> None:
        self.boxes, self.world, self.broke_s, self.refusal, self.lost = boxes, clock, -np.inf, "", ""
        self.said: list[tuple[str, str]] = []
        clock.mqtt, clock.box = self, boxes[UNIT]
        for topic, payload in clock.retained.items():
            boxes[UNIT].take(topic, payload.encode(), True)

    @property
    def connected(self) -> bool:
        return self.world.broker

    def publish(self, topic: str, payload: str) -> None:
        self.said.append((topic, payload))
        if self.world.broker:
            self.boxes[UNIT].take(topic, payload.encode(), False)  # we hear ourselves
            self.world.heard_set(topic, payload)

    def hold(self) -> None:
        self.held = True

    def holder(self, unit: str) -> OtherClient | None:
        return self.world.holder

    def close(self) -> None:
        pass


class Lab:
    """The driver around the unit. Attributes: world, reactors, rows of the journal."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, world: World | None = None, **values: Any) -> None:
        self.world = world or World()
        self.web = FakeWeb(self.world)
        monkeypatch.setattr(reactors, "Web", lambda *_given: self.web)
        monkeypatch.setattr(reactors, "Cluster", FakeCluster)
        self.rows: list[dict[str, Any]] = []
        self.bench = Bench(
            **{key: values.pop(key) for key in ("period_s", "bottle_ml", "volume_ml", "volumes_ml") if key in values}
        )
        config = PioreactorConfig(**{"thermostat": False, **values})
        self.reactors = PioreactorReactors(config, self.world, self._log, "run", self.bench)
        self.station = self.reactors.stations[0]

    def resumed(self, monkeypatch: pytest.MonkeyPatch, away_s: float, elapsed_s: float, **values: Any) -> "Lab":
        """A program that was killed and goes on from the rows of its journal, so long afterwards."""
        rows, self.world.box = list(self.rows), None
        self.world.sleep(away_s)
        again = Lab(monkeypatch, self.world, **values)
        again.rows = rows
        again.begin(replay(rows)[UNIT], elapsed_s + away_s)
        return again

    def well(self, limit_s: float = 100.0) -> None:
        """Wait until there is no fault, and no dose is under way."""
        self.until(lambda: self.fault is None and not self.station.doses.running, limit_s)

    def check_given(self, slack_ml: float) -> None:
        """What flowed of medium lies within what is on record."""
        low, high = self.given()
        assert low - slack_ml <= self.world.truth["add_media"] <= high + slack_ml

    @property
    def fault(self) -> Any:
        return self.station.book.fault

    def _log(self, kind: str, fields: Mapping[str, Any]) -> None:
        self.rows.append({"n": len(self.rows), "wall": 0.0, "kind": kind, **fields})

    def begin(self, history: UnitHistory | None = None, elapsed_s: float = 0.0) -> None:
        self.reactors.begin({UNIT: history} if history else None, elapsed_s)

    def sample(self, tries: int = 20) -> Measurement:
        """The next fresh sample."""
        for _ in range(tries):
            m = self.reactors.measure()
            if m.fresh[0]:
                return m
        raise AssertionError(f"no sample in {tries} looks: {m.vitals}")

    def dose(self, ml: float, pump: int = 1) -> float:
        """Ask for this volume; what the receipt says."""
        rate = np.array([ml / self.bench.period_s])
        rows, nothing = np.array([True]), np.array([np.nan])
        self.receipt = self.reactors.actuate(Command(rows, rate, nothing, pump=np.array([pump])))
        return float(self.receipt.volume_ml[0])

    def wait(self, seconds: float) -> None:
        """Let the unit and the driver go on."""
        for _ in range(int(seconds / 0.1)):
            self.world.sleep(0.1)
            self.station.poll()

    def until(self, holds: Callable[[], bool], limit_s: float) -> float:
        """Wait until something holds; how long that took."""
        began = self.world.now()
        while not holds():
            assert self.world.now() < began + limit_s, (self.fault, self.rows[-5:])
            self.wait(0.1)
        return self.world.now() - began

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["kind"] == kind]

    def asked(self, job: str) -> list[Mapping[str, Any]]:
        """Real requests for a pump job."""
        return [options for name, options in self.world.asked if name == job and "ml" in options]

    def given(self) -> tuple[float, float]:
        """Least and most medium by the journal, mL."""
        rows = [row for row in self.rows if row["kind"] in ("dose_end", "given")]
        return sum(row["feed_low_ml"] for row in rows), sum(row["feed_ml"] for row in rows)

    def ledger(self, planned_ml: float) -> FeedBudget:
        """What the interlock has booked: a dose when it began, with all that the driver said of it since."""
        budget = FeedBudget(SafetyConfig(), self.bench, self.bench.volumes([UNIT]), np.full(1, 1e3))
        budget.book(np.array([planned_ml]), np.array([2.0 * planned_ml]), 0.0)
        self.book(budget)
        return budget

    def book(self, budget: FeedBudget) -> None:
        """Book what the driver said of doses since the last time."""
        for at, receipt in self.reactors.repeated():
            budget.book(receipt.volume_ml, receipt.waste_ml, at)


def sampled(*given: Any, **values: Any) -> Lab:
    """A lab whose run has begun and has its first sample."""
    made = Lab(*given, **values)
    made.begin()
    made.sample()
    return made
