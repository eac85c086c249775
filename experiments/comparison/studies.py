"""Results of a benchmark: simulated calibration, figures of the closed loops, summary.json."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.open_loop import OpenLoop, open_loop
from envs.identification.screening import Series
from experiments.comparison import figures, statistics
from experiments.comparison.config import SETTLING_MIN, TABLE_2, BenchmarkConfig
from experiments.comparison.statistics import Row, Summary
from experiments.comparison.trials import DensityTrial, Trial
from experiments.reporting.calibration_charts import fit_figure

CAPTIONS = {
    "regulation": "Regulation at 0.5 (the paper's Fig. 2c)",
    "setpoint_steps": "Three setpoints (the paper's Fig. 3a-b)",
    "temperature_switch": "37 to 30 °C (the paper's Fig. 3c)",
    "comparison": "Controllers side by side at 0.5 (the paper's Fig. 4)",
}
AGAINST: dict[str, tuple[str, ...]] = {"density": ("dqn", "dqn_adaptive", "oracle")}
"""Signal -> reference controllers of the paired comparisons; a guest adds its own signal."""
DRAWN: dict[str, Callable[[Sequence[Any], Sequence[Row]], Iterator["Drawing"]]] = {}
"""Signal of a guest -> function that draws figures from its trials and from their rows of summary.json."""


class Drawing(NamedTuple):
    """Figure with the name of its file, and its title and caption on the page."""

    name: str
    figure: Figure
    title: str
    caption: str


def calibration(config: BenchmarkConfig) -> tuple[dict[str, Any], Drawing]:
    """Simulate the paper's open-loop protocol on the training model, and fit the recording; return numbers and figure.

    Raises: ValueError if the fit fails.
    """
    protocol = OpenLoop(mu=config.env.mu, tau=config.env.tau, control_min=config.env.control_min, seed=config.seed)
    time, od, rate = open_loop(protocol, np.random.default_rng(config.seed))
    raw = Series(time, od[0], rate[0], np.arange(time.size))
    result = calibrate(raw, IdentifyConfig(method="free_run"))
    mu, tau = result.mu, result.tau
    found = {
        "mu": {"value": mu.value, "ci95": [mu.low, mu.high], "truth": protocol.mu},
        "tau": {"value": tau.value, "ci95": [tau.low, tau.high], "truth": protocol.tau},
        "pmse_pct": result.pmse_pct,
        "n_used": result.n_used,
    }
    return found, Drawing(
        "fig2a_calibration",
        fit_figure(raw, result, "open-loop recording and free-running model"),
        "Calibration (the paper's Fig. 2a)",
        f"One simulated open-loop recording of {protocol.hours:g} h with {100 * protocol.noise:g} % sensor noise, and "
        f"the fitted model, simulated from the start without feedback. PMSE {result.pmse_pct:.2g} % (paper: 6 % on a "
        "real recording).",
    )


def draw(config: BenchmarkConfig, trials: list[Trial], summary: Summary) -> Iterator[Drawing]:
    """Draw the figures of the studies. Args: summary: as `summarise` returns it."""
    for signal, drawn in DRAWN.items():
        yield from drawn([t for t in trials if t.cell.signal == signal], summary["rows"])
    yield from _closed_loops(config, [t for t in trials if isinstance(t, DensityTrial)])
    if {"setpoint_steps", "temperature_switch"} & set(config.studies):
        yield Drawing(
            "table2",
            figures.published_and_ours(_table_2_rows(summary["rows"], config)),
            "The paper's Table 2 beside this run",
            f"Hollow: published, real reactors, n = 3. Filled: this run, n = {config.replicates}; bar: 95 % interval "
            "of the mean. Left is better.",
        )
    for scenario in dict.fromkeys(s for study in config.studies.values() for s in study.scenarios):
        totals = [e for e in summary["totals"] if e.scenario == scenario]
        if len({e.controller for e in totals}) < 5:
            continue
        yield Drawing(
            f"plants_{scenario}",
            figures.plants(totals),
            f"Every plant, {scenario}",
            f"ISE and ITAE of the measured OD, summed over the windows; mean and 95 % interval, n = "
            f"{config.replicates}. Red: score of the sensor's noise alone, for a culture exactly on the setpoint. "
            "The controller hold is not drawn, because its values are far larger.",
        )
        learned = "dqn_adaptive" if any(e.controller == "dqn_adaptive" for e in totals) else "dqn"
        against = [e for e in summary["paired_totals"] if e.scenario == scenario and e[statistics.AGAINST] == learned]
        if against:
            yield Drawing(
                f"differences_{scenario}",
                figures.differences(against, learned),
                f"Difference to {learned}, {scenario}",
                f"Paired over {config.replicates} replicates with the same vials, pumps and noise: mean and 95 % "
                f"interval, in % of {learned}'s mean. Left of zero: better than {learned}. "
                "The controller hold is not drawn, because its values are far larger.",
            )


def _closed_loops(config: BenchmarkConfig, trials: Sequence[DensityTrial]) -> Iterator[Drawing]:
    """Draw OD and pump rate for the paper's studies, and for studies with only one scenario and plant."""
    by_cell = {(t.cell.controller, t.cell.plant, t.cell.scenario): t for t in trials}
    for name, study in config.studies.items():
        several = len(study.plants) * len(study.scenarios) > 1
        if not study.controllers or (several and name not in CAPTIONS):
            continue
        for scenario in study.scenarios:
            for plant in study.plants:
                shown = [by_cell[c, plant, scenario] for c in study.controllers if (c, plant, scenario) in by_cell][:4]
                if not shown:
                    continue
                long = config.scenarios[scenario].total_min > figures.LONG_MIN
                what = "noise-free OD and pump rate in blocks of 10 min" if long else "measured OD and pump rate"
                yield Drawing(
                    f"{name}_{scenario}_{plant}" if several or name not in CAPTIONS else name,
                    figures.bands(shown),
                    CAPTIONS.get(name, f"{name}: {scenario} on {plant}"),
                    f"Plant {plant}, {config.replicates} replicates. Line: mean over replicates of {what}; band: ± one "
                    "standard deviation; dashed: setpoint.",
                )


def _table_2_rows(rows: list[Row], config: BenchmarkConfig) -> list[Row]:
    """List the rows that correspond to the paper's Table 2: its two studies, each on its first plant."""
    paper = {name: config.studies[name] for name in ("setpoint_steps", "temperature_switch") if name in config.studies}
    cells = {(name, study.plants[0], c) for name, study in paper.items() for c in study.controllers if study.plants}
    return sorted((r for r in rows if (r.scenario, r.plant, r.controller) in cells), key=lambda r: r.scenario)


def summarise(config: BenchmarkConfig, trials: list[Trial]) -> Summary:
    """Build summary.json from the trials: the numbers of all closed loops, and those of the paper."""
    plants, controllers = list(config.plants), list(config.controllers)
    density = [t for t in trials if isinstance(t, DensityTrial)]
    ordered = sorted(density, key=lambda t: (plants.index(t.cell.plant), controllers.index(t.cell.controller)))
    of_signal = {signal: [t for t in trials if t.cell.signal == signal] for signal in AGAINST}
    rows = statistics.rows(trials)
    return {
        "loops": len(trials),
        "rows": rows,
        "paper": [p._asdict() for p in TABLE_2],
        "paper_settling_min": SETTLING_MIN,
        "beside_paper": [
            {k: r.values[k] for k in ("controller", "plant", "scenario", "window")} for r in _table_2_rows(rows, config)
        ],
        "details": statistics.details(density),
        "totals": statistics.totals(ordered),
        "paired": [
            p for key, names in AGAINST.items() for name in names for p in statistics.pairs(of_signal[key], name)
        ],
        "paired_totals": [
            p for name in AGAINST["density"] for p in statistics.pairs(ordered, name, statistics.total_scores)
        ],
        "replicates": config.replicates,
        "seed": config.seed,
    }
