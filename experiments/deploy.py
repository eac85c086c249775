"""Run a learned policy in closed loop and record it: `python -m experiments.deploy`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from experiments import app
from experiments.config import DeployConfig, deploy_schema
from hardware.simulated import SimulatedConfig

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dqn.policy import Policy
    from envs.plant import PlantConfig
    from envs.setpoints import Schedule
    from envs.task import EnvConfig
    from experiments.loop import Step

    Array = NDArray[np.float64]

log = logging.getLogger(__name__)

POOR_REGRET_PCT = 25.0

COLUMNS = (
    "time_min", "elapsed_min", "phase", "od", "setpoint", "pump_rate_ml_s", "proposed_ml_s", "volume_ml",
    "temperature_degc", "guard",
)  # fmt: skip


def find_policy(name: str, root: Path = Path("runs/train")) -> Path:
    """A policy.npz from a path, a run folder or `latest`. Raises: UserError saying what to give instead."""
    if name == "latest":
        found = sorted(root.glob("**/policy.npz"), key=lambda p: p.stat().st_mtime)
        if not found:
            raise app.UserError(f"policy=latest: no policy.npz under {root}; train one first or give policy=PATH")
        return found[-1]
    path = Path(name)
    return path / "policy.npz" if path.is_dir() else path


def load_policy(name: str, control_min: float) -> Policy:
    """The policy, checked against the backend. Raises: UserError naming both values of a mismatch."""
    from dqn import policy as policies

    path = find_policy(name)
    try:
        policy = policies.load(path)
    except policies.PolicyError as error:
        raise app.UserError(str(error)) from None
    trained = float(policy.metadata.get("control_min", float("nan")))
    if abs(trained - control_min) > 1e-9:
        raise app.UserError(
            f"policy {path} was trained for a control period of {trained} min, the backend has {control_min} min; "
            f"set backend.control_min={trained} or train with env.control_min={control_min}"
        )
    regret = float(policy.metadata.get("regret_pct", float("nan")))
    log.info("policy %s: regret %.2f %% against the optimum of its model", path, regret)
    if not regret <= POOR_REGRET_PCT:
        log.warning("this policy is far from optimal (regret %.0f %%): train longer or with another seed", regret)
    return policy


def plant_of(config: DeployConfig) -> PlantConfig:
    """The simulated plant, carrying the calibrated model if one is given."""
    plant = config.plant
    if config.env_file is None:
        return plant
    from experiments.train import read_env_file

    model = read_env_file(config.env_file)
    gain = plant.vessel.volume_ml / (60.0 * model.tau)  # tau = V / (60 g)
    growth, pump = replace(plant.growth, mu=model.mu), replace(plant.pump, gain_ml_s=gain)
    return replace(plant, growth=growth, pump=pump)


def model_of(config: DeployConfig) -> EnvConfig:
    """The growth model that model-based controllers are given: the calibrated one, else the nominal one."""
    from envs.task import EnvConfig

    model = EnvConfig()
    if config.env_file is not None:
        from experiments.train import read_env_file

        model = read_env_file(config.env_file)
    return replace(model, control_min=config.backend.control_min)


class Record:
    """What a run leaves behind: one CSV per reactor, TensorBoard events, and the arrays for figure and metrics.

    Args:
      folder: run folder. names: of the reactors. fsync: each row on the disk before `add` returns.
    """

    def __init__(self, folder: Path, names: Sequence[str], fsync: bool) -> None:
        from experiments.writers import Events
        from hardware.recording import Recorder

        (folder / "recordings").mkdir(exist_ok=True)
        self.names = tuple(names)
        self._recorders = [Recorder(folder / "recordings" / f"{name}.csv", COLUMNS, fsync) for name in names]
        self.events = Events(folder)
        self.steps: list[Step] = []

    def add(self, step: Step) -> None:
        """One row per reactor that has a new sample."""
        self.steps.append(step)
        for n in step.rows.nonzero()[0]:
            row: dict[str, float | int | str | bool | None] = {
                "time_min": round(float(step.minute[n]), 4),
                "elapsed_min": round(float(step.elapsed[n]), 4),
                "phase": int(step.phase[n]),
                "od": float(step.od[n]),
                "setpoint": float(step.setpoint[n]),
                "pump_rate_ml_s": float(step.rate[n]),
                "proposed_ml_s": float(step.proposed[n]),
                "volume_ml": float(step.volume_ml[n]),
                "temperature_degc": round(float(step.temperature[n]), 3),
                "guard": step.reasons[n] or "",
            }
            self._recorders[n].write(row)
            minute = round(float(step.minute[n]))
            curves = {"od": step.od, "setpoint": step.setpoint, "pump_rate_ml_s": step.rate}
            for tag, value in {**curves, "temperature_degc": step.temperature, **step.explanation}.items():
                self.events.scalar(f"{self.names[n]}/{tag}", float(value[n]), minute)

    def series(self, field: str) -> Array:
        """A field of all steps, nan where a reactor had no new sample, shape (N, K)."""
        import numpy as np

        values = np.array([np.where(step.rows, getattr(step, field), np.nan) for step in self.steps], dtype=np.float64)
        return values.T

    def close(self) -> None:
        """Close all files. Idempotent."""
        for recorder in self._recorders:
            recorder.close()
        self.events.close()


def windows_of(record: Record, schedule: Schedule) -> list[dict[str, Any]]:
    """Metrics of every phase and reactor, as in summary.json."""
    from experiments.metrics import window_metrics

    elapsed, od = record.series("elapsed"), record.series("od")
    rows = []
    for phase, setpoint in enumerate(schedule.setpoints):
        start, end = float(schedule.edges[phase]), float(schedule.edges[phase + 1])
        m = window_metrics(elapsed, od, setpoint, start, end)
        for n, name in enumerate(record.names):
            rows.append(
                {
                    "reactor": name,
                    "phase": phase,
                    "setpoint": setpoint,
                    "temperature": schedule.temperatures[phase],
                    **{
                        key: float(getattr(m, key)[n])
                        for key in ("ise", "itae", "ise_mean", "itae_mean", "settling_min", "steady_abs_error")
                    },
                }
            )
    return rows


def _finish(record: Record, schedule: Schedule, folder: Path, outcome: str, title: str) -> None:
    """Figure and summary.json, whatever the outcome."""
    import numpy as np

    from experiments import charts

    volume = np.nansum(record.series("volume_ml"), axis=1)
    minute = record.series("minute")
    windows = windows_of(record, schedule)
    switched = len(set(schedule.temperatures)) > 1
    figure = charts.culture(
        minute.T,
        record.series("od").T,
        np.where(record.series("phase") >= 0, record.series("setpoint"), np.nan).T,
        record.series("rate").T,
        record.names,
        record.series("temperature").T if switched else None,
        title,
    )
    path = charts.save(figure, folder / "figures", "closed_loop")
    record.events.figure("figures/closed_loop", figure, len(record.steps))
    summary = {
        "outcome": outcome,
        "minutes": float(np.nanmax(minute)) if minute.size else 0.0,
        "windows": windows,
        "volume_ml": float(volume.sum()),
        "reactors": {name: {"volume_ml": float(v)} for name, v in zip(record.names, volume, strict=True)},
        "figure": str(path),
    }
    app.write_json(folder / "summary.json", summary)
    log.info("%s after %.0f min, %.1f mL of fresh medium", outcome, summary["minutes"], summary["volume_ml"])
    header = (
        f"{'reactor':8} {'setpoint':>8} {'ISE':>8} {'ITAE':>8} {'ISE/T':>8} {'ITAE/T':>8} {'settled':>8} {'steady':>8}"
    )
    log.info("windows (ISE, ITAE: T = 1 min; /T: T = window; settled: min until |e| stays within 5 %%)\n%s\n%s",
             header, "\n".join(_line(w) for w in windows))  # fmt: skip
    log.info("recordings %s; figure %s; tensorboard --logdir %s", folder / "recordings", path, folder)


def _line(w: dict[str, Any]) -> str:
    numbers = [w["ise"], w["itae"], w["ise_mean"], w["itae_mean"], w["settling_min"], w["steady_abs_error"]]
    formats = ("8.4f", "8.2f", "8.5f", "8.3f", "8.1f", "8.4f")
    return f"{w['reactor']:8} {w['setpoint']:8.2f} " + " ".join(
        f"{n:{f}}" if n == n else f"{'never':>8}" for n, f in zip(numbers, formats, strict=True)
    )


def deploy(config: DeployConfig, folder: Path) -> None:
    """One closed loop over the scenario."""
    import numpy as np
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    from envs.plant import Plant
    from experiments import build
    from experiments.loop import ClosedLoop, RateLimit
    from hardware.errors import ReactorError
    from hardware.simulated import SimulatedReactors

    backend: SimulatedConfig = config.backend
    plant = Plant(plant_of(config), len(backend.reactors), np.random.default_rng(backend.seed))
    kind = config.controller.kind
    policy = load_policy(config.policy, backend.control_min) if kind == "dqn" else None
    model = model_of(config)
    controller = build.controller(config.controller, model, policy, plant, backend.pump_ml_s)
    limit = model.max_pump_rate if policy is None else float(policy.pump_rates[-1])
    reactors = SimulatedReactors(plant, backend)
    loop = ClosedLoop(reactors, controller, RateLimit(limit), config.scenario)
    record = Record(folder, reactors.names, config.fsync)
    outcome = "failed"
    try:
        with logging_redirect_tqdm(), tqdm(disable=None, unit="min") as bar:
            phase = np.full(len(reactors.names), -2)
            for step in loop.run():
                record.add(step)
                bar.update()
                for n in np.flatnonzero(step.rows & (step.phase != phase)):
                    what = "recovery" if step.phase[n] < 0 else f"setpoint {step.setpoint[n]:g}"
                    log.info("%s: %s from minute %.0f, OD %.3f", reactors.names[n], what, step.minute[n], step.od[n])
                phase = np.where(step.rows, step.phase, phase)
        outcome = "completed"
    except KeyboardInterrupt:
        outcome = "stopped by the operator"
    except ReactorError as error:
        outcome = f"failed: {error}"
        raise app.UserError(str(error)) from None
    finally:
        reactors.stop()
        if record.steps:
            _finish(record, config.scenario, folder, outcome, f"{backend.kind}, controller {kind}")
        record.close()


def _schema(cfg: DictConfig) -> DeployConfig:
    return deploy_schema(str(cfg.backend.kind), str(cfg.controller.kind))


def main() -> None:
    """Entry point."""
    app.run("deploy", DeployConfig(), deploy, choose=_schema)


if __name__ == "__main__":
    main()
