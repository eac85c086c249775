"""Simulated recordings under any law, and how often the intervals of their calibrations hold the truth."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from envs.identification.calibration import calibrate
from envs.identification.open_loop import Decide, OpenLoopLaw, recordings
from envs.identification.screening import Series
from envs.task import MAX_PUMP_RATE
from experiments.calibration.config import CalibrateConfig
from experiments.cli import files
from experiments.laws.density.baselines import Threshold, ThresholdConfig
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig

__all__ = ["coverage", "simulated"]

Array = NDArray[np.float64]


def simulated(config: CalibrateConfig, n: int) -> tuple[Array, Array, Array, Array]:
    """n recordings under the configured law: time (T,), OD and pump rate (n, T), mean growth rate (n,)."""
    protocol, rng = config.protocol, np.random.default_rng(config.protocol.seed)
    if config.law == "open_loop":
        return recordings(protocol, OpenLoopLaw(protocol, n, rng).decide, rng, n)
    regulate = _regulation(config, n)  # with the pump at rest at the start of every hour
    return recordings(protocol, lambda t, od: regulate(t, od) * (t % 60.0 >= config.rest_min), rng, n)


def _regulation(config: CalibrateConfig, n: int) -> Decide:
    """The law as (minute, readings) -> rates; setpoints share the recording's time."""
    times = np.linspace(0.0, 60.0 * config.protocol.hours, len(config.setpoints) + 1)[1:-1]
    everyone = np.ones(n, dtype=np.bool_)
    if config.law == "proportional":
        middle = 0.5 * MAX_PUMP_RATE
        return lambda t, od: np.clip(middle + config.gain * (od - _setpoint(config, times, t)), 0.0, MAX_PUMP_RATE)
    controller = ChiBioPI(ChiBioPIConfig()) if config.law == "pi" else Threshold(ThresholdConfig())
    controller.reset(n)
    return lambda t, od: controller.act(od, np.full(n, _setpoint(config, times, t)), np.full(n, t), everyone)


def _setpoint(config: CalibrateConfig, times: Array, t: float) -> float:
    return config.setpoints[int(np.searchsorted(times, t, side="right"))]


def coverage(config: CalibrateConfig, folder: Path) -> float:
    """Share of simulated recordings whose 95 % intervals hold the truth; returns the smaller of the two, in %.

    mu is compared with the mean growth rate over the recording's rows, which differs from draw to draw where growth
    wanders.
    """
    protocol, n = config.protocol, config.coverage
    title = f"{n} simulated recordings of {protocol.hours:g} h under {config.law}, {100 * protocol.noise:g} % noise"
    print(title, flush=True)
    time, od, pump_rate, growth = simulated(config, n)
    rows = np.arange(len(time))
    found, refused, kept = [], [], []
    for i in tqdm(range(n), disable=None):
        try:
            found.append(calibrate(Series(time, od[i], pump_rate[i], rows), config.identify))
            kept.append(i)
        except ValueError as error:
            refused.append(str(error))
    numbers: dict[str, Any] = {"recordings": n, "refused": len(refused), "refusals": sorted(set(refused))[:5]}
    worst = 100.0
    if found:
        mu, tau = (
            np.array([(p.value, p.low, p.high) for p in column])
            for column in ([c.mu for c in found], [c.tau for c in found])
        )
        truth = (growth[kept], np.full(len(kept), protocol.tau))
        study = {"mu": _judged(mu, truth[0]), "tau": _judged(tau, truth[1])}
        numbers |= {key: {name: part[key] for name, part in study.items()} for key in study["mu"]}
        worst = min(part["coverage_pct"] for part in study.values())
        from experiments.reporting.calibration_charts import coverage_figure
        from experiments.reporting.charts import save

        save(coverage_figure(mu, tau, truth, f"{title} (seed {protocol.seed})"), folder / "figures", "coverage")
        for name, part in study.items():
            print(
                f"{name}: 95 % intervals hold the truth in {part['coverage_pct']:.1f} %, median bias "
                f"{part['median_bias_pct']:+.2f} %, half width {part['relative_half_width_pct']:.1f} %"
            )
    files.write_json(folder / "summary.json", numbers)
    print(f"refused: {len(refused)} of {n}" + (f"; the first: {refused[0]}" if refused else ""))
    print(f"figure and summary in {folder}")
    return worst


def _judged(values: Array, truth: Array) -> dict[str, float]:
    """(value, low, high) of each draw, shape (N, 3), against its truth, shape (N,)."""
    return {
        "coverage_pct": 100.0 * float(np.mean((values[:, 1] <= truth) & (truth <= values[:, 2]))),
        "median_bias_pct": 100.0 * float(np.median(values[:, 0] / truth) - 1.0),
        "relative_half_width_pct": 50.0 * float(np.median((values[:, 2] - values[:, 1]) / values[:, 0])),
    }
