"""Replay a recording as if it were a run, without a device: `python -m experiments.replay data=FILE`."""

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import part, setting
from envs.bench import Bench
from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.screening import Series, merged
from envs.identification.twin import twin
from envs.plant.plant import Plant
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.calibration.result import plant_of
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file
from experiments.control.policies import bounds_of, find_policy, load_policy
from experiments.laws import registry
from experiments.laws.base import Array, Controller
from experiments.laws.density.learned import LearnedConfig
from experiments.loop.loop import ClosedLoop
from experiments.recordings.reader import Source
from experiments.replays.replay import AHEAD, Replayed, replay
from hardware.errors import RecordingError
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock, kinds_of
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.watched import WatchedInterlock

log = logging.getLogger(__name__)

SLOWEST_MIN = 0.5  # period of readings; faster ones are merged to one a minute
DAY_MIN, RISE_MIN = 1440.0, 120.0  # longest closed loop on the twin; its error counts after the rise


@dataclass(frozen=True)
class ReplayConfig(Source):
    """Config of a replay: the recording, and the controller, estimator and interlock that process its readings."""

    controller: Any = part(LearnedConfig, "controller of the pump rate", registry.config_at)
    policy: str = setting("shipped", "for controller=dqn: `shipped`, a policy.npz, a run folder, or `latest`")
    setpoint: float | None = setting(
        None,
        "setpoint of the controller; null: the median OD at which the device dosed, at most 1.5",
        "OD",
        within=(0.02, 1.5),
    )
    env_file: str | None = setting(None, "growth model of the controller: a calibrated.yaml, or `latest`")
    bench: Bench = part(Bench, "volume of the vial and largest feed rate; the period is that of the readings")
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    identify: IdentifyConfig = part(IdentifyConfig, "fit of the recording's twin, a simulated vial for a closed loop")


def body(config: ReplayConfig, folder: Path) -> None:
    """Replay a recording; writes summary.json, figures and report.html. Raises: frame.UserError."""
    from experiments.replays import figure
    from experiments.reporting import charts, page

    source = config.data or str(resources.files("experiments") / "data" / "open_loop.csv")
    with frame.refusing(RecordingError):
        recording = config.read(source)
    raw = Series(recording.time_min - recording.time_min[0], recording.od, recording.pump_rate, recording.row)
    series = merged(raw, longest=0) if float(np.median(np.diff(raw.time))) < SLOWEST_MIN else raw
    temperature = np.interp(series.time, raw.time, recording.temperature)
    with frame.refusing(ValueError):
        bench = replace(config.bench, period_s=round(60.0 * float(np.median(np.diff(series.time))), 3))
    model = EnvConfig(tau=bench.tau) if config.env_file is None else read_env_file(config.env_file)
    model = replace(model, control_min=bench.control_min, max_pump_rate=min(model.max_pump_rate, bench.max_rate))
    setpoint, make = config.setpoint or _usual(series), _law(config, model)
    log.info("%s: %d readings, %.1f h, setpoint %.3g", source, len(series.od), series.time[-1] / 60.0, setpoint)
    interlock = WatchedInterlock(1, config.safety, bench)
    found = replay(series, temperature, make(), interlock, setpoint, model)
    name = Path(source).name
    charts.save(figure.replay_figure(found, f"{name}: estimates and doses of a run"), folder / "figures", "replay")
    try:
        minutes, od, rate = _on_twin(config, merged(raw), bench, make(), setpoint, model)
        error = float(np.abs(od - setpoint)[minutes >= min(RISE_MIN, 0.5 * minutes[-1])].mean())
        closed: dict[str, Any] = {"mean_abs_error": error, "hours": float(minutes[-1] / 60.0)}
        title = f"the same controller in closed loop on the recording's twin: mean error {error:.4f} OD"
        charts.save(figure.twin_figure(minutes, od, rate, setpoint, title), folder / "figures", "twin")
    except ValueError as unknown:  # the recording does not determine tau
        closed = {"none": str(unknown)}
    files.write_json(folder / "summary.json", _summary(found, recording.notes, closed) | {"data": source})
    shown = page.of_runs(folder, [folder])
    for line in (heading := shown.sections[0][1][0][1]["found"][0]).items:
        log.info("%s", line)
    log.info("%s %s", heading.claim, heading.remark)
    log.info("page %s", page.save(shown, folder))


def _on_twin(
    config: ReplayConfig, raw: Series, bench: Bench, law: Controller, setpoint: float, model: EnvConfig
) -> tuple[Array, Array, Array]:
    """Simulate the closed loop on the recording's twin; return minutes, true OD and pump rate, (K,) each.

    Raises: ValueError if the recording does not determine tau, or if no plant fits the recording.
    """
    plant = plant_of(twin(raw, calibrate(raw, config.identify), config.identify.segment_min))
    vials = SimulatedReactors(Plant(plant, 1, np.random.default_rng(0)), SimulatedConfig(), bench.control_min)
    schedule = Scenario((setpoint,), (float(min(raw.time[-1], DAY_MIN)),), (37.0,))
    loop = ClosedLoop(vials, law, Interlock(1, config.safety, bench), schedule, model=model)
    steps = [(step.minute[0], vials.plant.culture.od[0], step.rate[0]) for step in loop.run()]
    minutes, od, rate = np.array(steps).T
    return minutes, od, rate


def _usual(series: Series) -> float:
    """Return the median OD at which the device dosed, else of all readings, clipped to the allowed setpoints."""
    dosed = series.od[(series.pump_rate > 0.0) & np.isfinite(series.od)]
    return float(np.clip(np.median(dosed) if len(dosed) else np.nanmedian(series.od), 0.02, 1.5))


def _law(config: ReplayConfig, model: EnvConfig) -> Callable[[], Controller]:
    policy = bounds = None
    with frame.refusing(ValueError):
        registry.on_device(config.controller.kind)
        if config.controller.kind == "dqn":
            policy = load_policy(config.policy, model.control_min, config.bench.max_rate)
            bounds = bounds_of(policy, config.controller.estimator, find_policy(config.policy), model)
    volume_ml = config.bench.volume_ml
    return lambda: registry.build(config.controller, model=model, policy=policy, bounds=bounds, volume_ml=volume_ml)


def _summary(found: Replayed, notes: tuple[str, ...], closed: dict[str, Any]) -> dict[str, Any]:
    """Build summary.json. The ranges of mu and gain reach from the 5 % to the 95 % quantile of the readings."""
    told = Counter(kind for reason in found.reasons for kind in kinds_of(reason))
    spread = {
        name: [float(v) for v in np.nanquantile(values, [0.05, 0.95])] if np.isfinite(values).any() else None
        for name, values in (("mu", found.mu), ("gain", found.gain))
    }
    inside = {"one": found.one, "ten": found.ten}
    return {
        "inside_pct": {key: _pct(v[np.isfinite(v)]) for key, v in inside.items()},
        "ahead": AHEAD,
        "readings": len(found.od),
        "hours": float(found.minutes[-1] / 60.0),
        "not_believed_pct": _pct(~found.believed),
        **spread,
        "setpoint": found.setpoint,
        "doses_pct": found.doses,
        "filter_alarm_pct": _pct(found.acted > 0.0),
        "interlock": dict(told),
        "twin": closed,
        "notes": list(notes),
    }


def _pct(rows: Any) -> float | None:
    return 100.0 * float(np.mean(rows)) if len(rows) else None


main = frame.EntryPoint("replay", ReplayConfig(), body)


if __name__ == "__main__":
    main()
