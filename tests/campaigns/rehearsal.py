"""The whole stack in one process and in virtual time: emulated device, driver, interlock, loop, record.

What a run would be in days takes seconds, everything about the culture is known, and the program can be killed at any
moment and resumed.
"""

import heapq
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from envs.bench import Bench
from envs.scenario import Scenario
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop, Step
from experiments.record.record import Record
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration, SupplyConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.reactors import ChiBioReactors
from hardware.chibio.resume import replay
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice, DeviceOptions
from hardware.emulator.transport import EmulatorTransport
from hardware.safety.config import SafetyConfig

__all__ = ["SOUND", "Killed", "Rehearsal", "ScriptedClock", "StandIn", "rehearsed"]

SOUND = ReactorCalibration(
    PumpCalibration(bias_s=0.06, date="2026-01-01"), PumpCalibration(bias_s=0.11, date="2026-01-01")
)
"""As weighing the emulator's healthy pumps gives: they run 0.11 s longer than asked, 0.05 s deliver nothing."""


class Killed(BaseException):
    """SIGKILL: nothing of the program runs any more, least of all what it would do on an error."""


class StandIn:
    """A controller in the place of another one, whose memory it keeps: a resumed run goes on with that."""

    def __init__(self, inner: Any) -> None:
        self.remembers = getattr(inner, "remembers", ())
        self.inner, self.reset = inner, inner.reset

    def __getattr__(self, name: str) -> Any:
        if name.removeprefix("_") not in [key.removeprefix("_") for key in self.remembers]:
            raise AttributeError(name)
        return getattr(self.inner, name)


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


def _plumbed(options: DeviceOptions, overflow: OverflowPumpConfig, supply: SupplyConfig) -> DeviceOptions:
    """The same device with a second waste tube on the overflow pump, and the bottles of supply pumps."""
    pump = replace(options.plant.pump, overflow_ml_s=overflow.flow_ml_s)
    flows = supply.pump3_ml_s, supply.pump4_ml_s
    vial = replace(options.vial, overflow_pump=overflow.pump, pump3_ml_s=flows[0], pump4_ml_s=flows[1])
    return replace(options, vial=vial, plant=replace(options.plant, pump=pump))


def rehearsed(
    names: Sequence[str],
    scenario: Scenario,
    safety: SafetyConfig | None = None,
    controller: str = "dqn",
    overflow_pump: OverflowPumpConfig | None = None,
    bench: Bench | None = None,
) -> DeployConfig:
    """The config of a run that is to be rehearsed: reactors at `names`, all with one scenario."""
    backend = ChiBioConfig(reactors=tuple(names), overflow_pump=overflow_pump or OverflowPumpConfig())
    law, limits = registry.config(controller), safety or SafetyConfig()
    return DeployConfig(backend, bench=bench or Bench(), safety=limits, scenario=scenario, controller=law, fsync=False)


class Rehearsal:
    """A run of `experiments.deploy` against the emulated device, in virtual time.

    Args:
      folder: run folder, must exist. config: as of deploy, e.g. by `rehearsed`.
      options: of the device; the overflow pump of the config is plumbed in. od: at the start. seed: of all noise.
    Attributes: clock, device; record, reactors, loop of the present life of the program; lives; spans, clock times
      during which the program lived.
    """

    def __init__(
        self, folder: Path, config: DeployConfig, options: DeviceOptions | None = None, od: float = 0.5, seed: int = 0
    ) -> None:
        self.folder, self.config = folder, config
        self.names: tuple[str, ...] = config.backend.reactors
        self.clock = ScriptedClock()
        rng = np.random.default_rng(seed)
        plumbed = _plumbed(options or DeviceOptions(), config.backend.overflow_pump, config.backend.supply)
        volumes_ml = config.bench.volumes(self.names).tolist()
        self.device = ChiBioDevice(
            self.names, self.clock, rng, plumbed, od=od, temperature=37.0, blanked=True, volumes_ml=volumes_ml
        )
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
        resume = str(self.folder) if self.lives > 1 else None
        setup = assemble.unpack(replace(self.config, resume=resume), self.folder)
        self.record = Record(self.folder, self.names, setup.fsync, setup.columns)
        self.spans.append([self.clock.now(), np.inf])
        transport, calibrations = EmulatorTransport(self.device), [SOUND] * len(self.names)
        self.reactors = ChiBioReactors(transport, self.clock, setup.backend, calibrations, self._log)
        self.reactors.begin(replay(self.record.journal.rows), self.clock.now() - self.spans[0][0])
        self.loop = assemble.close_loop(setup, self.reactors, self.record)

    def run(self, until_s: float = np.inf) -> Iterator[Step]:
        """Steps of the loop up to its end or a clock time. Raises: ReactorError, Killed."""
        while not self.loop.over and self.clock.now() < until_s:
            step = self.loop.step()
            self.record.done(step, self.loop.state())
            yield step

    def kill(self) -> None:
        """End the program at once; give it to `clock.at`. Raises: Killed, always."""
        self._dead = True
        raise Killed

    def kill_at(
        self, request: str, armed: Callable[[], bool] = lambda: True, after_s: float = 0.6, stops: bool = False
    ) -> None:
        """Kill the program so long after the first request that begins so, once `armed`; the device carries it out.

        stops: it ends as on a signal.
        """
        whole = self.device.submit

        def submit(method: str, path: str, *rest: Any) -> Any:
            exchange = whole(method, path, *rest)
            if path.startswith(request) and armed():
                self.device.submit = whole  # type: ignore[method-assign]
                self.clock.sleep(after_s)
                if stops:
                    raise KeyboardInterrupt
                self.kill()
            return exchange

        self.device.submit = submit  # type: ignore[assignment, method-assign]

    def kill_decided(self, when: Callable[[Step], bool]) -> None:
        """Kill the program between a decision of which this is true and its record."""
        decided = self.loop._before_dose
        assert decided is not None

        def dies(step: Step) -> None:
            decided(step)
            if when(step):
                self.kill()

        self.loop._before_dose = dies

    def killed(self, until_s: float = np.inf) -> None:
        """Run until something kills or stops the program, and close its files. Raises: AssertionError if none does."""
        try:
            list(self.run(until_s))
        except Killed:
            self.close()
        except KeyboardInterrupt:
            self.reactors.stop()
            self.close()
        else:
            raise AssertionError("nothing ended it")

    def close(self) -> None:
        """Close the files of the program that has ended; `begin` starts the next one."""
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
