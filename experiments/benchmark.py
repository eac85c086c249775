"""Controllers side by side on simulated reactors, `python -m experiments.benchmark`: the paper and beyond it."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from experiments.cli import files, frame
from experiments.comparison.config import BenchmarkConfig
from experiments.control.config import TrainConfig, controller_config

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dqn.policy import Policy
    from experiments.comparison.trials import Trial
    from experiments.comparison.workers import Cell

log = logging.getLogger(__name__)


def cells(config: BenchmarkConfig) -> list[Cell]:
    """Every closed loop that some study needs, once, in the order in which they are asked for."""
    wanted: dict[Cell, None] = {}
    for study in config.studies.values():
        for scenario in study.scenarios:
            for plant in study.plants:
                wanted.update(dict.fromkeys((controller, plant, scenario) for controller in study.controllers))
    return list(wanted)


class Figures:
    """Saves figures below the run folder and remembers what each one shows, for the report."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shown: list[dict[str, str]] = []

    def add(self, name: str, figure: Figure, title: str, caption: str) -> None:
        """Save and remember a figure."""
        from experiments.reporting import charts

        charts.save(figure, self.folder / "figures", name)
        self.refer(f"figures/{name}.svg", title, caption)

    def refer(self, file: str, title: str, caption: str) -> None:
        """Remember a figure that something else saved, by its path in the run folder."""
        self.shown.append({"file": file, "title": title, "caption": caption})


def calibration(config: BenchmarkConfig, figures: Figures) -> dict[str, Any]:
    """The open-loop protocol on the training model with 1 % noise, and the fit to it.

    Raises: frame.UserError where the recording cannot be fitted.
    """
    import numpy as np

    from envs.identification.open_loop import OpenLoop, open_loop
    from envs.identification.screening import Series
    from envs.identification.window import IdentifyConfig, calibrate
    from experiments.reporting.calibration_charts import fit_figure

    protocol = OpenLoop(mu=config.env.mu, tau=config.env.tau, control_min=config.env.control_min, seed=config.seed)
    time, od, rate = open_loop(protocol, np.random.default_rng(config.seed))
    raw = Series(time, od[0], rate[0], np.arange(time.size))
    try:
        result = calibrate(raw, IdentifyConfig())
    except ValueError as error:
        raise frame.UserError(f"calibration: {error}") from None
    mu, tau = result.fit.mu, result.tau
    figures.add(
        "fig2a_calibration",
        fit_figure(raw, result, "open-loop recording and free-running model"),
        "Calibration (the paper's Fig. 2a)",
        f"One simulated open-loop recording of {protocol.hours:g} h, {100 * protocol.noise:g} % sensor noise, and the "
        f"model fitted to it, run freely from one start. PMSE {result.fit.pmse_pct:.2g} % (paper: 6 % on a real "
        "recording).",
    )
    return {
        "mu": {"value": mu.value, "ci95": [mu.low, mu.high], "truth": protocol.mu},
        "tau": {"value": tau.value, "ci95": [tau.low, tau.high], "truth": protocol.tau},
        "pmse_pct": result.fit.pmse_pct,
        "n_used": result.fit.n_used,
    }


def learned(config: BenchmarkConfig, wanted: set[str], figures: Figures) -> tuple[dict[str, Policy], dict[str, Any]]:
    """Policies of the learned controllers and where they come from: trained here, or read from `policy`."""
    import json

    from dqn import policy as policies
    from experiments.deploy import load_policy
    from experiments.train import train

    found: dict[str, Policy] = {}
    told: dict[str, Any] = {}
    if config.policy is not None and "dqn" in wanted:
        found["dqn"] = load_policy(config.policy, config.env.control_min, config.env.max_pump_rate)
        told["dqn"] = {"policy": config.policy, "regret_pct": found["dqn"].metadata.get("regret_pct")}
    for name in sorted(wanted - set(found)):
        if name not in config.agents:
            raise frame.UserError(f"controller {name}: learned, and agents holds only {', '.join(config.agents)}")
        log.info("training %s: %d seeds", name, config.train_seeds)
        folder = figures.folder / "training" / name
        folder.mkdir(parents=True)
        setup = TrainConfig(env=config.env, agent=config.agents[name], seed=config.seed, n_agents=config.train_seeds)
        frame.save_config(setup, folder)
        train(setup, folder)
        found[name] = policies.load(folder / "policy.npz")
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        keys = ("seeds", "env_steps", "updates", "regret_pct", "steady_abs_error", "policy_seed", "config_hash")
        told[name] = {"policy": f"training/{name}/policy.npz", **{key: summary[key] for key in keys}}
        told[name]["agent"] = asdict(config.agents[name])
        at = summary["seeds"].index(summary["policy_seed"])
        figures.refer(
            f"training/{name}/figures/learning.svg",
            f"Training of {name} (the paper's Fig. 2b)",
            f"{config.train_seeds} seeds of {summary['env_steps']} environment steps each, 100 per episode. "
            f"Bands over seeds: range and middle half. The policy used here is that of seed {summary['policy_seed']}, "
            f"best on the selection grid: regret {summary['regret_pct'][at]:.2f} % on the reported grid.",
        )
    return found, told


CAPTIONS = {
    "regulation": "Regulation at 0.5 (the paper's Fig. 2c)",
    "setpoint_steps": "Three setpoints (the paper's Fig. 3a-b)",
    "temperature_switch": "37 to 30 °C (the paper's Fig. 3c)",
    "comparison": "Controllers side by side at 0.5 (the paper's Fig. 4)",
}


def draw(config: BenchmarkConfig, trials: list[Trial], summary: dict[str, Any], figures: Figures) -> None:
    """The figures of the studies."""
    from experiments.comparison import figures as charts

    by_cell = {(t.controller, t.plant, t.scenario): t for t in trials}
    for name, study in config.studies.items():
        if not study.controllers or (name not in CAPTIONS and len(study.plants) * len(study.scenarios) > 1):
            continue
        for scenario in study.scenarios:
            for plant in study.plants:
                shown = [by_cell[c, plant, scenario] for c in study.controllers][:4]
                long = config.scenarios[scenario].total_min > charts.LONG_MIN
                what = "noise-free OD and pump rate in blocks of 10 min" if long else "measured OD and pump rate"
                caption = (
                    f"Plant {plant}, {config.replicates} replicates. Line: mean of {what}; band: one standard "
                    "deviation over replicates; dashed: setpoint."
                )
                key = name if name in CAPTIONS else f"{name}_{scenario}_{plant}"
                figures.add(key, charts.bands(shown), CAPTIONS.get(name, f"{name}: {scenario} on {plant}"), caption)
    if {"setpoint_steps", "temperature_switch"} & set(config.studies):
        figures.add(
            "table2",
            charts.published_and_ours(table_2_rows(summary["rows"], config)),
            "The paper's Table 2 beside this run",
            f"Hollow: published, real reactors, n = 3. Filled: this run, n = {config.replicates}; bar: 95 % interval "
            "of the mean. Left is better.",
        )
    for scenario in dict.fromkeys(s for study in config.studies.values() for s in study.scenarios):
        totals = [e for e in summary["totals"] if e["scenario"] == scenario]
        if len({e["controller"] for e in totals}) < 5:
            continue
        figures.add(
            f"plants_{scenario}",
            charts.plants(totals),
            f"Every plant, {scenario}",
            f"ISE and ITAE of the measured OD, summed over the windows; mean and 95 % interval, n = "
            f"{config.replicates}. Red: what the sensor's noise alone would score on a culture exactly on the "
            "setpoint. `hold` is off the scale and left out.",
        )
        against = [e for e in summary["paired_totals"] if e["scenario"] == scenario and e["against"] == "dqn"]
        if against:
            figures.add(
                f"differences_{scenario}",
                charts.differences(against, "dqn"),
                f"Difference to the learned policy, {scenario}",
                f"Paired over {config.replicates} replicates with the same vials, pumps and noise: mean and 95 % "
                "interval, in % of the learned policy's mean. Left of zero: better than the learned policy. "
                "`hold` is off the scale and left out.",
            )


def table_2_rows(rows: list[dict[str, Any]], config: BenchmarkConfig) -> list[dict[str, Any]]:
    """The rows that stand beside the paper's table: first plant of the studies named like its scenarios."""
    shown = []
    for name in ("setpoint_steps", "temperature_switch"):
        if name in config.studies and config.studies[name].plants:
            study = config.studies[name]
            shown += [
                r for r in rows
                if r["scenario"] == name and r["plant"] == study.plants[0] and r["controller"] in study.controllers
            ]  # fmt: skip
    return shown


def summarise(config: BenchmarkConfig, trials: list[Trial]) -> dict[str, Any]:
    """All numbers of the closed loops, and the paper's."""
    from experiments.comparison import statistics as comparison
    from experiments.comparison.published import SETTLING_MIN, TABLE_2

    plants, controllers = list(config.plants), list(config.controllers)
    ordered = sorted(trials, key=lambda t: (plants.index(t.plant), controllers.index(t.controller)))
    names = {t.controller for t in trials}
    against = [name for name in ("dqn", "oracle") if name in names]
    rows = comparison.rows(trials)
    return {
        "rows": rows,
        "paper": [p._asdict() for p in TABLE_2],
        "paper_settling_min": SETTLING_MIN,
        "beside_paper": [
            {k: r[k] for k in ("controller", "plant", "scenario", "window")} for r in table_2_rows(rows, config)
        ],
        "details": comparison.details(trials),
        "totals": comparison.totals(ordered),
        "paired": [p for name in against for p in comparison.pairs(trials, name)],
        "paired_totals": [p for name in against for p in comparison.total_pairs(ordered, name)],
        "replicates": config.replicates,
        "seed": config.seed,
    }


def _store(trials: list[Trial], folder: Path) -> None:
    """Every trajectory, as `scenario/plant/controller/od` etc. of shape (N, K), in trajectories.npz."""
    import numpy as np

    arrays = {
        f"{t.scenario}/{t.plant}/{t.controller}/{key}": getattr(t, key).astype(np.float32)
        for t in trials
        for key in ("od", "clean", "rate", "temperature")
    }
    np.savez_compressed(folder / "trajectories.npz", **arrays)


def benchmark(config: BenchmarkConfig, folder: Path) -> None:
    """Calibrate, train, run every closed loop, compare, draw, report."""
    from experiments import report
    from experiments.comparison.workers import Loops

    if not (cells(config) or config.training or config.calibration):
        raise frame.UserError("nothing to run: choose a recipe, e.g. +experiment=paper or +experiment=setpoint_steps")
    figures = Figures(folder)
    fitted = calibration(config, figures) if config.calibration else None
    wanted = cells(config)
    names = {c for c, _, _ in wanted if config.controllers[c].kind == "dqn"}
    with Loops(config) as loops:
        loops.start([cell for cell in wanted if cell[0] not in names])  # they run while the agents are trained
        policies, told = learned(config, names | (set(config.agents) if config.training else set()), figures)
        for name in sorted(names):
            loops.start([cell for cell in wanted if cell[0] == name], policies[name])
        found = loops.results()
    trials = [found[cell] for cell in wanted]
    summary = summarise(config, trials) | {"calibration": fitted, "agents": told}
    draw(config, trials, summary, figures)
    summary["figures"] = figures.shown
    _store(trials, folder)
    files.write_json(folder / "summary.json", summary)
    page = report.write(folder)
    log.info("%d closed loops of %d replicates; report %s", len(trials), config.replicates, page)


def _schema(cfg: DictConfig) -> BenchmarkConfig:
    """A controller's config is that of its kind."""
    return BenchmarkConfig(
        controllers={str(name): controller_config(str(c.kind)) for name, c in cfg.controllers.items()}
    )


main = frame.Command("benchmark", BenchmarkConfig(), benchmark, _schema)


if __name__ == "__main__":
    main()
