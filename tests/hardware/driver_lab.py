"""The program's closed loop with a simple controller around the emulated device, on a virtual clock."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from conf.messages import Message
from envs.scenario import Scenario
from experiments.laws.base import Array, Mask
from experiments.loop.loop import ClosedLoop, Step
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.reactors import ChiBioReactors
from hardware.chibio.resume import replay
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice, DeviceOptions
from hardware.emulator.faults import inject
from hardware.emulator.transport import EmulatorTransport
from hardware.link.transport import Reply, SwitchedOff, Transport
from hardware.logbook import Log
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock
from tests.campaigns.rehearsal import SOUND
from tests.hardware.script import noted


class Spy(Transport):
    """Passes everything on and remembers every POST with its time."""

    def __init__(self, inner: EmulatorTransport, clock: VirtualClock) -> None:
        self.inner, self.clock = inner, clock
        self.posts: list[tuple[float, str]] = []

    def get(self, path: str) -> Reply:
        return self.inner.get(path)

    def post(self, path: str) -> Reply:
        self.posts.append((self.clock.now(), path))
        return self.inner.post(path)

    def switched_off(self) -> SwitchedOff:
        return self.inner.switched_off()


class Law:
    """A controller that knows growth and pump of the emulator's healthy culture, or asks for a fixed rate."""

    rate: float | None = None  # the fixed rate, mL/s

    def reset(self, n: int) -> None:
        """Nothing to forget."""

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        if self.rate is not None:
            return np.full(od.shape, self.rate)
        error = np.log(np.maximum(od, 1e-3) / setpoint)
        return np.clip((0.025 + 0.5 * error) * 20.0 / 60.0, 0.0, 0.02)


class DriverLab:
    """The program's closed loop around driver and emulated device.

    Attributes: law, the controller; steps, what the loop yielded; rows, what the driver logged; samples, fed: number of
      samples and mL asked of the pumps, shape (N,).
    """

    def __init__(
        self,
        names: tuple[str, ...] = ("M0",),
        od: float = 0.5,
        seed: int = 1,
        options: DeviceOptions | None = None,
        blanked: bool = True,
        safety: SafetyConfig | None = None,
        scenario: Scenario | None = None,
        **config: Any,
    ) -> None:
        self.names = names
        self.clock = VirtualClock()
        self.device = ChiBioDevice(
            names, self.clock, np.random.default_rng(seed), options, od=od, temperature=37.0, blanked=blanked
        )
        self.wire = Spy(EmulatorTransport(self.device), self.clock)
        self.config = ChiBioConfig(reactors=names, **config)
        self.safety = safety
        self.scenario = scenario or Scenario((od,), (100_000.0,), (37.0,))
        self.law = Law()
        self.rows: list[dict[str, Any]] = []
        self.steps: list[Step] = []
        self.samples = np.zeros(len(names), dtype=int)
        self.fed = np.zeros(len(names))
        self._state: dict[str, Any] = {}  # of the loop after its last step
        self.client()

    def client(self, calibrations: Sequence[ReactorCalibration] | None = None, log: Log | None = None) -> None:
        """A new driver and loop on the same device, as after a restart of the program."""
        calibrations = calibrations or [SOUND] * len(self.names)
        self.reactors = ChiBioReactors(self.wire, self.clock, self.config, calibrations, log or self.log)
        interlock = Interlock(len(self.names), self.safety)
        self.loop = ClosedLoop(self.reactors, self.law, interlock, self.scenario)
        if self._state:
            self.loop.restore(self._state)

    def resume(self, dead_s: float = 0.0) -> None:
        """Go on by the journal with a new driver and loop, so long after the program was killed."""
        began, rows = self.reactors.elapsed(), json.loads(json.dumps(self.rows))
        self.clock.sleep(dead_s)
        self.client()
        self.reactors.begin(replay(rows), began + dead_s)

    def log(self, kind: str, fields: Mapping[str, Any]) -> None:
        self.rows.append({"kind": kind, **fields})

    def on_post(self, act: Callable[[str, Callable[[str], Reply]], Reply]) -> None:
        """From now on let `act` carry out each POST. Args: act: gets the path, and what carries it out in truth."""
        real = self.wire.inner.post
        self.wire.inner.post = lambda path: act(path, real)  # type: ignore[method-assign]

    def fault(self, name: str, value: float = 1.0, reactor: str = "all") -> None:
        inject(self.device, name, reactor, value)

    def step(self) -> Step:
        step = self.loop.step()
        self._state = self.loop.state()
        self.samples += step.rows
        self.fed += step.volume_ml
        self.steps.append(step)
        return step

    def run(self, minutes: float) -> None:
        """Go on for so long, or until every reactor was given up."""
        end = self.clock.now() + 60.0 * minutes
        while self.clock.now() < end and not self.loop.over:
            self.step()

    def notes(self, *kinds: type[Message]) -> list[dict[str, Any]]:
        """The values of what was noted so far of these messages, or because of them."""
        return noted(self.rows, *kinds)

    def kinds(self) -> set[str]:
        """Every kind of reason that the interlock gave so far."""
        texts = [text for step in self.steps for text in step.reasons if text]
        return {reason.split(":")[0] for text in texts for reason in text.split(" | ")}

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["kind"] == kind]

    def peek_cycles(self, name: str = "M0") -> list[float]:
        """Device time at which each recorded cycle of `name` began."""
        starts = self.device.apps[name].data["time"]["record"]
        started = next(t for t, path in self.wire.posts if path == f"/Experiment/1/{name}")
        return [started + float(t) for t in starts]

    def truth(self, name: str = "M0") -> dict[str, Any]:
        self.device.run_until(self.clock.now())
        return self.device.truth(name)

    def motors_off(self) -> bool:
        return not any(any(self.truth(n)["motors"].values()) for n in self.names)


def begun(*args: Any, rate: float | None = None, minutes: float = 0.0, **config: Any) -> DriverLab:
    """A lab whose run began `minutes` ago. Args: rate: asked for throughout, mL/s."""
    lab = DriverLab(*args, **config)
    lab.law.rate = rate
    lab.reactors.begin()
    lab.run(minutes)
    return lab
