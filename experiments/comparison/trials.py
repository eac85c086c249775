"""Closed loops to compare: a controller on a plant in a scenario, all replicates as a single batch.

The signal of a loop is the quantity that its controller holds: the `density`, or a signal that a guest adds. `Loops`
runs the loops of a benchmark in parallel processes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from conf import guests
from dqn.policy import Policy
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.cli.stop import Workers
from experiments.comparison.config import BenchmarkConfig, StudyConfig
from experiments.laws import registry
from experiments.laws.base import Controller
from experiments.loop.loop import ClosedLoop, Step
from experiments.loop.metrics import WindowMetrics, window_metrics
from experiments.loop.signals import Signal, within_2sd
from hardware.safety.config import Response, SafetyConfig
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

SUPERVISED = ("supervised", "alarm")
LEAST_NOISE = 1e-9  # noise given to a sensor without noise, OD


@dataclass(frozen=True)
class Cell:
    """Names that identify a closed loop: controller, plant, scenario and controlled signal."""

    controller: str
    plant: str
    scenario: str
    signal: str = "density"

    @property
    def vials(self) -> tuple[object, ...]:
        """Key of the simulated vials: loops with an equal key have identical vials and noise."""
        return self.signal, self.plant, self.scenario


@dataclass(frozen=True, eq=False)
class Trial:
    """Recorded closed loop of N replicates. minute: of the schedule, (K,). temperature: of the vials, degC, (N, K)."""

    cell: Cell
    schedule: Scenario
    minute: Array
    temperature: Array

    def names(self) -> dict[str, Any]:
        """Return the entries of a row of summary.json that identify the trial."""
        return {key: getattr(self.cell, key) for key in ("signal", "controller", "plant", "scenario")}


@dataclass(frozen=True)
class Window:
    """Phase of a schedule. label: setpoint, temperature or hours. start, end: minutes of the schedule."""

    label: str
    setpoint: float
    start: float
    end: float


def windows(schedule: Scenario) -> list[Window]:
    """List the phases of a schedule. Labels: setpoints, or temperatures, or hours; the first that has no repetition."""
    edges = schedule.edges
    by_setpoint = [f"{s:g}" for s in schedule.setpoints]
    by_temperature = [f"{t:g}" for t in schedule.temperatures]
    by_hours = [f"{a / 60:g}-{b / 60:g} h" for a, b in pairwise(edges)]
    names = next((n for n in (by_setpoint, by_temperature) if len(set(n)) == len(n)), by_hours)
    return [
        Window(name, s, float(a), float(b))
        for name, s, a, b in zip(names, schedule.setpoints, edges[:-1], edges[1:], strict=True)
    ]


@dataclass(frozen=True, eq=False)
class DensityTrial(Trial):
    """Trial of a density controller; arrays (N, K) unless stated.

    od: measured OD. clean: reading of a noise-free sensor. rate: pump rate after the interlock, mL/s.
    media_ml: fresh medium delivered so far. held: number of samples after which the interlock allowed no dose, (N,).
    overflowed: whether the vessel has overflowed, (N,).
    told: for a controller with an estimator, fractions of its decisions, (N,) each: `supervised` (by the supervisor),
    `alarm` (because of innovations), and NAME of an estimate (the true value is within two standard deviations).
    """

    od: Array
    clean: Array
    rate: Array
    media_ml: Array
    held: Array
    overflowed: NDArray[np.bool_]
    told: Mapping[str, Array] = field(default_factory=dict)

    def score(self, window: Window, of: str = "measured") -> WindowMetrics:
        """Compute the metrics of a window.

        Args: of: `measured` for the measured OD, as in the paper; `clean` for the noise-free OD; `floor` for the
        sensor's error alone, that is the score of a culture exactly on the setpoint.
        """
        od = {"measured": self.od, "clean": self.clean, "floor": self.od - self.clean}[of]
        setpoint = 0.0 if of == "floor" else window.setpoint
        return window_metrics(np.broadcast_to(self.minute, od.shape), od, setpoint, window.start, window.end)

    def media(self, window: Window) -> Array:
        """Return the fresh medium delivered within the window, mL, (N,)."""
        first, last = np.searchsorted(self.minute, [window.start - 1e-6, window.end - 1e-6])
        return np.asarray(self.media_ml[:, last] - self.media_ml[:, first])

    def effort(self, window: Window) -> Array:
        """Return the control effort: mean change of the pump rate between decisions, µL/s, (N,)."""
        inside = (self.minute > window.start - 1e-6) & (self.minute < window.end - 1e-6)
        return np.asarray(1000.0 * np.abs(np.diff(self.rate[:, inside], axis=1)).mean(axis=1))


def closed(
    plant_config: PlantConfig,
    schedule: Scenario,
    model: EnvConfig,
    replicates: int,
    seed: int,
    make: Callable[[Plant, Bench], tuple[Controller, Sequence[Signal], SafetyConfig]],
) -> tuple[ClosedLoop, Plant]:
    """Build the closed loop of N replicates, named M0, M1, ..., as one batch; return it and the plant.

    The seed determines the plant, so every controller has the same vials, pumps, sensors and noise.

    Args: model: sets the control period and the largest pump rate. make: function (plant, bench) that returns the
    density controller, further signals, and the interlock's limits.
    """
    if plant_config.sensor.noise_floor == 0.0:  # the interlock regards a sensor with equal readings as frozen
        plant_config = replace(plant_config, sensor=replace(plant_config.sensor, noise_floor=LEAST_NOISE))
    bench = Bench(period_s=60.0 * model.control_min, max_rate=model.max_pump_rate)
    plant = Plant(plant_config, replicates, np.random.default_rng(seed), bench.volume_ml)
    reactors = SimulatedReactors(
        plant, SimulatedConfig(reactors=tuple(f"M{i}" for i in range(replicates))), bench.control_min
    )
    controller, further, safety = make(plant, bench)
    loop = ClosedLoop(
        reactors, controller, Interlock(replicates, safety, bench), schedule, further=further, model=model
    )
    loop.known(plant, reactors.config.pump_ml_s)
    return loop, plant


def record(loop: ClosedLoop, seen: Callable[[Step], Mapping[str, Array]]) -> tuple[Array, dict[str, Array]]:
    """Run a loop; return the minutes of its schedule, (K,), and the values that `seen` returns, name -> (N, K)."""
    schedule, every_min = loop.schedules[0], loop.interlock.bench.control_min
    minute = np.arange(0.0, schedule.total_min + 1e-6, every_min)
    stored: dict[str, Array] = {}
    for step in loop.run():
        row = np.flatnonzero(step.rows & (step.phase >= 0))
        column = np.rint(step.elapsed[row] / every_min).astype(np.intp)
        for key, values in seen(step).items():
            stored.setdefault(key, np.full((step.rows.size, minute.size), np.nan))[row, column] = values[row]
    return minute, stored


def run_trial(
    cell: Cell,
    plant_config: PlantConfig,
    schedule: Scenario,
    make: Callable[[Plant], Controller],
    model: EnvConfig,
    replicates: int,
    seed: int,
) -> DensityTrial:
    """Run N replicates of a density loop.

    Args: cell: names of the loop. make: builds the controller for a plant. The other arguments as in `closed`.
    """
    loop, plant = closed(
        plant_config, schedule, model, replicates, seed, lambda vials, _: (make(vials), (), SafetyConfig())
    )

    def seen(step: Step) -> dict[str, Array]:
        why = step.explanation
        of_law = {key: why[key] for key in SUPERVISED if key in why} | within_2sd(why)
        return of_law | {
            "od": step.od,
            "clean": plant.apparent_od,
            "rate": step.rate,
            "temperature": step.temperature,
            "media_ml": plant.feed.delivered_ml,
            "held": (step.response >= Response.HOLD).astype(np.float64),
        }

    minute, stored = record(loop, seen)
    fields = {key: stored.pop(key) for key in ("od", "clean", "rate", "temperature", "media_ml")}
    held = np.nansum(stored.pop("held"), axis=1)
    told = {}
    for key, values in stored.items():
        known = np.isfinite(values).sum(axis=1)
        told[key] = np.divide(np.nansum(values, axis=1), known, out=np.full(replicates, np.nan), where=known > 0)
    return DensityTrial(cell, schedule, minute, **fields, held=held, overflowed=plant.vessel.overflowed, told=told)


Split = Callable[[StudyConfig, Cell], Sequence[Cell]]
SPLITS: list[Split] = []
"""Functions (study, density cell) of guests that return the cells to run instead; empty: run the density cell."""


def cells(config: BenchmarkConfig) -> list[Cell]:
    """List the closed loops of all studies, each once, in order."""
    wanted: dict[Cell, None] = {}
    for study in config.studies.values():
        for scenario in study.scenarios:
            for plant in study.plants:
                for controller in study.controllers:
                    cell = Cell(controller, plant, scenario)
                    others = [other for split in SPLITS for other in split(study, cell)]
                    wanted |= dict.fromkeys(others or [cell])
    return list(wanted)


Followed = tuple[Policy, EstimateBounds | None]
"""A policy, and the bounds on estimation errors from its certificate."""


def _density(config: BenchmarkConfig, cell: Cell, followed: Followed | None) -> DensityTrial:
    policy, bounds = followed or (None, None)
    plant, schedule = config.plants[cell.plant], config.scenarios[cell.scenario]

    law = partial(registry.build, config.controllers[cell.controller], model=config.env, policy=policy, bounds=bounds)
    return run_trial(cell, plant, schedule, lambda vials: law(plant=vials), config.env, config.replicates, config.seed)


Run = Callable[[BenchmarkConfig, Any, Followed | None], Trial]
RUNS: dict[str, Run] = {"density": _density}
"""Signal -> function that runs a loop of it; a guest adds its own signal."""


def run_cell(config: BenchmarkConfig, cell: Cell, followed: Followed | None) -> Trial:
    """Run one closed loop of a benchmark. The result depends only on the arguments, not on the process."""
    guests.load("experiments.comparison")
    return RUNS[cell.signal](config, cell, followed)


class Loops(ExitStack):
    """Runner of closed loops in `config.workers` processes; 0: one per core, 1: no process but this one.

    Use it as a context manager: at its end it cancels waiting loops, and after an exception also running ones.
    """

    def __init__(self, config: BenchmarkConfig) -> None:
        super().__init__()
        self.config = config
        self._waiting: dict[Cell, Followed | None] = {}
        self._running: dict[Future[Trial], Cell] = {}
        self._pool = self.enter_context(Workers(config.workers)) if config.workers != 1 else None

    def start(self, cells: Sequence[Cell], followed: Followed | None = None) -> None:
        """Queue cells; `followed` is the policy that all of them use, None for controllers without one."""
        for cell in cells:
            if self._pool is None:
                self._waiting[cell] = followed
            else:
                self._running[self._pool.submit(run_cell, self.config, cell, followed)] = cell

    def _finished(self) -> Iterator[tuple[Cell, Trial]]:
        """Yield each cell with its trial as soon as the trial has finished."""
        for cell, followed in self._waiting.items():
            yield cell, run_cell(self.config, cell, followed)
        for future in as_completed(self._running):
            yield self._running[future], future.result()

    def results(self) -> dict[Cell, Trial]:
        """Wait for all trials and return them; show a progress bar on a terminal, or about ten lines in a log."""
        total, trials = len(self._waiting) + len(self._running), {}
        with logging_redirect_tqdm(), tqdm(total=total, disable=None, unit="loop") as bar:
            for k, (cell, trial) in enumerate(self._finished(), 1):
                trials[cell] = trial
                bar.set_postfix_str(f"{cell.controller} on {cell.plant}")
                bar.update()
                if bar.disable and (k % max(total // 10, 1) == 0 or k == total):
                    log.info("closed loop %d of %d: %s, %s, %s", k, total, cell.scenario, cell.plant, cell.controller)
        return trials
