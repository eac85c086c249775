"""Configurations of a sweep: jobs pooled over seeds, and statistics of their measures."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.reporting.curves import ERROR_UNITS
from experiments.reporting.tables import interquartile_mean, number

Array = NDArray[np.float64]
RESAMPLES = 2000
LABELS = {
    "regret_pct": "regret against the optimum, %",
    "steady_abs_error": "steady error at the worst setpoint, {unit}",
    "ise": "ISE over all windows, OD² min",
    "itae": "ITAE over all windows, OD min²",
    "volume_ml": "medium, mL",
    "objective": "return value of the command",
}
MERIT = "score (the larger of regret and steady error, each divided by its limit)"  # return value of train


@dataclass(frozen=True)
class Result:
    """Job of a sweep. overrides: key -> value. objective: return value of the command. task: kind of its task."""

    folder: Path
    overrides: Mapping[str, str]
    state: str
    error: str = ""
    objective: float | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    task: str = "density"


@dataclass(frozen=True)
class Configuration:
    """Jobs that differ only in the seed. values: varied setting -> its value. measured: measure -> values, (n,)."""

    values: dict[str, str]
    jobs: list[Result]
    measured: dict[str, Array]

    @property
    def name(self) -> str:
        """Name of the configuration in figures and tables."""
        varied = (f"{key.rpartition('.')[2]} {number_or_text(value)}" for key, value in self.values.items())
        return ", ".join(varied) or "all jobs"


def number_or_text(value: str) -> str:
    """Format a number to four digits; return any other text unchanged."""
    try:
        return number(float(value), 4)
    except ValueError:
        return value


@dataclass(frozen=True)
class Statistics:
    """Statistics of n values. iqm: interquartile mean. interval: its 95 % bootstrap interval, nan for one value."""

    n: int
    median: float
    iqm: float
    interval: tuple[float, float]
    worst: float


def statistics(values: Array) -> Statistics:
    """Compute statistics of n >= 1 values; interquartile mean with interval as in Agarwal 2021."""
    from scipy.stats import trim_mean

    low = high = math.nan
    if values.size > 1:
        drawn = np.random.default_rng(0).choice(values, (RESAMPLES, values.size))
        low, high = np.percentile(trim_mean(drawn, 0.25, axis=1), [2.5, 97.5])
    middle, interval = interquartile_mean(values), (float(low), float(high))
    return Statistics(values.size, float(np.median(values)), middle, interval, float(values.max()))


def label(measure: str, task: str, command: str) -> str:
    """Return the label of a measure, with its unit. Args: task: kind of the task. command: name of the command."""
    if (measure, command) == ("objective", "train"):
        return MERIT
    return LABELS.get(measure, measure).format(unit=ERROR_UNITS.get(task, ""))


def measures(summary: Mapping[str, Any]) -> dict[str, list[float]]:
    """Collect the measures of a run: name -> list of values. The names depend on the command.

    A training has one value per seed. A closed loop has one per reactor: ISE and ITAE are summed over its windows, the
    steady error is that of the worst window. Any other command has one value for each number in its summary.
    """
    if isinstance(summary.get("seeds"), list):
        return {name: _finite(summary.get(name)) for name in ("regret_pct", "steady_abs_error")}
    if isinstance(summary.get("windows"), list):
        return _of_windows(summary)
    plain = {name: _finite([value]) for name, value in summary.items() if type(value) in (int, float)}
    return {name: values for name, values in plain.items() if values}


def _finite(values: Any) -> list[float]:
    return [float(v) for v in values or [] if type(v) in (int, float) and math.isfinite(v)]


def _of_windows(summary: Mapping[str, Any]) -> dict[str, list[float]]:
    reactors: dict[str, list[Mapping[str, Any]]] = {}
    for window in summary["windows"]:
        reactors.setdefault(str(window.get("reactor")), []).append(window)
    found: dict[str, list[float]] = {}
    for name, pool in (("steady_abs_error", max), ("ise", sum), ("itae", sum)):
        each = (_finite([w.get(name) for w in windows]) for windows in reactors.values())
        found[name] = [float(pool(values)) for values in each if values]
    found["volume_ml"] = _finite([r.get("volume_ml") for r in summary.get("reactors", {}).values()])
    return {name: values for name, values in found.items() if values}


def configurations(jobs: Sequence[Result]) -> tuple[list[Configuration], dict[str, str]]:
    """Pool finished jobs over seeds, the best configuration first; return also the overrides that all jobs share.

    The largest value of the first measure decides the order; the first measure is the objective, if there is one.
    """
    keys = list(dict.fromkeys(key for job in jobs for key in job.overrides if key.rpartition(".")[2] != "seed"))
    done = [job for job in jobs if job.state == "finished"]
    varied = [key for key in keys if len({job.overrides.get(key) for job in done or jobs}) > 1]
    pooled: dict[tuple[str, ...], list[Result]] = {}
    for job in done:
        pooled.setdefault(tuple(job.overrides.get(key, "") for key in varied), []).append(job)
    found = []
    for values, members in pooled.items():
        measured: dict[str, list[float]] = {}
        for job in members:
            own = measures(job.summary)
            for name, each in ({"objective": _finite([job.objective])} | own).items():
                measured.setdefault(name, []).extend(each)
        arrays = {name: np.array(each) for name, each in measured.items() if each}
        found.append(Configuration(dict(zip(varied, values, strict=True)), members, arrays))
    first = (done or list(jobs))[0].overrides
    common = {key: first[key] for key in keys if key not in varied and key in first}
    return sorted(found, key=lambda one: next((float(v.max()) for v in one.measured.values()), math.inf)), common


def curve(jobs: Sequence[Result], tag: str) -> tuple[Array, Array]:
    """Read a tag from each job's progress.csv: steps (K,), and values (K, S), a column per seed, nan if missing."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    for job in jobs:
        try:
            with open(job.folder / "progress.csv", newline="", encoding="utf-8") as file:
                for row in csv.reader(file):
                    if len(row) == 4 and row[2] == tag:
                        found.setdefault((job.folder.name, row[1]), {})[int(row[0])] = float(row[3])
        except (OSError, ValueError):
            continue
    steps = sorted({step for each in found.values() for step in each})
    values = [[each.get(step, math.nan) for each in found.values()] for step in steps]
    return np.array(steps, dtype=float), np.array(values, dtype=float).reshape(len(steps), len(found))
