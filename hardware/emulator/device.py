"""The whole device on device time: processes, web worker, routes, power, and the faults of link and computer.

`ChiBioDevice` needs no thread and no socket. Requests are submitted and answered while events run: `run_until` for a
virtual clock, `hardware/emulator/server.py` for a real one. Source: chibio.md sections 1, 2, 9 and 11.
"""

from __future__ import annotations

import heapq
import json
import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import format_datetime
from typing import Any, NamedTuple

import numpy as np

from conf.schema import check, part, setting
from envs.plant.plant import Plant, PlantConfig
from hardware.clock import Clock
from hardware.emulator.faults import LinkFaults
from hardware.emulator.reactor_app import AppError, BusStuck, ProcessDied, ReactorApp, Steps
from hardware.emulator.routes import HTML, Answer, answer_request
from hardware.emulator.sysdata import ALL_REACTORS
from hardware.emulator.vial import Bench, BenchConfig, VialFaults, healthy_plant

__all__ = ["ChiBioDevice", "DeviceOptions", "Exchange"]

EPOCH = 1_767_225_600.0  # the board's clock at device second 0: 2026-01-01 00:00:00
REQUEST = "request"  # owner of the events of the request being served
POWER_LATCH_S = 1.0  # the watchdog cuts power about a second after the software stopped
ERROR_PAGE = b"<!doctype html>\n<title>500 Internal Server Error</title>\n<h1>Internal Server Error</h1>\n"


@dataclass(frozen=True)
class DeviceOptions:
    """How the emulated device is built."""

    worker_timeout_s: float = setting(30.0, "gunicorn kills a worker whose request takes longer", "s", within=(1, 3600))
    boot_s: float = setting(8.0, "from a dead worker to a serving one", "s", within=(0, 600))
    request_s: float = setting(0.005, "what any request takes", "s", within=(0, 5))
    bench: BenchConfig = part(BenchConfig, "optics and electronics")
    plant: PlantConfig = part(healthy_plant, "the culture, with pulse dosing")

    def __post_init__(self) -> None:
        check(self, "emulator")
        if self.plant.pump.dosing != "pulse":
            raise ValueError("emulator.plant.pump.dosing = continuous: allowed pulse, as the device's pumps work")


@dataclass(eq=False)
class Exchange:
    """One request and what became of it.

    `answer` is (status, body, headers); `fate` is "" while open or answered, else "refused" (nobody listens), "reset"
    (connection broken) or "lost" (silence until the client's time-out). `cut` is how many body bytes to leave out.
    """

    method: str
    path: str
    headers: Mapping[str, str]
    answer: Answer | None = None
    fate: str = ""
    cut: int = 0

    @property
    def done(self) -> bool:
        """Answered or given up?"""
        return self.answer is not None or self.fate != ""


class _Event(NamedTuple):
    at: float
    order: int  # of equal times the earlier scheduled comes first; unique, so nothing further is compared
    steps: Steps
    life: int  # process it belongs to; -1 = hardware, survives the software
    owner: str


class ChiBioDevice:
    """A Chi.Bio control computer with reactors.

    Args:
      reactors: positions with a reactor plugged in, e.g. ("M0", "M1").
      clock: device seconds; `handle` sleeps on it.
      rng: noise of everything, one stream per reactor.
      options: see `DeviceOptions`.
      od: initial optical density, one for all or one per reactor; temperature: of the vials, degC.
      blanked: start with the zeros an operator has set with clear medium; False = 65000, as after power-on.
    Raises: ValueError for an unknown or repeated position or a wrong number of ODs.
    """

    def __init__(
        self,
        reactors: Sequence[str],
        clock: Clock,
        rng: np.random.Generator,
        options: DeviceOptions | None = None,
        od: float | Sequence[float] = 0.3,
        temperature: float = 24.0,
        blanked: bool = False,
    ) -> None:
        if not reactors or len(set(reactors)) != len(reactors) or not set(reactors) <= set(ALL_REACTORS):
            raise ValueError(f"reactors = {','.join(reactors)}: allowed a list of different names from M0 to M7")
        ods = [float(od)] * len(reactors) if isinstance(od, (int, float)) else [float(x) for x in od]
        if len(ods) != len(reactors):
            raise ValueError(f"od has {len(ods)} values: allowed 1 or {len(reactors)}, one per reactor")
        self.clock, self.options, self.faults = clock, options or DeviceOptions(), LinkFaults()
        self.reactors = tuple(reactors)
        self._now = clock.now()
        self._events: list[_Event] = []
        self._order = self._life = 0
        self._wall_offset = self._deadline = 0.0
        self.alive, self._ready = True, True
        self._queue: deque[Exchange] = deque()
        self._serving: Exchange | None = None
        self.errors: deque[str] = deque(maxlen=200)
        self.restarts = self.exits = 0
        noise, *streams = rng.spawn(1 + len(reactors))
        self._rng = noise
        self.benches: dict[str, Bench] = {}
        for name, stream, start_od in zip(reactors, streams, ods, strict=True):
            plant_stream, bench_stream = stream.spawn(2)
            plant = Plant(self.options.plant, 1, [plant_stream])
            plant.reset(start_od, temperature)
            self.benches[name] = Bench(plant, self.options.bench, bench_stream, self._now)
        self._power_on_software()
        for name, bench in self.benches.items() if blanked else ():
            self.apps[name].data["OD0"]["target"] = round(bench.blank)

    # -- the computer (protocol Board) -----------------------------------------------------------------------------

    def now(self) -> float:
        """Device time of the event in progress, s."""
        return self._now

    def wall(self) -> float:
        """The board's clock, s since 1970."""
        return EPOCH + self._now + self._wall_offset

    def stamp(self) -> str:
        """The board's clock as in the web page."""
        return datetime.fromtimestamp(self.wall(), UTC).strftime("%Y-%m-%d %H:%M:%S")

    def http_date(self) -> str:
        """The board's clock as Flask writes a datetime."""
        return format_datetime(datetime.fromtimestamp(int(self.wall()), UTC), usegmt=True)

    def uniform(self, low: float, high: float) -> float:
        """A random number from the computer's own stream."""
        return float(self._rng.uniform(low, high))

    def bus(self, name: str) -> None:
        """One bus access. Raises: BusStuck."""
        if self.faults.bus_stuck:
            raise BusStuck(name)

    def write_row(self, name: str) -> None:
        """One line of a data file, written under the bus lock. Raises: BusStuck, also for a full disk."""
        self.faults.bus_stuck = self.faults.bus_stuck or self.faults.disk_full
        self.bus(name)

    def spawn(self, steps: Steps, owner: str) -> None:
        """Start a thread of the software; it runs at the present device time, after what is already due."""
        self._schedule(0.0, steps, self._life, owner)

    def _schedule(self, delay: float, steps: Steps, life: int, owner: str) -> None:
        self._order += 1
        heapq.heappush(self._events, _Event(self._now + delay, self._order, steps, life, owner))

    def next_time(self) -> float:
        """When the next event is due, device s; inf if none."""
        return self._events[0].at if self._events else math.inf

    def run_until(self, t: float) -> None:
        """Run every event due up to device time `t`."""
        while self._events and self._events[0].at <= t:
            event = heapq.heappop(self._events)
            if event.life not in (-1, self._life):
                continue
            self._now = max(self._now, event.at)
            self._resume(event)
        self._now = max(self._now, t)

    def _resume(self, event: _Event) -> None:
        try:
            pause = next(event.steps)
        except StopIteration:
            return
        except BusStuck:
            pause = math.inf
        except ProcessDied as problem:
            self._note(f"{event.owner}: {problem}")
            self._exit()
            return
        except (AppError, ArithmeticError, LookupError, TypeError, ValueError) as problem:
            self._note(f"{event.owner}: {type(problem).__name__}: {problem}")  # the thread ends, silently as there
            return
        if event.owner == REQUEST and self._now + pause > self._deadline:
            self._schedule(self._deadline - self._now, self._watch(), event.life, event.owner)
        elif pause < math.inf:
            self._schedule(pause, event.steps, event.life, event.owner)
        if self.faults.bus_stuck_when_pumping and any(b.motor("Pump1") for b in self.benches.values()):
            self.faults.bus_stuck, self.faults.bus_stuck_when_pumping = True, False

    def _note(self, text: str) -> None:
        self.errors.append(f"{self._now:.2f} {text}")

    # -- life and death of the software ----------------------------------------------------------------------------

    def _power_on_software(self) -> None:
        """Import of the app: every position initialised, power on, all outputs off."""
        self.selected = "M0"
        self.faults.bus_stuck = False
        for bench in self.benches.values():
            bench.set_power(True, self._now)
        self.apps = {
            name: ReactorApp(name, self, self.benches.get(name), device_id(name), self.selected)
            for name in ALL_REACTORS
        }
        self._ready = True
        self._serve_next()

    def _end_process(self) -> None:
        """Threads and memory are gone; the latch cuts the power a second later."""
        self._life += 1
        self._ready = False
        if self._serving is not None:
            self._serving.fate, self._serving = "reset", None
        self._schedule(POWER_LATCH_S, self._cut_power(self._life), -1, "latch")

    def _cut_power(self, life: int) -> Steps:
        if life == self._life and not self._ready:
            for bench in self.benches.values():
                bench.set_power(False, self._now)
        yield from ()

    def kill_worker(self) -> None:
        """gunicorn replaces the worker: state wiped, requests wait until the new one has booted."""
        self._note("worker killed")
        self._end_process()
        self.restarts += 1
        self._schedule(self.options.boot_s, self._boot(self._life), -1, "boot")

    def _boot(self, life: int) -> Steps:
        if life == self._life and self.alive:
            self._power_on_software()
        yield from ()

    def _exit(self) -> None:
        """Exit code 4: gunicorn gives up, nobody listens any more."""
        self._end_process()
        self.alive = False
        self.exits += 1
        while self._queue:
            self._queue.popleft().fate = "reset"

    def crash(self) -> None:
        """Fault: the software ends itself, as after too many bus failures."""
        self._note("crashed on demand")
        self._exit()

    def cut_power(self) -> None:
        """Fault: the whole board loses power; its clock starts again where it had started before."""
        self.crash()
        self._wall_offset = -self._now
        for bench in self.benches.values():
            bench.set_power(False, self._now)

    def restart(self) -> None:
        """Somebody starts the software again by hand: defaults, nothing running."""
        if not self.alive:
            self.alive = True
            self.restarts += 1
            self._schedule(self.options.boot_s, self._boot(self._life), -1, "boot")

    def step_clock(self, seconds: float) -> None:
        """Fault: the board's clock is set forward (or back, below 0)."""
        self._wall_offset += seconds

    def kill_thread(self, owner: str) -> int:
        """Fault: the thread `owner`, e.g. "M0/Experiment", ends as after an exception; how many were found."""
        kept = [e for e in self._events if e.owner != owner or e.life != self._life]
        found = len(self._events) - len(kept)
        heapq.heapify(kept)
        self._events = kept
        return found

    def vial(self, name: str) -> VialFaults:
        """Switches of what is broken at one reactor. Raises: KeyError for a position without one."""
        return self.benches[name].faults

    # -- requests --------------------------------------------------------------------------------------------------

    def submit(self, method: str, path: str, headers: Mapping[str, str] | None = None) -> Exchange:
        """Hand a request to the server; run events until `done` to get its answer."""
        exchange = Exchange(method, path, headers or {})
        if not self.alive:
            exchange.fate = "refused"
        elif self.faults.take("lost_request"):
            exchange.fate = "lost"
        elif self.faults.take("reset_before"):
            exchange.fate = "reset"
        else:
            self._schedule(self.faults.slow_s, self._arrive(exchange), -1, "network")
            self.run_until(self._now)
        return exchange

    def _arrive(self, exchange: Exchange) -> Steps:
        if self.alive:
            self._queue.append(exchange)
            self._serve_next()
        else:
            exchange.fate = "refused"
        yield from ()

    def handle(self, method: str, path: str, headers: Mapping[str, str] | None = None) -> tuple[int, bytes]:
        """Submit and wait on the clock; (status, body). Raises: ConnectionError if no answer comes."""
        self.run_until(self.clock.now())
        exchange = self.submit(method, path, headers)
        while not exchange.done:
            self.clock.sleep(self.next_time() - self.clock.now())
            self.run_until(self.clock.now())
        if exchange.answer is None:
            raise ConnectionError(exchange.fate)
        return exchange.answer[0], exchange.answer[1]

    def _serve_next(self) -> None:
        """One worker, one request at a time."""
        if self._ready and self._serving is None and self._queue:
            self._serving = self._queue.popleft()
            self._deadline = self._now + self.options.worker_timeout_s
            self._schedule(0.0, self._serve(self._serving), self._life, REQUEST)

    def _watch(self) -> Steps:
        """What a request that outlives the worker's time-out comes to."""
        self.kill_worker()
        yield from ()

    def _serve(self, exchange: Exchange) -> Steps:
        faults = self.faults
        hang, faults.hang_s = faults.hang_s, 0.0
        yield self.options.request_s + hang
        if len(self.reactors) > 1 and self._rng.random() < faults.foreign_selects:
            self.select(str(self._rng.choice([m for m in self.reactors if m != self.selected])))
        try:
            answer = yield from answer_request(self, exchange)
        except (AppError, ArithmeticError, LookupError, TypeError, ValueError) as problem:
            self._note(f"{exchange.method} {exchange.path}: {type(problem).__name__}: {problem}")
            answer = (500, ERROR_PAGE, HTML)
        if faults.take("lost_reply"):
            exchange.fate = "lost"
        elif faults.take("reset_after"):
            exchange.fate = "reset"
        else:
            exchange.answer = answer
        self._serving = None
        self._serve_next()

    def select(self, name: str) -> None:
        """Select a reactor for everybody."""
        self.selected = name
        for app in self.apps.values():
            app.data["UIDevice"] = name

    def sysdata(self) -> bytes:
        """Body of getSysdata: the selected reactor, sorted keys, NaN as the bare token."""
        data = self.apps[self.selected].data
        data["presentDevices"] = {name: app.data["present"] for name, app in self.apps.items()}
        if self.faults.terminal_as_list or self.faults.terminal_named or self.faults.extra_fields:
            data = dict(data)
        if self.faults.terminal_named:
            text = re.sub(
                r" - (Experiment|Terminal|Cycle \d+) (St|C)",
                rf" - \1 on {self.selected} ({data['DeviceID']}) \2",
                data["Terminal"]["text"],
            )
            data["Terminal"] = {"text": text}
        if self.faults.terminal_as_list:
            data["Terminal"] = {"text": [line for line in data["Terminal"]["text"].split("</br>") if line]}
        if self.faults.extra_fields:
            data |= {"DeviceName": "", "Pump5": {"ON": 0, "target": 0.0}}
        return json.dumps(data, sort_keys=True, separators=(",", ":")).encode() + b"\n"

    # -- truth -----------------------------------------------------------------------------------------------------

    def truth(self, name: str) -> dict[str, Any]:
        """What only the emulator knows of one reactor. Raises: KeyError for a position without one."""
        bench = self.benches[name]
        bench.sync(self._now)
        plant = bench.plant
        return {
            "device_s": self._now,
            "od": float(plant.od[0]),
            "apparent_od": float(plant.apparent_od[0]),
            "temperature": float(plant.temperature[0]),
            "volume_ml": float(plant.volume_ml[0]),
            "peak_ml": bench.peak_ml,
            "overflowed": bool(plant.overflowed[0]),
            "feed_ml": float(plant.media_ml[0]),
            "media_left_ml": float(plant.media_left_ml[0]),
            "on_s": dict(bench.on_s),
            "motors": {pump: bench.motor(pump) for pump in bench.on_s},
            "heat": bench.heat,
            "stir": bench.stir,
            "powered": bench.powered,
            "blank": bench.blank,
        }


def device_id(name: str) -> str:
    """Four ID words of the IR thermometer at a position, decimal strings joined."""
    k = int(name[1])
    return f"{1000 + k}{2000 + 7 * k}{3000 + 11 * k}{4000 + 13 * k}"
