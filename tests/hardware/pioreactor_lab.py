"""Two doubles of the vendor's side in virtual time: a unit's web server and the broker, answering as recorded.

The order and spacing of what a job says (init, ready, event, duty, event, duty off, disconnected) and every odd answer
are those of version 25.11.19 around `add_media` of 0.7 mL, as the rig recorded them;
docs/pioreactor.md, What is odd in the vendor's software.
"""

import heapq
import itertools
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from hardware.clock import VirtualClock
from hardware.errors import LinkError, ProtocolError
from hardware.pioreactor import reactors, station
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Mailbox
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.resume import History
from hardware.pioreactor.web import NotHeard
from hardware.reactor import Command, Measurement

UNIT, EXPERIMENT, MEDIA_PIN, WASTE_PIN = "pio01", "turbidostat", 13, 12
PINS = {"add_media": MEDIA_PIN, "remove_waste": WASTE_PIN}
BEGIN_S = 0.4  # from the answer 202 to the first event


class World(VirtualClock):
    """Time, the unit's processes and its vial; `sleep` lets happen what is due.

    Switches: web, queue, broker (up or not), lock (a pin lock left behind), heard (how a POST of a dose is answered),
    kill_after_s (a dose's process is killed so long after its pump began), late_s (a job ends its pump so much late),
    mute (a pin that goes on is not told), dies (a job is over at once), barred (jobs beside the readings do not start).
    """

    def __init__(self) -> None:
        super().__init__(1000.0)
        self.box: Mailbox | None = None
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self.web = self.queue = self.broker = True
        self.lock = self.od_alive = False
        self.heard = "yes"
        self.kill_after_s = self.stop_after_s = np.inf
        self.reading, self.od_every_s, self.clock_jump_s = 0.5, 5.0, 0.0
        self.late_s = 0.0
        self.dies = False
        self.mute = self.barred = False
        self.holder = ""
        self.waiting: list[Callable[[], None]] = []
        self.duty: dict[int, float] = {}
        self.since: dict[int, float] = {}
        self.moved = {"add_media": 0.0, "remove_waste": 0.0}
        self.runs: list[tuple[str, Mapping[str, Any]]] = []
        self.stops: list[str] = []
        self.results: dict[str, bool] = {}
        self.jobs: dict[str, bool] = {}
        self.mqtt: Any = None

    def later(self, seconds: float, what: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (self.now() + seconds, next(self._order), what))

    def sleep(self, seconds: float) -> None:
        until = self.now() + seconds
        while self._queue and self._queue[0][0] <= until:
            at, _, what = heapq.heappop(self._queue)
            super().sleep(at - self.now())
            what()
        super().sleep(until - self.now())

    def say(self, rest: str, payload: str, retained: bool = False, experiment: str = EXPERIMENT) -> None:
        if self.broker and self.box is not None:
            self.box.take(f"pioreactor/{UNIT}/{experiment}/{rest}", payload.encode(), retained)

    def od_job(self) -> None:
        self.od_alive = True
        self.say("od_reading/$state", "ready")
        self.later(self.od_every_s, self._read)

    def _read(self) -> None:
        if self.od_alive:
            self.say("od_reading/ods", self.od(self.reading, f"t{self.now() + self.clock_jump_s:.3f}"))
            self.later(self.od_every_s, self._read)

    @staticmethod
    def od(value: float, stamp: str) -> str:
        return json.dumps({"timestamp": stamp, "ods": {"2": {"od": value, "channel": "2", "calibrated": 0}}})

    def event(self, job: str, ml: float, source: str) -> None:
        body = {"volume_change": ml, "event": job, "source_of_event": source, "timestamp": "t"}
        self.say("dosing_events", json.dumps(body))

    def pin(self, job: str, on: bool) -> None:
        pin = PINS[job]
        if on:
            self.duty[pin] = 100.0
            self.since.setdefault(pin, self.now())
        elif pin in self.duty:
            del self.duty[pin]
            self.moved[job] += self.now() - self.since.pop(pin)
        if not (on and self.mute):
            self.say("pwms/dc", json.dumps(self.duty), retained=True)

    def dose(self, job: str, options: Mapping[str, Any]) -> None:
        """What one pump job does, 1 mL/s."""
        ml, source = float(options["ml"]), str(options["source-of-event"])
        self.jobs[job] = True
        self.say(f"{job}/$state", "ready")
        if self.lock:  # refused with nothing but a line in a log
            self.later(0.1, lambda: self.end(job))
            return
        cut = min(self.kill_after_s, self.stop_after_s, ml)
        for k in range(int(np.ceil(cut / 0.5 - 1e-9))):
            part = min(0.5, ml - 0.5 * k)
            self.later(0.5 * k, lambda part=part: self.event(job, part, source))  # type: ignore[misc]
        self.later(0.03, lambda: self.pin(job, True))
        if self.kill_after_s < ml:
            self.later(0.03 + self.kill_after_s, lambda: self.killed(job))
        else:
            self.later(0.03 + cut + self.late_s, lambda: self.pin(job, False))
            self.later(0.05 + cut + self.late_s, lambda: self.end(job))

    def killed(self, job: str) -> None:
        """kill -9 of a pump job: its lock stays, and its pin as it was."""
        self.lock = True
        self.jobs.pop(job, None)
        self.say(f"{job}/$state", "lost")

    def cycle(self, job: str, options: Mapping[str, Any]) -> None:
        """A short run of a pump, which leaves its pin off whatever it was; a lock refuses it."""
        self.jobs[job] = True
        self.say(f"{job}/$state", "ready")
        seconds = float(options["duration"])
        if not self.lock:
            self.event(job, seconds, str(options["source-of-event"]))
            self.pin(job, True)
            self.later(seconds, lambda: self.pin(job, False))
        self.later(seconds + 0.1, lambda: self.end(job))

    def end(self, job: str) -> None:
        self.jobs.pop(job, None)
        self.say(f"{job}/$state", "disconnected")

    def take(self, task: str, job: str, options: Mapping[str, Any]) -> None:
        """The task queue takes a request."""
        if self.dies and "help" not in options:
            self.results[task] = False
            return
        self.results[task] = "help" not in options
        if job in PINS and "ml" in options:
            self.later(BEGIN_S, lambda: self.dose(job, options))
        if job in PINS and "duration" in options:
            self.later(BEGIN_S, lambda: self.cycle(job, options))
        if job == "od_reading":
            self.later(1.0, self.od_job)
        if job in ("dosing_automation", "stirring", "temperature_automation") and not self.barred:
            self.later(1.0, lambda: self.say(f"{job}/$state", "init"))
            self.later(2.0, lambda: self.say(f"{job}/$state", "ready"))
        if job == "temperature_automation":
            self.later(2.0, lambda: self.target(str(options["target-temperature"])))

    def target(self, payload: str) -> None:
        """What a thermostat says once it is ready; it does not hear before."""
        self.say("temperature_automation/target_temperature", payload, retained=True)

    def revive(self) -> None:
        """The task queue comes back and runs what waits in it."""
        self.queue = True
        waiting, self.waiting = self.waiting, []
        for what in waiting:
            what()


class FakeWeb:
    """`hardware.pioreactor.web.Web` of the unit."""

    def __init__(self, world: World) -> None:
        self.world, self.url = world, "http://pio01.local"
        self.active = {pump: {"curve_data_": [1.0, 0.0]} for pump in ("media_pump", "waste_pump")}

    def _up(self) -> None:
        if not self.world.web:
            raise NotHeard("http://pio01.local: refused")

    def get(self, path: str) -> Any:
        self._up()
        answers = {
            "/active_calibrations": self.active,
            "/health": {"pioreactor_unit": UNIT, "utc_time": "2026-11-21T00:00:00Z"},
            "/versions/app": {"version": "25.11.19"},
        }
        return answers[path]

    def post(self, path: str, body: Any = None) -> Any:
        self._up()
        self.world.stops.append(path)
        return {"task_id": "stop"}

    def run(self, job: str, options: Mapping[str, Any], env: Any, overrides: Any) -> str:
        world = self.world
        self._up()
        task = f"task{len(world.runs)}"
        dose = job in PINS and "ml" in options
        if dose and world.heard == "429":
            raise NotHeard("turned away with status 429")
        world.runs.append((job, dict(options)))
        if world.queue:
            world.take(task, job, options)
        else:
            world.waiting.append(lambda: world.take(task, job, options))
        if dose and world.heard == "lost answer":
            raise LinkError("timed out")
        return task

    def result(self, task: str) -> bool | None:
        self._up()
        return self.world.results.pop(task, None)

    def running(self) -> list[dict[str, Any]]:
        self._up()
        if self.world.heard == "500":
            raise ProtocolError("status 500")
        return [{"job_name": job} for job in self.world.jobs]


class FakeMqtt:
    """`hardware.pioreactor.mailbox.Mqtt`."""

    def __init__(self, *args: Any) -> None:
        self.boxes: dict[str, Mailbox] = args[3]
        self.breaks, self.said = 0, []  # type: ignore[var-annotated]
        self.world: World = args[4]
        self.world.mqtt, self.world.box = self, self.boxes[UNIT]

    @property
    def connected(self) -> bool:
        return self.world.broker

    def publish(self, topic: str, payload: str) -> bool:
        self.said.append((topic, payload))
        heard = (
            self.world.box is not None and self.world.box.states.get((EXPERIMENT, "temperature_automation")) == "ready"
        )
        if topic.endswith("/target_temperature/set") and heard:
            self.world.target(payload)
        return self.world.broker

    def hold(self) -> None:
        self.held = True

    def holder(self, unit: str) -> str:
        return self.world.holder

    def close(self) -> None:
        pass


class Lab:
    """The driver around the doubles. Attributes: world, reactors, rows of the journal."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, world: World | None = None, **values: Any) -> None:
        self.world = world or World()
        self.web = FakeWeb(self.world)
        monkeypatch.setattr(station, "Web", lambda url: self.web)
        monkeypatch.setattr(reactors, "Mqtt", FakeMqtt)
        self.rows: list[dict[str, Any]] = []
        config = PioreactorConfig(**{"stirring": False, "thermostat": False, **values})
        self.reactors = PioreactorReactors(config, self.world, self._log, "run")
        self.station = self.reactors.stations[0]

    def _log(self, kind: str, fields: Mapping[str, Any]) -> None:
        self.rows.append({"n": len(self.rows), "wall": 0.0, "kind": kind, **fields})

    def begin(self, history: History | None = None) -> None:
        self.reactors.begin({UNIT: history} if history else None)

    def sample(self, tries: int = 20) -> Measurement:
        """The next fresh sample."""
        for _ in range(tries):
            m = self.reactors.measure()
            if m.fresh[0]:
                return m
        raise AssertionError(f"no sample in {tries} looks: {m.vitals}")

    def dose(self, ml: float) -> float:
        """Ask for this volume; what the receipt says."""
        rate = np.array([ml / self.reactors.config.period_s])
        rows, nothing = np.array([True]), np.array([np.nan])
        self.receipt = self.reactors.actuate(Command(rows, rate, nothing))
        return float(self.receipt.volume_ml[0])

    def wait(self, seconds: float) -> None:
        """Let the unit and the driver go on."""
        for _ in range(int(seconds / 0.1)):
            self.world.sleep(0.1)
            self.station.poll()

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["kind"] == kind]

    def asked(self, job: str) -> list[Mapping[str, Any]]:
        """Real requests for a pump job."""
        return [options for name, options in self.world.runs if name == job and "ml" in options]
