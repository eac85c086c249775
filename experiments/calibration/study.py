"""Simulated recordings under any controller, and the coverage of the intervals of their calibrations."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.open_loop import Decide, OpenLoopLaw, recordings
from envs.identification.screening import Series
from envs.identification.verdict import Calibration
from envs.task import MAX_PUMP_RATE, EnvConfig
from experiments.calibration.config import CalibrateConfig
from experiments.cli import files
from experiments.laws.base import Controller
from experiments.laws.density.baselines import Threshold, ThresholdConfig
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig, TunedPI, TunedPIConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Fitted = Calibration | str


def simulated(config: CalibrateConfig, n: int) -> tuple[Array, Array, Array, Array]:
    """Simulate n recordings: time (T,), OD and pump rate (n, T), mean growth rate (n,)."""
    protocol, rng = config.protocol, np.random.default_rng(config.protocol.seed)
    if config.law == "open_loop":
        return recordings(protocol, OpenLoopLaw(protocol, n, rng).decide, rng, n)
    regulate = _regulation(config, n)  # with the pump at rest at the start of every hour
    return recordings(protocol, lambda t, od: regulate(t, od) * (t % 60.0 >= config.rest_min), rng, n)


def _regulation(config: CalibrateConfig, n: int) -> Decide:
    """Build the controller as (minute, readings) -> rates; each setpoint gets an equal part of the recording."""
    times = np.linspace(0.0, 60.0 * config.protocol.hours, len(config.setpoints) + 1)[1:-1]
    everyone = np.ones(n, dtype=np.bool_)
    if config.law == "proportional":
        middle = 0.5 * MAX_PUMP_RATE
        return lambda t, od: np.clip(middle + config.gain * (od - _setpoint(config, times, t)), 0.0, MAX_PUMP_RATE)
    laws: dict[str, Callable[[], Controller]] = {
        "pi": lambda: ChiBioPI(ChiBioPIConfig()),
        "pi_tuned": lambda: TunedPI(TunedPIConfig(), EnvConfig(control_min=config.protocol.control_min)),
        "threshold": lambda: Threshold(ThresholdConfig()),
    }
    controller = laws[config.law]()
    controller.reset(n)
    return lambda t, od: controller.act(od, np.full(n, _setpoint(config, times, t)), np.full(n, t), everyone)


def _setpoint(config: CalibrateConfig, times: Array, t: float) -> float:
    return config.setpoints[int(np.searchsorted(times, t, side="right"))]


def fitted(time: Array, od: Array, pump_rate: Array, config: IdentifyConfig, bar: bool = False) -> list[Fitted]:
    """Calibrate each of N recordings, time (T,) and values (N, T); list results, or the message of a refusal."""
    found: list[Fitted] = []
    for i in tqdm(range(len(od)), disable=None if bar else True):
        try:
            found.append(calibrate(Series(time, od[i], pump_rate[i], np.arange(len(time))), config))
        except ValueError as error:
            found.append(str(error))
    return found


def against_truth(found: list[Fitted], growth: Array, tau: Array) -> dict[str, Any]:
    """Compare N calibrations with the true values, (N,) each; return the number refused and the coverage in %.

    The true mu is the mean growth rate over the recording's rows, which differs between draws if growth fluctuates.
    wrong_pct: percentage of all N that were accepted although a true value is outside its doubled interval.
    """
    kept = [i for i, c in enumerate(found) if isinstance(c, Calibration)]
    refusals = sorted({c for c in found if isinstance(c, str)})
    numbers = {"recordings": len(found), "refused": len(found) - len(kept), "refusals": refusals[:5], "wrong_pct": 0.0}
    if kept:
        mu, tau_found = _intervals(found, "mu"), _intervals(found, "tau")
        study = {"mu": _judged(mu, growth[kept]), "tau": _judged(tau_found, tau[kept])}
        numbers |= {key: {name: part[key] for name, part in study.items()} for key in study["mu"]}
        wrong = ~(_holds(mu, growth[kept], 2.0) & _holds(tau_found, tau[kept], 2.0))
        numbers["wrong_pct"] = 100.0 * float(wrong.sum()) / len(found)
    return numbers


def coverage(config: CalibrateConfig, folder: Path) -> float:
    """Simulate recordings; return the % of 95 % intervals that contain the true value, the smaller of mu and tau."""
    protocol, n = config.protocol, config.coverage
    title = f"{n} simulated recordings of {protocol.hours:g} h under {config.law}, {100 * protocol.noise:g} % noise"
    print(title, flush=True)
    time, od, pump_rate, growth = simulated(config, n)
    found, tau = fitted(time, od, pump_rate, config.identify, bar=True), np.full(n, protocol.tau)
    numbers = against_truth(found, growth, tau)
    worst = 100.0
    if numbers["refused"] < n:
        kept = [i for i, c in enumerate(found) if isinstance(c, Calibration)]
        worst = min(numbers["coverage_pct"].values())
        from experiments.reporting.calibration_charts import coverage_figure
        from experiments.reporting.charts import save

        intervals, truth = (_intervals(found, "mu"), _intervals(found, "tau")), (growth[kept], tau[kept])
        save(coverage_figure(*intervals, truth, f"{title} (seed {protocol.seed})"), folder / "figures", "coverage")
        for name in ("mu", "tau"):
            print(
                f"{name}: 95 % intervals contain the true value in {numbers['coverage_pct'][name]:.1f} %, median bias "
                f"{numbers['median_bias_pct'][name]:+.2f} %, half width "
                f"{numbers['relative_half_width_pct'][name]:.1f} %"
            )
    files.write_json(folder / "summary.json", numbers)
    first = f"; first reason: {numbers['refusals'][0]}" if numbers["refusals"] else ""
    print(f"refused: {numbers['refused']} of {n}{first}")
    print(f"figure and summary in {folder}")
    return worst


def _intervals(found: list[Fitted], name: str) -> Array:
    """Return (value, low, high) of each accepted calibration, shape (n, 3)."""
    chosen = [getattr(c, name) for c in found if isinstance(c, Calibration)]
    return np.array([(p.value, p.low, p.high) for p in chosen])


def _holds(values: Array, truth: Array, times: float = 1.0) -> Mask:
    """Return whether intervals, widened by a factor, contain the true value."""
    value, low, high = values.T
    return np.asarray((value - times * (value - low) <= truth) & (truth <= value + times * (high - value)))


def _judged(values: Array, truth: Array) -> dict[str, float]:
    """Compare (value, low, high) of each draw, shape (n, 3), with its true value, shape (n,)."""
    return {
        "coverage_pct": 100.0 * float(np.mean(_holds(values, truth))),
        "median_bias_pct": 100.0 * float(np.median(values[:, 0] / truth) - 1.0),
        "relative_half_width_pct": 50.0 * float(np.median((values[:, 2] - values[:, 1]) / values[:, 0])),
    }
