"""Benefit and cost of the shipped policy's supervisor: `python -m tests.studies.supervision`.

False alarms of a sound filter; distance of a culture from its setpoint with a deliberately faulty filter,
with the supervisor, without it, and with the one-line controller on it; ITAE with and without monitored innovations.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np

from conf import presets
from conf.schema import build, check, setting
from dqn.policy import Policy
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.cli import files
from experiments.comparison.statistics import Spread, totals
from experiments.comparison.trials import Cell, DensityTrial, run_trial, windows
from experiments.control.policies import SHIPPED, load_policy
from experiments.laws.base import Controller
from experiments.laws.density import estimator as filters
from experiments.laws.density.estimator import EstimatorConfig
from experiments.laws.density.inverse import Inverse, InverseConfig
from experiments.laws.density.learned import RelativeController, settings
from experiments.reporting.tables import Table, number
from tests.entry import command

__all__ = ["BLIND", "SupervisionConfig", "main"]

log = logging.getLogger(__name__)

BLIND = EstimatorConfig(
    noise_floor=1e-4, noise_relative=0.0, noise_memory=0.0, gate_max=20, gate_od=0.0, pulse_cv=0.0, growth_cv=0.0
)
"""It believes that it knows everything, and asks a reading that says otherwise for twenty more."""
STEPS = Scenario((0.8, 0.65, 0.5), (30.0,) * 3, (37.0,) * 3, recovery_od=0.8)
SWITCH = Scenario((0.5, 0.5), (30.0, 30.0), (37.0, 30.0), recovery_od=0.5)
Make = Callable[[], Controller]


@dataclass(frozen=True)
class SupervisionConfig:
    """How many vials, for how long, on which plants."""

    vials: int = setting(256, "of each run", within=(2, 4096))
    hours: float = setting(
        26.0, "for which false alarms are counted on nominal_noise, held at 0.5", "h", within=(1, 1000)
    )
    plants: tuple[str, ...] = setting(
        ("nominal_noise", "bench", "tired_pump", "bad_optics", "recorded"), "on which ITAE is compared"
    )
    seed: int = setting(5, "of the vials", at_least=0)

    def __post_init__(self) -> None:
        check(self)


@cache
def learned() -> Policy:
    """The policy that ships."""
    return load_policy("shipped", 1.0, 0.02)


def shipped(estimator: EstimatorConfig | None = None) -> RelativeController:
    """It with its own estimator, or with another, for which it has no bounds."""
    policy, model = learned(), EnvConfig()
    bounds = None if estimator else certificate.bounds(policy, settings(policy), SHIPPED, model)
    return RelativeController(policy, estimator or EstimatorConfig(), model, bounds)


@contextmanager
def deaf() -> Iterator[None]:
    """Switch off innovation alarms in this context."""
    with patch.object(filters, "FIXED", replace(filters.FIXED, loud=np.inf, quiet=-1.0)):
        yield


def trial(config: SupervisionConfig, plant: str, schedule: Scenario, make: Make) -> DensityTrial:
    """One run of all vials."""
    preset = build(PlantConfig(), presets.load(f"plant/{plant}"), "plant")
    cell = Cell("law", plant, "schedule")
    return run_trial(cell, preset, schedule, lambda _: make(), EnvConfig(), config.vials, config.seed)


def at_rest(found: DensityTrial) -> float:
    """Mean noise-free |x - r| of the last ten minutes of every window, OD."""
    return float(np.mean([found.score(w, "clean").steady_abs_error for w in windows(found.schedule)]))


def blinded(config: SupervisionConfig) -> Table:
    """Run a sound filter and a faulty one on nominal_noise."""
    runs: dict[str, tuple[Make, bool]] = {
        "sound filter, supervised": (shipped, False),
        "faulty filter, supervised": (lambda: shipped(BLIND), False),
        "faulty filter, innovations not monitored": (lambda: shipped(BLIND), True),
        "one-line controller on the faulty filter": (
            lambda: Inverse(InverseConfig(estimator=BLIND), EnvConfig()),
            False,
        ),
    }
    body = []
    for name, (make, unheard) in runs.items():
        with deaf() if unheard else nullcontext():
            found = trial(config, "nominal_noise", STEPS, make)
        acted = found.told.get("supervised")
        body.append((name, number(at_rest(found)), "–" if acted is None else number(100.0 * float(acted.mean()))))
        log.info("%s: rests %s OD off", name, body[-1][1])
    return Table(
        "blinded", "Distance from the setpoint, OD, and decisions by the supervisor, %", ("", "OD", "%"), tuple(body)
    )


def false_alarms(config: SupervisionConfig) -> dict[str, float]:
    """Alarms of a sound filter on nominal_noise, of each vial a day: their number, and decisions under alarm."""
    minutes = 60.0 * config.hours
    began = np.zeros(config.vials)

    class Counted(RelativeController):
        """Counts where an alarm begins."""

        def act(self, od, setpoint, minute, rows):  # type: ignore[no-untyped-def]
            before = self._alarm.copy()
            rate = super().act(od, setpoint, minute, rows)
            began[: len(before)] += self._alarm & ~before
            return rate

    sound = shipped()
    make = lambda: Counted(sound.policy, EstimatorConfig(), sound.model, sound.bounds)  # noqa: E731
    found = trial(config, "nominal_noise", Scenario((0.5,), (minutes,), (37.0,)), make)
    days = config.hours / 24.0
    per_decision = float(found.told["alarm"].mean())
    return {"alarms": float(began.mean()) / days, "decisions": per_decision * minutes / days}


def costs(config: SupervisionConfig) -> Table:
    """Compare the ITAE of the measured OD with and without monitored innovations, in %, paired."""
    body = []
    for plant in config.plants:
        for name, schedule in (("steps", STEPS), ("switch", SWITCH)):
            watched = trial(config, plant, schedule, shipped)
            with deaf():
                plain = trial(config, plant, schedule, shipped)
            mine, theirs = (np.sum([t.score(w).itae for w in windows(schedule)], axis=0) for t in (watched, plain))
            more, mean = Spread(mine - theirs), float(np.mean(theirs))
            low, high = (100.0 * end / mean for end in more.ci95)
            acted = totals([watched])[0].values["supervised_pct"]
            body.append(
                (f"{plant}, {name}", f"{100.0 * more.mean / mean:+.2f} [{low:+.2f}, {high:+.2f}]", number(acted))
            )
            log.info("%s, %s: ITAE %s %%", plant, name, body[-1][1])
    columns = ("", "ITAE, % [95 %]", "decisions by the supervisor, %")
    return Table("costs", "ITAE with monitored innovations against without", columns, tuple(body))


def supervision(config: SupervisionConfig, folder: Path) -> None:
    """All three, in the log and in summary.json."""
    alarms = false_alarms(config)
    log.info("a day and vial: %.2f false alarms, %.2f decisions under them", alarms["alarms"], alarms["decisions"])
    found = [blinded(config), costs(config)]
    rows = {table.name: [list(row) for row in table.rows] for table in found}
    files.write_json(folder / "summary.json", {"false_alarms_a_day": alarms, **rows})


main = command(__file__, SupervisionConfig(), supervision)


if __name__ == "__main__":
    main()
