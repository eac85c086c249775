"""How fast things are, each beside a named rival in the same run: `python -m experiments.speed`.

A measurement is two callables that do the same work. They are timed in pairs, in alternating order, so that whatever
else the machine does meets both; what is reported is the median of each and the median of the paired ratios.
"""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from conf.schema import check, setting
from experiments.cli import files, frame
from experiments.timing import learning
from experiments.timing.measurement import Measurement, measure

__all__ = ["GROUPS", "SpeedConfig", "main"]

log = logging.getLogger(__name__)

REPLICATES = 64
STATES = 64  # of the MPC's problem


@dataclass(frozen=True)
class SpeedConfig:
    """What to time."""

    groups: tuple[str, ...] = setting(
        ("training", "update", "environment", "start_up", "controllers", "mpc"), "which measurements"
    )
    runs: int = setting(
        5,
        "pairs per measurement, after one that is thrown away",
        within=(5, 1000),
        note="a median of fewer says little",
    )
    scaling: bool = setting(True, "also the figure of cost over population, batch, copies and episodes")

    def __post_init__(self) -> None:
        check(self)
        unknown = [g for g in self.groups if g not in GROUPS]
        if unknown:
            raise ValueError(f"groups = {unknown[0]}: allowed {', '.join(GROUPS)}")


def controllers() -> Iterator[Measurement]:
    """Closed loops of 90 min on `nominal_noise`: 64 vials as a batch beside the same 64 one after another."""
    import numpy as np

    from conf import presets, schema
    from envs.plant.plant import Plant, PlantConfig
    from envs.scenario import Scenario
    from envs.task import EnvConfig
    from experiments.comparison.trials import run_trial
    from experiments.control.config import controller_config
    from experiments.controllers.base import Controller
    from experiments.training import build

    model = EnvConfig()
    plant = schema.build(PlantConfig(), presets.load("plant/nominal_noise"))
    schedule = Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 37.0), recovery_od=0.8)
    policy = _untrained_policy(model)

    def loop(config: Any, replicates: int, seed: int) -> None:
        def make(vials: Plant) -> Controller:
            return build.controller(config, model, policy, vials)

        run_trial((config.kind, "nominal_noise", "setpoint_steps"), plant, schedule, make, model, replicates, seed)

    def one_by_one(config: Any) -> None:
        for seed in np.arange(REPLICATES):
            loop(config, 1, int(seed))

    for kind in ("pi", "dqn", "inverse"):
        chosen = controller_config(kind)
        yield Measurement(
            f"closed loop, {kind}",
            f"{REPLICATES} vials x 90 min after recovery",
            "as many vials one after another",
            partial(loop, chosen, REPLICATES, 0),
            partial(one_by_one, chosen),
            limit=1.0,
        )
    swarm = controller_config("mpc")
    gradient = replace(swarm, solver="gradient")
    yield Measurement(
        "closed loop, mpc",
        f"{REPLICATES} vials x 90 min after recovery, particle swarm",
        "the same with SciPy's L-BFGS-B, exact gradient",
        lambda: loop(swarm, REPLICATES, 0),
        lambda: loop(gradient, REPLICATES, 0),
        limit=20.0,
    )


def _untrained_policy(model: Any) -> Any:
    """A 2-64-64-17 network with random weights; how long it takes does not depend on them."""
    import numpy as np

    from dqn.policy import Policy

    rng = np.random.default_rng(0)
    sizes = (2, 64, 64, model.n_actions)
    weights = tuple(rng.normal(0.0, 0.3, (a, b)).astype(np.float32) for a, b in pairwise(sizes))
    biases = tuple(np.zeros(b, dtype=np.float32) for b in sizes[1:])
    return Policy(weights, biases, np.eye(2, dtype=np.float32), np.zeros(2, np.float32), model.pump_rates(), {})


def mpc() -> Iterator[Measurement]:
    """The MPC's problem from random states, cold: the swarm beside two of SciPy's solvers."""
    import numpy as np
    from scipy.optimize import minimize

    from envs.task import EnvConfig
    from experiments.controllers.base import Array
    from experiments.controllers.mpc import MpcConfig, Problem

    model, config = EnvConfig(), MpcConfig()
    rng = np.random.default_rng(1)
    start, setpoint = rng.uniform(0.2, 1.0, STATES), rng.uniform(0.2, 1.0, STATES)
    cold = np.full((STATES, config.horizon), 0.5)

    def problem(rows: slice) -> Problem:
        return Problem(start[rows], setpoint[rows], model, config.penalty)

    def swarm(rows: slice) -> None:
        problem(rows).by_swarm(cold[rows], np.random.default_rng(0).spawn(STATES)[rows], config.swarm)

    def gradient(rows: slice) -> None:
        problem(rows).by_gradient(cold[rows])

    def slsqp(rows: slice) -> None:
        for k in range(STATES)[rows]:
            one = problem(slice(k, k + 1))

            def cost(v: Array, one: Problem = one) -> float:
                return one.value_and_gradient(v, 1e4)[0]

            minimize(cost, cold[k], method="SLSQP", bounds=[(0.0, 1.0)] * config.horizon)

    every = slice(0, STATES)
    what = f"{STATES} decisions at once"
    yield Measurement("mpc solve, batch", what, "SciPy L-BFGS-B, exact gradient, one after another",
                      lambda: swarm(every), lambda: gradient(every), "ms per decision", 1e3, STATES)  # fmt: skip
    yield Measurement("mpc solve, batch", what, "SciPy SLSQP, numerical gradient, one after another",
                      lambda: swarm(every), lambda: slsqp(every), "ms per decision", 1e3, STATES)  # fmt: skip
    yield Measurement("mpc solve, single", "one decision, as on the bench", "SciPy L-BFGS-B, exact gradient",
                      lambda: swarm(slice(0, 1)), lambda: gradient(slice(0, 1)), "ms per decision", 1e3)  # fmt: skip


GROUPS: dict[str, Callable[[], Iterator[Measurement]]] = {
    "training": learning.training,
    "update": learning.update,
    "environment": learning.environment,
    "start_up": learning.start_up,
    "controllers": controllers,
    "mpc": mpc,
}
"""Name -> measurements. Whoever adds one names a rival that does the same work."""


def speed(config: SpeedConfig, folder: Path) -> None:
    """Measure every group; summary.json, a table in tables/ and on the screen, a report."""
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    from experiments import report
    from experiments.reporting import tables

    found = []
    with logging_redirect_tqdm():
        for m in tqdm([m for g in config.groups for m in GROUPS[g]()], disable=None, unit="measurement"):
            found.append(measure(m, config.runs))
            log.info("%s: %.4g %s; %s: %.4g; ratio %.3g", m.name, found[-1]["ours"], m.unit, m.rival,
                     found[-1]["theirs"], found[-1]["ratio"])  # fmt: skip
    if config.scaling:
        from experiments.reporting import charts

        log.info("scaling of updates, environment and training")
        charts.save(charts.scaling(learning.scaling(config.runs)), folder / "figures", "scaling")
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    files.write_json(folder / "summary.json", {"machine": machine, "measurements": found})
    tables.write([table(found, config.runs, machine)], folder / "tables")
    log.info("report %s", report.write(folder))


def table(found: list[dict[str, Any]], runs: int, machine: str) -> Any:
    """The measurements as a table."""
    from experiments.reporting.tables import Table, number

    rows = tuple(
        (
            str(e["name"]), str(e["work"]), f"{number(e['ours'])} {e['unit']}",
            "–" if e["limit"] is None else f"{number(e['limit'])} {e['unit']}",
            str(e["rival"]), f"{number(e['theirs'])} {e['unit']}",
            f"{number(e['ratio'])} ({number(e['ratio_range'][0])} to {number(e['ratio_range'][1])})",
        )
        for e in found
    )  # fmt: skip
    columns = ("measurement", "work", "here", "limit", "rival", "rival's time", "rival / here (range)")
    return Table("speed", f"Speed, medians of {runs} paired runs", columns, rows, machine)


main = frame.Command("speed", SpeedConfig(), speed)


if __name__ == "__main__":
    main()
