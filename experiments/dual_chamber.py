"""The two-chamber rig in simulation, laws side by side: `python -m experiments.dual_chamber`.

Every law on every plant, shown the true state, an estimate from OD and fluorescence, or one from OD alone. All meet the
same rigs and noise (docs/dual_chamber.md).
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, require, setting
from envs.dual_chamber import optimum
from envs.dual_chamber.estimator import Estimator, EstimatorConfig
from envs.dual_chamber.laws import GAIN_OD, GAIN_RATIO, PI, FeedForward, Law, Planned, hold_reservoir, spare_reservoir
from envs.dual_chamber.rig import RESERVOIR, Rig, RigCase, RigConfig, carried
from envs.dual_chamber.task import mixture, settled, start, steady_dose
from envs.plant.noise import streams, uniform
from experiments.cli import files, frame

__all__ = ["DualChamberConfig", "Trial", "closed_loop", "main", "row"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

LAWS = ("feed_forward", "proportional", "pi", "myopic", "optimum", "preview")
OBSERVED = ("state", "fluorescence", "od")


@dataclass(frozen=True)
class DualChamberConfig:
    """Which loops are run. Raises: ValueError naming key, value and allowed range."""

    replicates: int = setting(16, "rigs per law, plant and observation, run as one batch", within=(1, 10_000))
    seed: int = setting(0, "of rigs and noise; every law meets the same", at_least=0)
    od: float = setting(0.5, "density asked for", "OD", within=(0.2, 1.2))
    ratios: tuple[float, ...] = setting((0.25, 0.5, 0.75), "shares of the slow strain asked for, in this order",
                                        within=(0.05, 0.95), some=True)  # fmt: skip
    window_min: int = setting(180, "minutes of each", "min", within=(10, 1440))
    start_ratio: tuple[float, float] = setting((0.4, 0.6), "range of the share at the start, the filter takes the mean",
                                               within=(0.05, 0.95), interval=True)  # fmt: skip
    laws: tuple[str, ...] = setting(LAWS, "which laws", choices=LAWS, some=True)
    observed: tuple[str, ...] = setting(OBSERVED, "what they are shown", choices=OBSERVED, some=True)
    supply_margin: float = setting(
        1.5, "level of the reservoir that fast steps leave, in multiples of the critical one; 0: none", within=(0, 5)
    )
    rig: RigConfig = part(RigConfig, "what laws and filter believe")
    estimator: EstimatorConfig = part(EstimatorConfig, "the filter")
    plants: dict[str, RigCase] = setting({"nominal": RigCase()}, "plants by name")

    def __post_init__(self) -> None:
        check(self)
        for name, case in self.plants.items():
            allowed = f"below rig.largest_ml = {self.rig.largest_ml:g}"
            require(case.smallest_ml < self.rig.largest_ml, f"plants.{name}.smallest_ml", case.smallest_ml, allowed)

    @property
    def program(self) -> Array:
        """The share asked for in each minute, (K,)."""
        return np.repeat(self.ratios, self.window_min)


@dataclass(frozen=True, eq=False)
class Trial:
    """A closed loop: true and believed X and rho after each minute and the doses before it, (K, N), doses (K, N, 3)."""

    od: Array
    ratio: Array
    believed_od: Array
    believed_ratio: Array
    dose: Array


def closed_loop(config: DualChamberConfig, case: RigCase, law: Law, observed: str) -> Trial:
    """N rigs through the program."""
    rngs = streams(np.random.default_rng(config.seed), config.replicates)
    share = uniform(rngs, *config.start_ratio)
    rig = Rig(config.rig, case, rngs, start(config.rig, config.od, share))
    believed = start(config.rig, config.od, np.full(len(rngs), np.mean(config.start_ratio)))
    filtered = Estimator(config.estimator, config.rig, believed, observed == "fluorescence")
    rest, kept = np.zeros((len(rngs), 3)), []
    for minute, ratio in enumerate(config.program.tolist()):
        state = rig.state if observed == "state" else filtered.state
        asked = law.act(state, ratio, minute)
        if config.supply_margin:
            steady = steady_dose(config.rig, config.od, ratio, state[:, RESERVOIR])[1]
            asked[:, 1] = spare_reservoir(config.rig, state, asked[:, 1], steady, config.supply_margin)
        asked[:, 2] = hold_reservoir(config.rig, state, asked[:, 1])
        if case.carry_over:
            asked, rest = carried(asked, rest, case.smallest_ml, config.rig.largest_ml)
        dose = np.clip(asked, 0.0, config.rig.largest_ml)
        filtered.update(dose, rig.step(dose))
        state = rig.state if observed == "state" else filtered.state
        kept.append((*mixture(rig.state), *mixture(state), dose))
    return Trial(*(np.stack(of) for of in zip(*kept, strict=True)))


def _planned(config: DualChamberConfig, case: RigCase) -> dict[str, Callable[[], Law]]:
    """Laws by dynamic programming; the grid's model is made once for all."""
    grid = optimum.model(config.rig, case.smallest_ml, config.od, config.ratios)
    law: dict[str, Callable[[], Law]] = {"myopic": lambda: Planned(config.rig, config.od, grid)}
    if "optimum" in config.laws:
        lasting = np.tile(np.unique(config.ratios), (config.window_min, 1))
        value = optimum.cost_to_go(grid, config.od, lasting)[0]
        by_ratio = {float(r): value[:, b].copy() for b, r in enumerate(lasting[0])}
        law["optimum"] = lambda: Planned(config.rig, config.od, grid, by_ratio)
    if "preview" in config.laws:
        ahead = [*optimum.cost_to_go(grid, config.od, config.program[:, None])[1:, :, 0]]
        law["preview"] = lambda: Planned(config.rig, config.od, grid, ahead)
    return law


def laws(config: DualChamberConfig, case: RigCase) -> dict[str, Callable[[], Law]]:
    """Name -> a law that remembers nothing yet."""
    rig, od = config.rig, config.od
    known: dict[str, Callable[[], Law]] = {
        "feed_forward": lambda: FeedForward(rig, od),
        "proportional": lambda: FeedForward(rig, od, GAIN_OD, GAIN_RATIO),
        "pi": lambda: PI(rig, od, config.replicates),
    }
    if set(config.laws) - set(known):
        known |= _planned(config, case)
    return {name: known[name] for name in config.laws}


def row(config: DualChamberConfig, trial: Trial) -> dict[str, Any]:
    """Figures of a trial; settled_min a window, the median over rigs, null where half or more never settle.

    cost: mean of the task's cost a minute. Errors are of the true state; the filter's are those of its estimates.
    """
    wanted, shape = config.program[:, None], (len(config.ratios), config.window_min, -1)
    windows = zip(trial.od.reshape(shape), trial.ratio.reshape(shape), config.ratios, strict=True)
    times = [np.nan_to_num(settled(od, ratio, config.od, r), nan=np.inf) for od, ratio, r in windows]
    error, off = trial.ratio - wanted, trial.od - config.od
    return {
        "ratio_abs_error_mean": float(np.abs(error).mean()),
        "od_abs_error_mean": float(np.abs(off).mean()),
        "cost": float(((off / config.od) ** 2 + error**2).mean()),
        "settled_min": [float(np.median(t)) for t in times],
        "settled_share": [float(np.isfinite(t).mean()) for t in times],
        "ekf_mse_od": float(np.square(trial.believed_od - trial.od).mean()),
        "ekf_mse_ratio": float(np.square(trial.believed_ratio - trial.ratio).mean()),
        "n": config.replicates,
    }


def draw(config: DualChamberConfig, trials: dict[tuple[str, str], Trial], plant: str, folder: Path) -> None:
    """Share, density and flow from the reservoir of one plant, a column for each observation, means over rigs."""
    from experiments.reporting import charts

    columns = len(config.observed)
    figure, axes = charts.new_figure(4.2 * columns, 7.0, 3, columns, sharex=True, sharey="row")
    minutes = np.arange(1, config.program.size + 1)
    for (law, observed), trial in trials.items():
        at, colour = config.observed.index(observed), charts.COLOURS[LAWS.index(law)]
        flow = np.cumsum(trial.dose[..., 1].mean(axis=1))
        for line, values in enumerate((trial.ratio.mean(axis=1), trial.od.mean(axis=1), flow)):
            axes[line * columns + at].plot(minutes, values, color=colour, linewidth=1.1, label=law)
    for at, observed in enumerate(config.observed):
        axes[at].step(minutes, config.program, where="pre", color="black", linewidth=0.9, linestyle="--")
        axes[at].set_title(f"{plant}, shown: {observed}")
        axes[columns + at].axhline(config.od, color="black", linewidth=0.9, linestyle="--")
        axes[2 * columns + at].set_xlabel("minutes")
    axes[0].set(ylabel="share of the slow strain", ylim=(0.0, 1.0))
    axes[columns].set(ylabel="density X, OD", ylim=(0.4 * config.od, 1.6 * config.od))
    axes[2 * columns].set_ylabel("reservoir, mL so far")
    axes[0].legend()
    charts.save(figure, folder / "figures", plant)


def study(config: DualChamberConfig, folder: Path) -> None:
    """Every loop; summary.json, table.csv and a figure for each plant."""
    rows = []
    for plant, case in config.plants.items():
        trials = {}
        for law, made in laws(config, case).items():
            for observed in config.observed:
                trials[law, observed] = trial = closed_loop(config, case, made(), observed)
                rows.append({"law": law, "observed": observed, "plant": plant, **row(config, trial)})
        log.info("%s: %d loops of %d rigs", plant, len(trials), config.replicates)
        draw(config, trials, plant, folder)
        files.write_csv(folder / "table.csv", rows)
    files.write_json(folder / "summary.json", {"rows": rows})
    log.info("table %s, figures in %s", folder / "table.csv", folder / "figures")


main = frame.Command("dual_chamber", DualChamberConfig(), study)


if __name__ == "__main__":
    main()
