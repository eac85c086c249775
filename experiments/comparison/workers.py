"""The closed loops of a benchmark, spread over the cores; they run beside whatever the caller does meanwhile."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from types import TracebackType

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dqn.policy import Policy
from envs.plant.plant import Plant
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.trials import Trial, run_trial
from experiments.controllers import registry
from experiments.controllers.base import Controller

__all__ = ["Cell", "Loops", "cells", "run_cell"]

log = logging.getLogger(__name__)

Cell = tuple[str, str, str]  # controller, plant, scenario


def cells(config: BenchmarkConfig) -> list[Cell]:
    """Every closed loop that some study needs, once, in the order in which they are asked for."""
    wanted: dict[Cell, None] = {}
    for study in config.studies.values():
        for scenario in study.scenarios:
            for plant in study.plants:
                wanted.update(dict.fromkeys((controller, plant, scenario) for controller in study.controllers))
    return list(wanted)


def run_cell(config: BenchmarkConfig, cell: Cell, policy: Policy | None) -> Trial:
    """One closed loop of a benchmark; all it needs is in its arguments, so it is the same in any process."""
    name, plant, scenario = cell

    def make(vials: Plant) -> Controller:
        return registry.build(config.controllers[name], config.env, policy, vials)

    return run_trial(
        cell, config.plants[plant], config.scenarios[scenario], make, config.env, config.replicates, config.seed
    )


class Loops:
    """Runs cells in processes of their own, one per core, from `start` on.

    Args: config: of the benchmark; `workers` processes, 0 for one per core, 1 for none but this one.
    A context: leaving it stops what has not begun.
    """

    def __init__(self, config: BenchmarkConfig) -> None:
        self.config = config
        self._waiting: dict[Cell, Policy | None] = {}
        self._running: dict[Future[Trial], Cell] = {}
        workers = config.workers or os.cpu_count() or 1
        # Spawned, because a fork would copy torch's threads in whatever state they are.
        self._pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn")) if workers > 1 else None

    def start(self, cells: Sequence[Cell], policy: Policy | None = None) -> None:
        """Queue cells that all follow `policy`, or none."""
        for cell in cells:
            if self._pool is None:
                self._waiting[cell] = policy
            else:
                self._running[self._pool.submit(run_cell, self.config, cell, policy)] = cell

    def _finished(self) -> Iterator[tuple[Cell, Trial]]:
        """Every cell with its trial, as they come."""
        for cell, policy in self._waiting.items():
            yield cell, run_cell(self.config, cell, policy)
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
            self._pool.shutdown(wait=True, cancel_futures=True)
