"""The whole stack in one process and in virtual time: emulated device, driver, interlock, loop, record.

What a run would be in days takes seconds, everything about the culture is known, and the program can be killed at any
moment and resumed: `experiments.fault_matrix` and `experiments.soak` run on it.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.control.assemble import continue_loop
from experiments.control.config import controller_config
from experiments.control.loop import ClosedLoop, Step
from experiments.control.record import Record
from experiments.controllers.base import Controller
from experiments.training import build
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.reactors import ChiBioReactors
from hardware.chibio.resume import replay
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice, DeviceOptions
from hardware.emulator.transport import EmulatorTransport
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock

__all__ = ["SOUND", "Killed", "Rehearsal", "ScriptedClock"]

SOUND = ReactorCalibration(
    PumpCalibration(bias_s=0.06, date="2026-01-01"), PumpCalibration(bias_s=0.11, date="2026-01-01")
)
"""As weighing the emulator's healthy pumps gives: they run 0.11 s longer than asked, 0.05 s deliver nothing."""


class Killed(BaseException):
    """SIGKILL: nothing of the program runs any more, least of all what it would do on an error."""


class ScriptedClock(VirtualClock):
    """A virtual clock on which things can be made to happen at a set time, also in the middle of a request."""

    def __init__(self) -> None:
        super().__init__()
        self._script: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Call `action` when the clock reaches `time_s`; what it raises comes out of `sleep`."""
        heapq.heappush(self._script, (time_s, next(self._order), action))

    def sleep(self, seconds: float) -> None:
        """Advance virtual time, carrying out what is due on the way."""
        end = self.now() + max(seconds, 0.0)
        while self._script and self._script[0][0] <= end:
            due, _, action = heapq.heappop(self._script)
            super().sleep(due - self.now())
            action()
        super().sleep(end - self.now())


def _plumbed(options: DeviceOptions, overflow: OverflowPumpConfig) -> DeviceOptions:
    """The same device with a second waste tube on the overflow pump."""
    pump = replace(options.plant.pump, guard_ml_s=overflow.flow_ml_s)
    bench = replace(options.bench, guard=overflow.pump)
    return replace(options, bench=bench, plant=replace(options.plant, pump=pump))


class Rehearsal:
    """A run of `experiments.deploy` against the emulated device, in virtual time.

    Args:
      folder: run folder, must exist.
      names: positions of the reactors. schedules: one for each.
      safety, backend: as of deploy. controller: kind of controller; `dqn` is not among them (it needs a policy file).
      options: of the device. od: at the start. seed: of all noise. overflow_pump: of rig and driver.
    Attributes: clock, device; record, reactors, loop of the present life of the program; lives; killed_s, when the
      program was killed; spans, clock times during which the program lived.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        schedules: Sequence[Scenario],
        safety: SafetyConfig | None = None,
        controller: str = "inverse",
        options: DeviceOptions | None = None,
        od: float = 0.5,
        seed: int = 0,
        overflow_pump: OverflowPumpConfig | None = None,
    ) -> None:
        self.folder, self.names, self.schedules = folder, tuple(names), list(schedules)
        self.safety, self._kind = safety or SafetyConfig(), controller
        self.clock = ScriptedClock()
        rng = np.random.default_rng(seed)
        overflow_pump = overflow_pump or OverflowPumpConfig()
        plumbed = _plumbed(options or DeviceOptions(), overflow_pump)
        self.device = ChiBioDevice(self.names, self.clock, rng, plumbed, od=od, temperature=37.0, blanked=True)
        self.backend = ChiBioConfig(reactors=self.names, overflow_pump=overflow_pump)
        self.spans: list[list[float]] = []
        self.lives = 0
        self._dead = False
        self.record: Record
        self.reactors: ChiBioReactors
        self.loop: ClosedLoop

    def _log(self, kind: str, fields: Mapping[str, Any]) -> None:
        if self._dead:
            raise Killed
        self.record.journal.append(kind, fields)

    def begin(self) -> None:
        """Start the program, or start it again with `resume=`, as after a kill. Raises: ReactorError."""
        self._dead = False
        self.lives += 1
        resumed = self.lives > 1
        self.record = Record(self.folder, self.names, fsync=False)
        self.spans.append([self.clock.now(), np.inf])
        transport = EmulatorTransport(self.device)
        calibrations = [SOUND] * len(self.names)
        self.reactors = ChiBioReactors(transport, self.clock, self.backend, calibrations, self._log)
        earlier = self.record.journal.rows
        self.reactors.begin(replay(earlier), self.clock.now() - self.spans[0][0])
        self.loop = ClosedLoop(
            self.reactors, self._controller(), Interlock(len(self.names), self.safety), self.schedules, self._decided
        )
        if resumed:
            continue_loop(self.loop, self.record)

    def _controller(self) -> Controller:
        return build.controller(controller_config(self._kind), EnvConfig())

    def _decided(self, step: Step) -> None:
        self.record.decided(step)

    def run(self, until_s: float = np.inf) -> Iterator[Step]:
        """Steps of the loop up to its end or a clock time. Raises: ReactorError, Killed."""
        while not self.loop.over and self.clock.now() < until_s:
            step = self.loop.step()
            self.record.done(step, self.loop.state_dict())
            yield step

    def kill(self) -> None:
        """End the program at once; give it to `clock.at`. Raises: Killed, always."""
        self._dead = True
        raise Killed

    def bury(self) -> None:
        """What the kernel does for a process that is gone: its files are closed. `begin` starts the next life."""
        self.spans[-1][1] = self.clock.now()
        self.record.close()

    def wait(self, seconds: float) -> None:
        """Let device time pass without a program."""
        self.clock.sleep(seconds)
        self.device.run_until(self.clock.now())

    def truth(self, name: str) -> dict[str, Any]:
        """What only the emulator knows."""
        self.device.run_until(self.clock.now())
        return self.device.truth(name)
