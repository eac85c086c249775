"""Closed loops of the composition to compare: a law on a plant in a scenario, all replicates as a single batch.

The density is held beside it by a controller of `experiments/controllers`. There is no interlock: the plants of these
comparisons have no faults, and every law meets the same vials, sensors and noise.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dqn.policy import Policy
from envs.coculture.rates import T_MAX, T_MIN
from envs.plant.plant import Plant
from experiments.cli.stop import Workers
from experiments.comparison.config import BenchmarkConfig
from experiments.composition import registry as laws
from experiments.composition.controller import CompositionController
from experiments.composition.program import Program
from experiments.control.policies import composition_policy, load_policy
from experiments.controllers import registry
from experiments.controllers.base import Accounts, Controller, Watches
from experiments.loop.composition import program_of

__all__ = ["CompositionCell", "CompositionTrial", "composition_cells", "policies_of", "run_cells", "run_composition"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

FACTOR_SD, OFFSET_SD = 0.02, 5.0
"""Errors of a calibrated sensor: relative of the factor, and of the offset in counts, a blank read 36 times."""

STORED = ("share", "estimate", "low", "high", "temperature", "od")


class CompositionCell(NamedTuple):
    """What is run once: names of law, density controller, plant and scenario, and what the law is told.

    announced: changes of the share are told ahead, as the scenario has it. calibrated: the sensor was, with its errors.
    """

    law: str
    density: str
    plant: str
    scenario: str
    announced: bool
    calibrated: bool


@dataclass(frozen=True, eq=False)
class CompositionTrial:
    """What N replicates did, minute by minute; arrays (N, K) unless said otherwise.

    minute, setpoint: (K,), the latter nan where no share is asked for. share, od: true ones. estimate, low, high: of
    the share and its 95 % band. temperature: of the vial, degC. edges: start of each phase and the end, min.
    """

    cell: CompositionCell
    foresight: bool
    edges: Array
    minute: Array
    setpoint: Array
    share: Array
    estimate: Array
    low: Array
    high: Array
    temperature: Array
    od: Array


def composition_cells(config: BenchmarkConfig) -> list[CompositionCell]:
    """Every closed loop that some study of the composition needs, once, in the order in which they are asked for."""
    found: dict[CompositionCell, None] = {}
    for study in config.studies.values():
        for scenario in study.scenarios:
            for plant in study.plants:
                for density in study.controllers:
                    for law in study.compositions:
                        cell = CompositionCell(law, density, plant, scenario, study.announced, study.calibrated)
                        found[cell] = None
    return list(found)


def policies_of(config: BenchmarkConfig, names: Sequence[str], folder: Path) -> dict[str, Policy | None]:
    """The policy of each law that follows one; the run folder keeps copies. Raises: UserError naming the file."""
    found = {}
    for name in names:
        kept = folder / "policies" / name
        kept.mkdir(parents=True, exist_ok=True)
        where = config.composition_policies.get(name, "shipped")
        found[name] = composition_policy(config.compositions[name].kind, where, kept, resumed=False)
    return found


def _density(config: BenchmarkConfig, name: str) -> Controller:
    """What holds the density. Raises: UserError for a policy that does not fit."""
    kind, policy = config.controllers[name].kind, None
    if kind == "dqn":
        policy = load_policy(config.policies.get(name, "shipped"), config.env.control_min, config.env.max_pump_rate)
    return registry.build(config.controllers[name], config.env, policy)


def run_cell(config: BenchmarkConfig, cell: CompositionCell, policy: Policy | None) -> CompositionTrial:
    """One closed loop; all it needs is in its arguments, so it is the same in any process."""
    scenario = config.scenarios[cell.scenario]
    program = program_of(scenario)
    plant = Plant(config.plants[cell.plant], config.replicates, np.random.default_rng(config.seed))
    law = laws.build(config.compositions[cell.law], policy, program)
    law.reset(plant.n)
    if cell.calibrated:
        calibrate(law, plant, config.seed)
    found = run_composition(
        plant,
        law,
        _density(config, cell.density),
        program,
        np.asarray(scenario.setpoints),
        np.asarray(scenario.temperatures),
        scenario.announce_min if cell.announced else 0.0,
    )
    foresight = cell.announced and config.compositions[cell.law].kind in laws.FORESIGHT
    minute = np.arange(found["share"].shape[1], dtype=np.float64)
    return CompositionTrial(cell, foresight, program.edges, minute, program.setpoint(minute), **found)


def calibrate(law: CompositionController, plant: Plant, seed: int) -> None:
    """Tell the estimator each reactor's factor and offset, with the errors that a calibration leaves."""
    rng = np.random.default_rng([seed, 1])
    factor = plant.draws["fluorescence_factor"] * (1.0 + FACTOR_SD * rng.standard_normal(plant.n))
    offset = plant.draws["fluorescence_offset"] + OFFSET_SD * rng.standard_normal(plant.n)
    law.estimator.calibrate(factor, FACTOR_SD * factor, offset, OFFSET_SD)


def run_composition(
    plant: Plant,
    law: CompositionController,
    density: Controller,
    program: Program,
    setpoints: Array,
    temperatures: Array,
    announce_min: float,
) -> dict[str, Array]:
    """Read, decide and dose once a minute to the end of the program; `STORED`, each (N, K).

    Args: law: reset for the plant's vials. setpoints, temperatures: OD and degC of each phase, (phases,); the latter
      where no share is asked for.
    """
    n, last = plant.n, round(program.total_min)
    density.reset(n)
    rows = np.ones(n, dtype=np.bool_)
    stored: dict[str, Any] = {key: np.empty((n, last + 1), dtype=np.float32) for key in STORED}
    for k in range(last + 1):
        minute = np.full(n, float(k))
        phase = min(int(np.searchsorted(program.edges[1:], k + 1e-9, side="right")), len(setpoints) - 1)
        od, warm = plant.read_od(), plant.thermal.read()
        law.watch(od, plant.read_fluorescence(), warm, minute, rows)
        wanted = program.wanted(minute, announce_min)
        asked = np.isfinite(wanted.setpoint)
        target = np.where(asked, law.target(wanted, minute, asked), temperatures[phase])
        if isinstance(density, Watches):
            density.watch(od, warm, minute, rows)
        rate = density.act(od, np.full(n, setpoints[phase]), minute, rows)
        told = law.explain()
        now = (plant.culture.share, told["ratio"], told["ratio_low"], told["ratio_high"], warm, plant.culture.od)
        for key, values in zip(STORED, now, strict=True):
            stored[key][:, k] = values
        plant.advance(1.0, 60.0 * rate, temperature_target=np.where(asked, np.clip(target, T_MIN, T_MAX), target))
        law.dosed(60.0 * rate)
        if isinstance(density, Accounts):
            density.dosed(60.0 * rate)
    return stored


def run_cells(
    config: BenchmarkConfig, cells: Sequence[CompositionCell], policies: Mapping[str, Policy | None]
) -> list[CompositionTrial]:
    """All cells in the order given, in processes of their own unless `workers` is 1; a bar on a terminal."""
    with logging_redirect_tqdm(), tqdm(total=len(cells), disable=None, unit="loop") as bar:

        def done(trial: CompositionTrial) -> CompositionTrial:
            bar.update()
            if bar.disable:
                log.info("%s, %s, %s", trial.cell.scenario, trial.cell.plant, trial.cell.law)
            return trial

        if config.workers == 1:
            return [done(run_cell(config, cell, policies[cell.law])) for cell in cells]
        with Workers(config.workers) as pool:
            waiting = [pool.submit(run_cell, config, cell, policies[cell.law]) for cell in cells]
            return [done(future.result()) for future in waiting]
