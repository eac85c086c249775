"""What a run came to: the metrics of every window, the totals of every reactor, and the figure of it all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from envs.scenario import Scenario
from experiments.control.metrics import window_metrics
from experiments.control.record import Record
from experiments.reporting import charts

__all__ = ["figure_of", "summarise"]

METRICS = ("ise", "itae", "ise_mean", "itae_mean", "settling_min", "steady_abs_error")


def summarise(record: Record, scenarios: Sequence[Scenario], roles: Sequence[str], outcome: str) -> dict[str, Any]:
    """Every number of a run. Args: scenarios, roles: one per reactor. outcome: how it ended."""
    volume, minute = np.nansum(record.series("volume_ml"), axis=1), record.series("time_min")
    reactors = {
        name: {"role": role, "volume_ml": float(ml), "rows": len(rows), "interlock": rows.alarms}
        for name, role, ml, rows in zip(record.names, roles, volume, record.rows, strict=True)
    }
    return {
        "outcome": outcome,
        "minutes": float(np.nanmax(minute)) if np.isfinite(minute).any() else 0.0,
        "windows": _windows(record, scenarios),
        "volume_ml": float(volume.sum()),
        "reactors": reactors,
        "repairs": record.repairs,
    }


def _windows(record: Record, scenarios: Sequence[Scenario]) -> list[dict[str, Any]]:
    """Metrics of every phase of every reactor."""
    elapsed, od = record.series("elapsed_min"), record.series("od")
    rows = []
    for n, (name, scenario) in enumerate(zip(record.names, scenarios, strict=True)):
        for phase, setpoint in enumerate(scenario.setpoints):
            start, end = float(scenario.edges[phase]), float(scenario.edges[phase + 1])
            m = window_metrics(elapsed[n : n + 1], od[n : n + 1], setpoint, start, end)
            window = {"reactor": name, "phase": phase, "setpoint": setpoint, "start_min": start, "end_min": end}
            window["temperature"] = scenario.temperatures[phase]
            rows.append({**window, **{key: float(getattr(m, key)[0]) for key in METRICS}})
    return rows


def figure_of(record: Record, scenarios: Sequence[Scenario], title: str) -> Figure:
    """OD over setpoint, pump rate and, where a scenario changes it, temperature of all reactors."""
    setpoint = np.where(record.series("phase") >= 0, record.series("setpoint"), np.nan)
    switched = any(len(set(s.temperatures)) > 1 for s in scenarios)
    temperature = record.series("temperature_degc").T if switched else None
    series = (record.series("time_min").T, record.series("od").T, setpoint.T, record.series("pump_rate_ml_s").T)
    return charts.closed_loop(*series, record.names, temperature, title)
