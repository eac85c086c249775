"""Comparison of composition controllers: closed loops, numbers, figures and page."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from envs.bench import Bench
from envs.coculture.second import of_pair, of_plant
from envs.plant.plant import Plant
from experiments.cli import frame
from experiments.coculture.base import SHARE, Array
from experiments.coculture.config import of_benchmark, of_study, read_pair
from experiments.coculture.estimator import CompositionEstimator
from experiments.coculture.policies import composition_policy
from experiments.coculture.program import program_of, resting
from experiments.coculture.recall import Recall
from experiments.coculture.signal import TRUE, Share
from experiments.comparison import page, run, statistics, studies, trials
from experiments.comparison.config import BenchmarkConfig, StudyConfig
from experiments.comparison.figures import by_plant, estimate
from experiments.comparison.page import Measure, Section, of_column, tables
from experiments.comparison.statistics import CI95, DIFFERENCE, LOWER_IN, N, Row, RowColumn, Spread, Summary
from experiments.comparison.studies import Drawing
from experiments.comparison.trials import Cell, Followed, Trial, closed, record
from experiments.control.policies import load_policy
from experiments.laws import registry
from experiments.laws.base import Controller
from experiments.loop.loop import Step
from experiments.loop.signals import Signal
from experiments.reporting.charts import COLOURS, new_figure
from experiments.reporting.page import Page
from experiments.reporting.tables import number
from hardware.safety.config import SafetyConfig

FACTOR_SD, OFFSET_SD = 0.02, 5.0
"""Errors of a calibrated light sensor: relative sd of the factor; sd of the offset, counts, from 36 blank readings."""
FORESIGHT = ("dqn_preview", "midpoint", "receding", "optimum")  # controllers that use announcements
COLUMNS = {"share": TRUE, "estimate": "ratio", "low": "ratio_low", "high": "ratio_high"}
"""Field of a `ShareTrial` -> column of a recording."""

ABS_ERROR = RowColumn[float]("ratio_abs_error_mean", "Mean |r - setpoint|", ranked=True)
LAST_2H = RowColumn[float]("ratio_abs_error_last2h", f"{ABS_ERROR.title} in the last 2 h of each window", ranked=True)
LAST_DAY = RowColumn[float]("ratio_abs_error_last_day", f"{ABS_ERROR.title} on the last day", ranked=True)
ABS_ERROR_SD, RMS, COVERS = map(RowColumn[float], ("ratio_abs_error_sd", "estimate_rms", "band_covers"))
OD_MIN, OD_MEAN, OD_MAX = map(RowColumn[float], ("od_min", "od_mean", "od_max"))
COMBINED: tuple[tuple[str, str, Callable[[Row], str]], ...] = (
    ("estimate", "Error of the estimate (rms), and coverage of its 95 % band",
     lambda row: f"{number(row[RMS])}, {100.0 * row[COVERS]:.0f} %"),
    ("od", "OD: smallest, mean, largest", lambda row: f"{row[OD_MIN]:.3f}, {row[OD_MEAN]:.3f}, {row[OD_MAX]:.3f}"),
)  # fmt: skip
"""Tables with several columns in a cell: key, title, cell."""
SHOWN = ("pi", "proportional", "dqn", "midpoint", "dqn_preview", "optimum")  # in a figure, if there are more than these
STEP = 5  # minutes between two points of a curve
LAST_MIN, DAY_MIN = 120, 1440  # minutes at the end of a window or run over which an error is averaged
DEFINITIONS = {
    "error": "mean |r - setpoint| over all times with a setpoint; r is the true share of the second species.",
    "with preview": "the controller uses announcements of the next setpoint, made announce_min before the change. The "
    "optimum always knows the whole program.",
    "calibrated": "the estimator knows each sensor's factor and offset with errors of 2 % and 5 counts; otherwise it "
    "begins with the means of 17 real reactors.",
    "paired": "controller minus the vendor's PI in the same reactor, that is with the same vial, sensors and noise.",
    "band covers": "fraction of all minutes in which the true share is inside the estimate's 95 % band.",
}


@dataclass(frozen=True)
class ShareCell(Cell):
    """Names of a closed loop that controls the share.

    density: controller of the density. announced: whether changes of the share's setpoint are announced as in the
    scenario. calibrated: whether the light sensor is calibrated, with the usual errors.
    """

    signal: str = SHARE
    density: str = ""
    announced: bool = False
    calibrated: bool = False

    @property
    def vials(self) -> tuple[object, ...]:
        return *super().vials, self.density, self.calibrated


@dataclass(frozen=True, eq=False)
class ShareTrial(Trial):
    """Trial of a composition controller, sample by sample; arrays (N, K).

    foresight: whether the controller used announcements. setpoint: setpoint of the share, (K,), nan without one.
    share, od: true share and OD. estimate, low, high: estimated share and its 95 % band.
    """

    foresight: bool
    setpoint: Array
    share: Array
    estimate: Array
    low: Array
    high: Array
    od: Array

    def names(self) -> dict[str, Any]:
        cell = cast(ShareCell, self.cell)
        beside = {"preview": self.foresight, "density": cell.density, "calibrated": cell.calibrated}
        return super().names() | beside


def _run(config: BenchmarkConfig, cell: ShareCell, followed: Followed | None) -> ShareTrial:
    """Run a trial with one controller of the share and another of the density."""
    composition, policy = of_benchmark(config).compositions[cell.controller], followed[0] if followed else None
    scenario, pair = config.scenarios[cell.scenario], read_pair(of_benchmark(config).pair)
    schedule = scenario if cell.announced else replace(scenario, announce_min=0.0)
    program, (coldest, warmest) = program_of(scenario), pair.temperatures

    def make(plant: Plant, bench: Bench) -> tuple[Controller, Sequence[Signal], SafetyConfig]:
        law = registry.build(composition, SHARE, policy=policy, program=program, pair=pair)
        estimator = CompositionEstimator(composition.estimator, np.full(plant.n, bench.volume_ml), pair)
        share = Share(Recall(estimator), law, [schedule] * plant.n, simulated=True)
        if cell.calibrated:
            calibrate(estimator, plant, config.seed)
        safety = SafetyConfig(composition_low=coldest, composition_high=warmest)
        return _beside(config, cell.density), (share,), safety

    plant_config = config.plants[cell.plant]
    loop, plant = closed(plant_config, schedule, config.env, config.replicates, config.seed, make)

    def seen(step: Step) -> dict[str, Array]:
        columns = {key: step.columns[column] for key, column in COLUMNS.items()}
        return columns | {"temperature": step.temperature, "od": plant.culture.od}

    minute, found = record(loop, seen)
    foresight = cell.announced and composition.kind in FORESIGHT
    return ShareTrial(cell, scenario, minute, foresight=foresight, setpoint=program.setpoint(minute), **found)


def _beside(config: BenchmarkConfig, name: str) -> Controller:
    """Build the controller of the density. Raises: UserError for a policy that does not fit."""
    kind, policy = config.controllers[name].kind, None
    if kind == "dqn":
        policy = load_policy(config.policies.get(name, "shipped"), config.env.control_min, config.env.max_pump_rate)
    density: Controller = registry.build(config.controllers[name], model=config.env, policy=policy)
    return density


def calibrate(estimator: CompositionEstimator, plant: Plant, seed: int) -> None:
    """Calibrate the estimator: each reactor's true factor and offset plus the random errors of a usual calibration."""
    rng = np.random.default_rng([seed, 1])
    factor = plant.draws["fluorescence_factor"] * (1.0 + FACTOR_SD * rng.standard_normal(plant.n))
    offset = plant.draws["fluorescence_offset"] + OFFSET_SD * rng.standard_normal(plant.n)
    estimator.calibrate(factor, FACTOR_SD * factor, offset, OFFSET_SD)


def with_pair(config: BenchmarkConfig) -> BenchmarkConfig:
    """Return the config with the pair in the vials; phases without a temperature get that of equal growth."""
    pair = read_pair(of_benchmark(config).pair)
    scenarios = {name: resting(s, pair.resting_c) for name, s in config.scenarios.items()}
    plants = {name: of_pair(p, pair) if of_plant(p).second.present else p for name, p in config.plants.items()}
    return replace(config, scenarios=scenarios, plants=plants)


def policies_of(config: BenchmarkConfig, names: Iterable[str], folder: Path) -> dict[str, Followed | None]:
    """Load the policy of each composition controller, None without one; copy it into the folder. Raises: UserError."""
    found, two = dict[str, Followed | None](), of_benchmark(config)
    for name in names:
        kept = folder / "policies" / name
        kept.mkdir(parents=True, exist_ok=True)
        where = two.composition_policies.get(name, "shipped")
        policy = composition_policy(two.compositions[name].kind, where, kept, resumed=False)
        if policy is not None:
            try:
                registry.build(two.compositions[name], SHARE, policy=policy, pair=read_pair(two.pair))
            except ValueError as error:
                remedy = f"give composition_policies.{name}=RUN, or studies.NAME.compositions without {name}"
                raise frame.UserError(f"{error}; {remedy}") from None
        found[name] = None if policy is None else (policy, None)
    return found


def abs_error(trial: ShareTrial, last_min: float = math.inf) -> Array:
    """Return the mean |r - setpoint| over the last minutes, by default all, with a setpoint, (N,)."""
    rows = trial.minute > trial.minute[-1] - last_min
    return np.asarray(np.nanmean(np.abs(trial.share - trial.setpoint)[:, rows], axis=1))


def last_hours(trial: ShareTrial) -> Array:
    """Return the mean |r - setpoint| of the last 2 h of every window with a constant setpoint, (N,); nan without any.

    A controller with preview leaves a setpoint before the change, so this does not measure how well it holds.
    """
    held = np.zeros(trial.minute.size, dtype=np.bool_)
    for start, end in pairwise(trial.schedule.edges):
        inside = (trial.minute >= start) & (trial.minute < end)
        if np.unique(trial.setpoint[inside]).size == 1 and np.isfinite(trial.setpoint[inside]).all():
            held |= inside & (trial.minute >= end - LAST_MIN)
    error = np.abs(trial.share - trial.setpoint)[:, held]
    return np.asarray(error.mean(axis=1)) if held.any() else np.full(len(error), np.nan)


def share_row(trial: ShareTrial) -> Row:
    """Build the row of a trial in summary.json; errors refer to the true share."""
    error, days = Spread(abs_error(trial)), trial.minute[-1] >= 2 * DAY_MIN
    inside = (trial.low <= trial.share) & (trial.share <= trial.high)
    columns = {
        N: error.n,
        ABS_ERROR: error.mean,
        ABS_ERROR_SD: error.sd,
        CI95: error.ci95,
        LAST_2H: Spread(last_hours(trial)).mean,
        LAST_DAY: Spread(abs_error(trial, DAY_MIN)).mean if days else float("nan"),
        RMS: float(np.sqrt(np.square(trial.estimate - trial.share).mean())),
        COVERS: float(inside.mean()),
        OD_MIN: float(trial.od.min()),
        OD_MAX: float(trial.od.max()),
        OD_MEAN: float(trial.od.mean()),
    }
    return Row.of(trial.names(), columns)


def shares(trials: Sequence[ShareTrial]) -> Figure:
    """Draw true share with setpoint, and vial temperature, a column per trial: median and middle 90 % of reactors."""
    columns = len(trials)
    figure, axes = new_figure(2.7 * columns, 4.6, 2, columns, sharex=True, sharey="row", height_ratios=[2, 1])
    for k, trial in enumerate(trials):
        shown = slice(None, None, max(1, round(STEP / np.diff(trial.minute).max())))
        top, bottom, hours = axes[k], axes[columns + k], trial.minute[shown] / 60.0
        for ax, values, colour in ((top, trial.share, COLOURS[0]), (bottom, trial.temperature, COLOURS[1])):
            low, middle, high = np.quantile(values[:, shown], (0.05, 0.5, 0.95), axis=0)
            ax.fill_between(hours, low, high, color=colour, alpha=0.28, linewidth=0)
            ax.plot(hours, middle, color=colour, linewidth=1.2)
        top.plot(hours, trial.setpoint[shown], color="black", linewidth=1.0, linestyle="--")
        top.set_title(Row.of(trial.names()).law)
        bottom.set_xlabel("hours")
    axes[0].set(ylabel="share of the second species", ylim=(0.0, 1.0))
    axes[columns].set_ylabel("vial, °C")
    return figure


def share_errors(entries: Sequence[Row]) -> Figure:
    """Draw the error of every controller on every plant of a scenario: mean and 95 % interval."""
    labels = list(dict.fromkeys(e.law for e in entries))
    marks = {label: (COLOURS[k % len(COLOURS)], "o" if k < len(COLOURS) else "D") for k, label in enumerate(labels)}
    handles = [Line2D([], [], color=colour, marker=m, linestyle="", label=x) for x, (colour, m) in marks.items()]
    figure, (ax,), height = by_plant(entries, handles, 9.0, 1)
    for e in entries:
        estimate(ax, marks[e.law], height(e), e[ABS_ERROR], e[CI95])
    ax.set(xlabel="mean |r - setpoint|", xlim=(0.0, None))
    return figure


def _drawn(trials: Sequence[ShareTrial], rows: Sequence[Row]) -> Iterator[Drawing]:
    """Draw two figures per scenario: errors of all controllers on all plants, and the shares on the first plant."""
    for scenario in dict.fromkeys(t.cell.scenario for t in trials):
        here = [t for t in trials if t.cell.scenario == scenario]
        plant = here[0].cell.plant
        first = [t for t in here if t.cell.plant == plant]
        if len(first) > len(SHOWN):
            first = [t for t in first if t.cell.controller in SHOWN]
        yield Drawing(
            f"composition_{scenario}_laws",
            share_errors([r for r in rows if (r.signal, r.scenario) == ("share", scenario)]),
            f"{scenario}: every controller and plant",
            "Mean and 95 % interval over the reactors.",
        )
        yield Drawing(
            f"composition_{scenario}_shares",
            shares(first),
            f"{scenario}: shares on {plant}",
            "Line: median over the reactors; band: the middle 90 %; dashed: setpoint.",
        )


def _lower(pair: Row) -> str:
    low, high = pair[CI95]
    between = "" if low != low else f" [{low:+.4f}, {high:+.4f}]"
    return f"{pair[DIFFERENCE]:+.4f}{between}, lower in {pair[LOWER_IN]} of {pair[N]}"


def _section(out: Page, summary: Summary, run: Path) -> None:
    rows, note = summary["rows"], "n = {n} reactors each."
    for scenario in dict.fromkeys(r.scenario for r in rows):
        out.section(scenario)
        add = partial(tables, out, scenario, laws_down=True)
        for column in (ABS_ERROR, LAST_2H, LAST_DAY):
            add([r for r in rows if np.isfinite(r[column])], of_column(column, note))
        add(summary["paired"], Measure("paired", "Difference to the vendor's PI", _lower, note))
        for key, title, text in COMBINED:
            add(rows, Measure(key, title, text, note, folded=True))
        for f in (f for f in summary["figures"] if f["title"].startswith(f"{scenario}:")):
            out.figure(run / f["file"], f["title"], f["caption"])


def _split(study: StudyConfig, cell: Cell) -> list[Cell]:
    """List a loop for each composition controller of a study, each with the density controller of the cell."""
    two = of_study(study)
    beside = cell.controller, two.announced, two.calibrated
    return [ShareCell(law, cell.plant, cell.scenario, SHARE, *beside) for law in two.compositions]


trials.SPLITS.append(_split)
trials.RUNS[SHARE] = _run
statistics.ROWS[SHARE] = lambda trial: [share_row(trial)]
statistics.SCORES[SHARE] = lambda trial: [("all", "ratio_abs_error", abs_error(trial))]
studies.AGAINST[SHARE] = ("pi",)
studies.DRAWN[SHARE] = _drawn
page.RANKED[SHARE] = (ABS_ERROR, "mean |r - setpoint|")
page.SECTIONS[SHARE] = Section("Composition of two species: comparison", _section, DEFINITIONS)
run.COMPLETED.append(with_pair)
run.FOLLOWED[SHARE] = policies_of
