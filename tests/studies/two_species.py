"""Two species for a week, in vials of a simulator of their own: `python -m tests.studies.two_species`.

Coverage of the estimate's band and its error, day by day, in vials whose differences are drawn; and every law against
the default one, in cells of which each has one thing wrong.
"""

import logging
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, setting
from dqn.policy import load
from experiments.cli import files
from experiments.cli.stop import Workers
from experiments.coculture.base import SHARE, Array
from experiments.coculture.estimator import CompositionEstimator, CompositionEstimatorConfig
from experiments.coculture.policies import SHIPPED_COMPOSITION
from experiments.coculture.recall import Recall
from experiments.coculture.run import COMPOSITION
from experiments.laws import registry
from tests.entry import command
from tests.studies import second_vials
from tests.studies.results import leave
from tests.studies.second_vials import PROGRAMS, Conditions, Trace, draw, nominal

__all__ = ["TwoSpeciesConfig", "main", "two_species"]

log = logging.getLogger(__name__)

RIVALS = ("midpoint", "receding", "dqn_preview", "inverse_dynamics", "proportional", "pi")
CELLS: dict[str, dict[str, Any]] = {
    "nominal": {},
    "mu_e x 0.8": {"scale_e": 0.8},
    "mu_e x 1.2": {"scale_e": 1.2},
    "mu_p x 0.8": {"scale_p": 0.8},
    "mu_p x 1.2": {"scale_p": 1.2},
    "thermometer +0.5": {"offset_c": 0.5},
    "another bottle": {"bottle_swap": 8.0},
    "18 °C around it": {"ambient_c": 18.0},
}
STEPS = ("ratio_steps", "small_steps", "quick")
HOLDS = ("hold", "ratio_steps")
WARM_UP_MIN = 60


@dataclass(frozen=True)
class TwoSpeciesConfig:
    """How many vials, and for how long."""

    vials: int = setting(64, "in each row and cell", within=(2, 1000))
    days: int = setting(7, "of the coverage", "days", within=(1, 14))
    hours: float = setting(27.0, "of each law", "h", within=(4, 200))
    samples_a_day: int = setting(2, "in the row with offline samples, each with sd 0.03", within=(0, 24))
    workers: int = setting(0, "processes; 0 for one per core", within=(0, 256))
    seed: int = setting(1, "of vials and noise", at_least=0)

    def __post_init__(self) -> None:
        check(self)


def flown(conditions: Conditions, law: str, program: str, hours: float, seed: int, samples: int = 0) -> Trace:
    """One law on all vials, by the project's estimator as it is."""
    policy = load(SHIPPED_COMPOSITION[law]) if law in SHIPPED_COMPOSITION else None
    made = registry.build(registry.config(law, SHARE), SHARE, policy=policy)
    when = [24.0 * (k + 0.5) / samples for k in range(round(hours / 24.0) * samples)] if samples else []
    estimator = Recall(CompositionEstimator(CompositionEstimatorConfig()))
    return second_vials.run(conditions, estimator, made, PROGRAMS[program], hours, seed=seed, samples=when)


def day_by_day(config: TwoSpeciesConfig, calibrated: bool, program: str, samples: int) -> dict[str, list[float]]:
    """Share of the minutes of each day in which the band holds the truth, and mean |error| of the estimate."""
    conditions = draw(config.vials, config.seed, calibrated=calibrated)
    trace = flown(conditions, COMPOSITION, program, 24.0 * config.days, config.seed, samples)
    covered, error = second_vials.coverage(trace).mean(1), second_vials.estimate_error(trace).mean(1)
    return {"coverage_pct": (100.0 * covered).tolist(), "error": error.tolist()}


def cell(config: TwoSpeciesConfig, which: str, program: str) -> dict[str, list[float]]:
    """Mean |share - setpoint| of each law and vial, behind the first hour; doses spread as drawn, known sensors."""
    drawn = draw(config.vials, config.seed)
    fixed = {"calibrated": True, "dose_spread": drawn.dose_spread, **CELLS[which]}
    conditions = replace(nominal(config.vials), **fixed)
    found: dict[str, Array] = {}
    for law in RIVALS:
        trace = flown(conditions, law, program, config.hours, config.seed)
        found[law] = np.abs(trace.share - trace.setpoint)[WARM_UP_MIN:].mean(axis=0)
    return {law: error.tolist() for law, error in found.items()}


def two_species(config: TwoSpeciesConfig, folder: Path) -> None:
    """Both tables, and in how many cells some law is better than the default one."""
    kinds = [(calibrated, program, 0) for calibrated in (True, False) for program in HOLDS]
    kinds += [(False, "hold", config.samples_a_day)] * bool(config.samples_a_day)
    places = [(which, program) for program in STEPS for which in CELLS]
    with Workers(config.workers) as pool:
        weeks: list[Future[Any]] = [pool.submit(day_by_day, config, *kind) for kind in kinds]
        cells: list[Future[Any]] = [pool.submit(cell, config, *place) for place in places]
        days = []
        for kind, week in zip(kinds, weeks, strict=True):
            days.append(week.result())
            log.info("%s: %s", named(*kind), "; ".join(daily(days[-1])))
        laws = []
        for place, one in zip(places, cells, strict=True):
            laws.append(one.result())
            log.info("%s, %s: %s", place[1], place[0], " | ".join(compared(laws[-1])))
    head = ["vials", *(f"day {k + 1}" for k in range(config.days))]
    rows = [(named(*kind), *daily(found)) for kind, found in zip(kinds, days, strict=True)]
    leave(folder, __file__, head, rows, "week")
    rows = [(program, which, *compared(found)) for (which, program), found in zip(places, laws, strict=True)]
    leave(folder, __file__, ["program", "vials", *RIVALS], rows, "laws")
    beaten = [place for place, found in zip(places, laws, strict=True) if any(better(found, law) for law in RIVALS)]
    log.info("in %d of %d cells some law is better than %s: %s", len(beaten), len(places), COMPOSITION, beaten)
    found = {"weeks": [{"kind": kind, **d} for kind, d in zip(kinds, days, strict=True)], "beaten": beaten}
    files.write_json(folder / "summary.json", {**found, "cells": places, "errors": laws})


def named(calibrated: bool, program: str, samples: int) -> str:
    """A row of the first table."""
    said = f"{'calibrated' if calibrated else 'not calibrated'}, {program}"
    return said if not samples else f"{said}, {samples} samples a day"


def daily(found: dict[str, list[float]]) -> list[str]:
    """Cells of the first table: coverage in %, mean error."""
    return [f"{c:.0f} %, {e:.3f}" for c, e in zip(found["coverage_pct"], found["error"], strict=True)]


def difference(found: dict[str, list[float]], law: str) -> tuple[float, float]:
    """Mean of the error less the default law's, vial by vial, and half its 95 % interval."""
    less = np.subtract(found[law], found[COMPOSITION])
    return float(less.mean()), 1.96 * float(less.std(ddof=1)) / len(less) ** 0.5


def better(found: dict[str, list[float]], law: str) -> bool:
    """Whether a law is better than the default one by an interval that excludes none."""
    mean, half = difference(found, law)
    return law != COMPOSITION and mean + half < 0.0


def compared(found: dict[str, list[float]]) -> list[str]:
    """Cells of the second table: mean of every law, and less that of the default one with its interval."""
    cells = []
    for law in RIVALS:
        mean, half = difference(found, law)
        text = f"{np.mean(found[law]):.4f}"
        cells.append(text if law == COMPOSITION else f"{text} ({mean:+.4f} ± {half:.4f})")
    return cells


main = command(__file__, TwoSpeciesConfig(), two_species)


if __name__ == "__main__":
    main()
