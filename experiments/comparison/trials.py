"""Closed loops to compare: one is a controller on a plant in a scenario, all replicates as a single batch.

`Loops` runs those that the studies of a benchmark need, in processes of their own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass, replace
from itertools import pairwise
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dqn.policy import Policy
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.cli.stop import Workers
from experiments.comparison.config import BenchmarkConfig
from experiments.controllers import registry
from experiments.controllers.base import Controller
from experiments.loop.loop import ClosedLoop
from experiments.loop.metrics import WindowMetrics, window_metrics
from hardware.safety.config import Response
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors

__all__ = ["Cell", "Followed", "Loops", "Trial", "Window", "cells", "run_cell", "run_trial", "windows"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

Cell = tuple[str, str, str]  # controller, plant, scenario
LEAST_NOISE = 1e-9  # OD, of a sensor that is meant to have none


@dataclass(frozen=True)
class Window:
    """A phase of a schedule, named by what tells it from the others: setpoint, temperature (degC) or hours."""

    label: str
    setpoint: float
    start: float
    end: float


def windows(schedule: Scenario) -> list[Window]:
    """The phases of a schedule with their names."""
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
class Trial:
    """What N replicates did, sample by sample since the schedule began; arrays (N, K).

    minute: (K,). od: as measured. clean: what a sensor without noise would have shown. rate: mL/s after the interlock.
    temperature: degC. media_ml: fresh medium delivered since the culture began.
    held: samples on which the interlock allowed no dose, (N,). overflowed: at the end, (N,).
    """

    controller: str
    plant: str
    scenario: str
    schedule: Scenario
    minute: Array
    od: Array
    clean: Array
    rate: Array
    temperature: Array
    media_ml: Array
    held: Array
    overflowed: NDArray[np.bool_]

    def score(self, window: Window) -> WindowMetrics:
        """Metrics of the measured OD, as the paper takes them."""
        return self._score(self.od, window)

    def score_clean(self, window: Window) -> WindowMetrics:
        """Metrics of the noise-free OD: how well the culture really was on the setpoint."""
        return self._score(self.clean, window)

    def score_floor(self, window: Window) -> WindowMetrics:
        """Metrics of the sensor's error alone: what a culture that is exactly on the setpoint would be scored."""
        return self._score(self.od - self.clean, replace(window, setpoint=0.0))

    def _score(self, od: Array, window: Window) -> WindowMetrics:
        minute = np.broadcast_to(self.minute, od.shape)
        return window_metrics(minute, od, window.setpoint, window.start, window.end)

    def media(self, window: Window) -> Array:
        """Fresh medium delivered within the window, mL, (N,)."""
        first, last = np.searchsorted(self.minute, [window.start - 1e-6, window.end - 1e-6])
        return np.asarray(self.media_ml[:, last] - self.media_ml[:, first])

    def effort(self, window: Window) -> Array:
        """Control effort: mean change of the pump rate from one decision to the next, µL/s, (N,)."""
        inside = (self.minute > window.start - 1e-6) & (self.minute < window.end - 1e-6)
        return np.asarray(1000.0 * np.abs(np.diff(self.rate[:, inside], axis=1)).mean(axis=1))


def run_trial(
    names: Cell,
    plant_config: PlantConfig,
    schedule: Scenario,
    make: Callable[[Plant], Controller],
    model: EnvConfig,
    replicates: int,
    seed: int,
) -> Trial:
    """Run N replicates, which are named M0, M1, ..., as one batch.

    The plant is built anew from the seed, so every controller meets the same vials, pumps, sensors and noise.

    Args:
      names: of controller, plant and scenario. make: builds the controller for a plant.
      model: control period and largest pump rate; the interlock's limit.
    """
    if plant_config.sensor.noise_floor == 0.0:  # the interlock takes a sensor that repeats itself exactly for dead
        plant_config = replace(plant_config, sensor=replace(plant_config.sensor, noise_floor=LEAST_NOISE))
    bench = Bench(period_s=60.0 * model.control_min, max_rate=model.max_pump_rate)
    plant = Plant(plant_config, replicates, np.random.default_rng(seed), bench.volume_ml)
    reactors = SimulatedReactors(
        plant, SimulatedConfig(reactors=tuple(f"M{i}" for i in range(replicates))), bench.control_min
    )
    loop = ClosedLoop(reactors, make(plant), Interlock(replicates, bench=bench), schedule)
    minute = np.arange(0.0, schedule.total_min + 1e-6, model.control_min)
    fields = ("od", "clean", "rate", "temperature", "media_ml")
    stored: dict[str, Any] = {key: np.full((replicates, minute.size), np.nan) for key in fields}
    held = np.zeros(replicates)
    for step in loop.run():
        row = np.flatnonzero(step.rows & (step.phase >= 0))
        column = np.rint(step.elapsed[row] / model.control_min).astype(np.intp)
        seen = {
            "od": step.od,
            "clean": plant.apparent_od,
            "rate": step.rate,
            "temperature": step.temperature,
            "media_ml": plant.feed.delivered_ml,
        }
        for key, values in seen.items():
            stored[key][row, column] = values[row]
        held[row] += step.response[row] >= Response.HOLD
    return Trial(*names, schedule, minute, **stored, held=held, overflowed=plant.vessel.overflowed)


def cells(config: BenchmarkConfig) -> list[Cell]:
    """Every closed loop that some study needs, once, in the order in which they are asked for."""
    wanted: dict[Cell, None] = {}
    for study in config.studies.values():
        for scenario in study.scenarios:
            for plant in study.plants:
                wanted.update(dict.fromkeys((controller, plant, scenario) for controller in study.controllers))
    return list(wanted)


Followed = tuple[Policy, EstimateBounds | None]
"""A policy, and within which errors of its estimator its certificate lets it act."""


def run_cell(config: BenchmarkConfig, cell: Cell, followed: Followed | None) -> Trial:
    """One closed loop of a benchmark; all it needs is in its arguments, so it is the same in any process."""
    name, plant, scenario = cell
    policy, bounds = followed or (None, None)

    def make(vials: Plant) -> Controller:
        return registry.build(config.controllers[name], config.env, policy, vials, bounds=bounds)

    return run_trial(
        cell, config.plants[plant], config.scenarios[scenario], make, config.env, config.replicates, config.seed
    )


class Loops:
    """Runs cells in processes of their own, one per core, from `start` on.

    Args: config: of the benchmark; `workers` processes, 0 for one per core, 1 for none but this one.
    A context: leaving it stops what has not begun, and by an exception also what runs.
    """

    def __init__(self, config: BenchmarkConfig) -> None:
        self.config = config
        self._waiting: dict[Cell, Followed | None] = {}
        self._running: dict[Future[Trial], Cell] = {}
        self._pool = Workers(config.workers) if config.workers != 1 else None

    def start(self, cells: Sequence[Cell], followed: Followed | None = None) -> None:
        """Queue cells that all follow one policy, or none."""
        for cell in cells:
            if self._pool is None:
                self._waiting[cell] = followed
            else:
                self._running[self._pool.submit(run_cell, self.config, cell, followed)] = cell

    def _finished(self) -> Iterator[tuple[Cell, Trial]]:
        """Every cell with its trial, as they come."""
        for cell, followed in self._waiting.items():
            yield cell, run_cell(self.config, cell, followed)
        for future in as_completed(self._running):
            yield self._running[future], future.result()

    def results(self) -> dict[Cell, Trial]:
        """Wait for all trials; a bar on a terminal, ten lines in a log."""

        total, trials = len(self._waiting) + len(self._running), {}
        with logging_redirect_tqdm(), tqdm(total=total, disable=None, unit="loop") as bar:
            for k, (cell, trial) in enumerate(self._finished(), 1):
                trials[cell] = trial
                bar.set_postfix_str(f"{cell[0]} on {cell[1]}")
                bar.update()
                if bar.disable and (k % max(total // 10, 1) == 0 or k == total):
                    log.info("closed loop %d of %d: %s, %s, %s", k, total, cell[2], cell[1], cell[0])
        return trials

    def __enter__(self) -> Loops:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.__exit__(kind, error, trace)
