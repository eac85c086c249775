"""Driver, interlock and a simple controller in front of the emulated device, on a virtual clock."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.chibio.reactors import ChiBioReactors
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice, DeviceOptions
from hardware.emulator.faults import inject
from hardware.emulator.transport import EmulatorTransport
from hardware.link.transport import Reply
from hardware.reactor import Command, Measurement
from hardware.safety.config import Response, SafetyConfig
from hardware.safety.interlock import Interlock, Verdict

# what weighing the emulator's healthy pumps gives: on-time bias 0.11 s, of which 0.05 s deliver nothing
SOUND = ReactorCalibration(
    PumpCalibration(bias_s=0.06, date="2026-01-01"), PumpCalibration(bias_s=0.11, date="2026-01-01")
)


class Spy:
    """Passes everything on and remembers every POST with its time."""

    def __init__(self, inner: EmulatorTransport, clock: VirtualClock) -> None:
        self.inner, self.clock = inner, clock
        self.posts: list[tuple[float, str]] = []

    def get(self, path: str) -> Reply:
        return self.inner.get(path)

    def post(self, path: str) -> Reply:
        self.posts.append((self.clock.now(), path))
        return self.inner.post(path)

    def disarm(self) -> None:
        self.inner.disarm()

    def close(self) -> None:
        self.inner.close()


class Bed:
    """A test bed: `run` loops measure, decide, check, actuate, confirm, respond, as a deployment does."""

    def __init__(
        self,
        names: tuple[str, ...] = ("M0",),
        od: float = 0.5,
        seed: int = 1,
        options: DeviceOptions | None = None,
        blanked: bool = True,
        safety: SafetyConfig | None = None,
        **config: Any,
    ) -> None:
        self.names = names
        self.clock = VirtualClock()
        self.device = ChiBioDevice(
            names, self.clock, np.random.default_rng(seed), options, od=od, temperature=37.0, blanked=blanked
        )
        self.wire = Spy(EmulatorTransport(self.device), self.clock)
        self.config = ChiBioConfig(reactors=names, **config)
        self.rows: list[dict[str, Any]] = []
        self.interlock = Interlock(len(names), safety)
        self.setpoint = np.full(len(names), od)
        self.target_c = np.full(len(names), 37.0)
        self.controller: Callable[[Measurement], np.ndarray] = self.inverse_law
        self.measurements: list[Measurement] = []
        self.verdicts: list[Verdict] = []
        self.samples = np.zeros(len(names), dtype=int)
        self.fed = np.zeros(len(names))
        self.client()

    def client(self) -> None:
        """A new driver on the same device, as after a restart of the program."""
        self.reactors = ChiBioReactors(self.wire, self.clock, self.config, [SOUND] * len(self.names), self.log)

    def log(self, kind: str, fields: Mapping[str, Any]) -> None:
        self.rows.append({"kind": kind, **fields})

    def inverse_law(self, m: Measurement) -> np.ndarray:
        error = np.log(np.maximum(m.od, 1e-3) / self.setpoint)
        return np.clip((0.025 + 0.5 * error) * 20.0 / 60.0, 0.0, 0.02)

    def fault(self, name: str, value: float = 1.0, reactor: str = "all") -> None:
        inject(self.device, name, reactor, value)

    def step(self) -> Measurement:
        m = self.reactors.measure()
        now = self.reactors.elapsed()
        verdict = self.interlock.check(m, self.controller(m), self.setpoint, self.target_c, now)
        receipt = self.reactors.actuate(Command(m.fresh, verdict.rate, self.target_c))
        self.interlock.confirm(receipt, now)
        off = (verdict.response == Response.PUMPS_OFF) | (verdict.response == Response.STOP)
        self.reactors.pumps_off(off)
        self.reactors.heat_off(verdict.heat_off)
        self.reactors.regulate(verdict.response == Response.REGULATE, verdict.setpoint)
        self.samples += m.fresh
        self.fed += receipt.volume_ml
        self.measurements.append(m)
        self.verdicts.append(verdict)
        return m

    def run(self, minutes: float) -> None:
        end = self.clock.now() + 60.0 * minutes
        while self.clock.now() < end:
            self.step()

    def kinds(self) -> set[str]:
        """Every reason the interlock gave so far."""
        return {kind for verdict in self.verdicts for kinds in verdict.kinds for kind in kinds}

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
