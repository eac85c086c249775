"""Run a benchmark: train, run the closed loops, compare the controllers, write figures and page."""

import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf import guests
from dqn import policy as policies
from envs.plant.plant import PlantConfig
from experiments.certification import certificate
from experiments.cli import files, frame
from experiments.cli.calibrated import read_plant_file
from experiments.comparison import page as pages
from experiments.comparison import statistics, studies
from experiments.comparison.config import TWIN, BenchmarkConfig
from experiments.comparison.trials import DensityTrial, Followed, Loops, cells
from experiments.control.policies import find_policy, load_policy
from experiments.laws.density.learned import settings
from experiments.reporting import charts, page
from experiments.reporting.tables import count
from experiments.training.config import TrainConfig

log = logging.getLogger(__name__)

COMPLETED: list[Callable[[BenchmarkConfig], BenchmarkConfig]] = []
"""Functions of guests that complete a benchmark's config."""
FOLLOWED: dict[str, Callable[[BenchmarkConfig, Iterable[str], Path], Mapping[str, Followed | None]]] = {}
"""Signal of a guest -> function that returns each controller's policy or None, and copies it into the run folder."""


def learned(
    config: BenchmarkConfig, wanted: set[str], folder: Path
) -> tuple[dict[str, Followed], dict[str, Any], list[dict[str, str]]]:
    """Load or train the policies of learned controllers; return policies, their origin and scores, and figures."""
    found: dict[str, Followed] = {}
    agents: dict[str, Any] = {}
    figures = []
    for name in sorted(wanted):
        if name in config.policies or name not in config.agents:
            where = config.policies.get(name, "shipped")
            policy = load_policy(where, config.env.control_min, config.env.max_pump_rate)
            laws = config.controllers.get(name)
            own = settings(policy, getattr(laws, "estimator", {}))
            found[name] = policy, certificate.bounds(policy, own, find_policy(where), config.env)
            agents[name] = {"policy": where, "regret_pct": policy.metadata.get("regret_pct")}
    for name in sorted(wanted - set(found)):
        from experiments.training.run import train  # torch, only for training

        log.info("training %s: %d seeds", name, config.train_seeds)
        run = folder / "training" / name
        run.mkdir(parents=True)
        setup = TrainConfig(env=config.env, agent=config.agents[name], seed=config.seed, n_agents=config.train_seeds)
        frame.save_config(setup, run)
        train(setup, run)
        found[name] = policies.load(run / "policy.npz"), None
        summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
        keys = ("seeds", "env_steps", "updates", "regret_pct", "steady_abs_error", "policy_seed", "config_hash")
        agents[name] = {"policy": f"training/{name}/policy.npz", **{key: summary[key] for key in keys}}
        agents[name]["agent"] = asdict(config.agents[name])
        at = summary["seeds"].index(summary["policy_seed"])
        caption = (
            f"{config.train_seeds} seeds of {summary['env_steps']} environment steps each, 100 per episode. "
            f"Bands: range and middle half of the seeds. Policy used: seed {summary['policy_seed']}, the best on the "
            f"selection grid; its regret on the reported grid is {summary['regret_pct'][at]:.2f} %."
        )
        title = f"Training of {name} (the paper's Fig. 2b)"
        figures.append({"file": f"training/{name}/figures/learning.svg", "title": title, "caption": caption})
    return found, agents, figures


def _store(trials: Sequence[DensityTrial], folder: Path) -> None:
    """Write all trajectories to trajectories.npz: arrays SCENARIO/PLANT/CONTROLLER/od and so on, shape (N, K)."""
    arrays = {
        f"{t.cell.scenario}/{t.cell.plant}/{t.cell.controller}/{key}": getattr(t, key).astype(np.float32)
        for t in trials
        for key in ("od", "clean", "rate", "temperature")
    }
    np.savez_compressed(folder / "trajectories.npz", **arrays)


def with_twin(config: BenchmarkConfig) -> BenchmarkConfig:
    """Add the plant of `plant_file`; its vials start at a random time of the recording. Raises: frame.UserError."""
    if config.plant_file is None:
        return config
    twin = read_plant_file(config.plant_file)
    last = max((*twin.growth.knots_min, *twin.pump.knots_min), default=0.0)
    twin = replace(twin, start_spread_min=max(last - twin.start_min, 0.0), start_od=PlantConfig().start_od)
    return replace(config, plants={**config.plants, TWIN: twin})


def with_seeds(config: BenchmarkConfig) -> BenchmarkConfig:
    """Replace each learned controller whose policy is a folder of several seeds by one controller per seed."""
    for name, where in config.policies.items():
        if name not in config.controllers or config.controllers[name].kind != "dqn":
            known = [n for n, c in config.controllers.items() if c.kind == "dqn"]
            raise frame.UserError(f"policies.{name}: not a learned controller; use one of {', '.join(known)}")
        seeds = {f"{name}_{path.stem}": path for path in sorted(Path(where).glob("seed*.npz"))}
        if not seeds:
            continue
        given = {n: w for n, w in config.policies.items() if n != name} | {n: str(path) for n, path in seeds.items()}
        laws = config.controllers | {n: config.controllers[name] for n in seeds}
        studies = {
            key: replace(s, controllers=tuple(n for c in s.controllers for n in (seeds if c == name else (c,))))
            for key, s in config.studies.items()
        }
        config = replace(config, policies=given, controllers=laws, studies=studies)
    return config


def benchmark(config: BenchmarkConfig, folder: Path) -> None:
    """Run a benchmark and write its output files into a folder."""
    guests.load("experiments.comparison")
    for completed in COMPLETED:
        config = completed(config)
    config = with_seeds(with_twin(config))
    wanted = cells(config)
    if not (wanted or config.training or config.calibration):
        raise frame.UserError("nothing to run: choose a recipe, e.g. +experiment=paper or +experiment=setpoint_steps")
    shown: list[dict[str, str]] = []

    def keep(drawing: studies.Drawing) -> None:
        charts.save(drawing.figure, folder / "figures", drawing.name)
        file = f"figures/{drawing.name}.svg"
        shown.append({"file": file, "title": drawing.title, "caption": drawing.caption})

    fitted = None
    if config.calibration:
        try:
            fitted, drawing = studies.calibration(config)
        except ValueError as error:
            raise frame.UserError(f"calibration: {error}") from None
        keep(drawing)
    density = [cell for cell in wanted if cell.signal == "density"]
    names = {c.controller for c in density if config.controllers[c.controller].kind == "dqn"}
    with Loops(config) as loops:
        for signal, policies_of in FOLLOWED.items():
            own = [cell for cell in wanted if cell.signal == signal]
            for name, followed in policies_of(config, sorted({cell.controller for cell in own}), folder).items():
                loops.start([cell for cell in own if cell.controller == name], followed)
        loops.start([cell for cell in density if cell.controller not in names])  # they run during the training
        found, agents, learning = learned(config, names | (set(config.agents) if config.training else set()), folder)
        shown += learning
        for name in sorted(names):
            loops.start([cell for cell in density if cell.controller == name], found[name])
        done = loops.results()
    trials = [done[cell] for cell in wanted]
    summary = studies.summarise(config, trials)
    for drawing in studies.draw(config, trials, summary):
        keep(drawing)
    if density:
        _store([t for t in trials if isinstance(t, DensityTrial)], folder)
    more = {"calibration": fitted, "agents": agents, "figures": shown}
    files.write_json(folder / "summary.json", statistics.content(summary) | more)
    report = page.save(pages.of_benchmark(folder), folder)
    loops_of = f"{count(len(trials), 'closed loop')} of {count(config.replicates, 'replicate')}"
    log.info("%s; report %s", loops_of, report)
