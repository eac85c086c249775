"""From trials of the composition to numbers, judged by what the share truly was."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.comparison.composition_trials import CompositionTrial
from experiments.comparison.statistics import Spread

__all__ = ["BASELINE", "abs_error", "last_hours", "pairs", "row", "summarise"]

Array = NDArray[np.float64]

BASELINE = "pi"  # the vendor's law, which the others are compared with
LAST_MIN = 120  # of a window
DAY_MIN = 1440


def abs_error(trial: CompositionTrial) -> Array:
    """Mean |r - setpoint| wherever a share is asked for, (N,)."""
    return np.asarray(np.nanmean(np.abs(trial.share - trial.setpoint), axis=1))


def last_hours(trial: CompositionTrial) -> Array:
    """Mean |r - setpoint| of the last 2 h of every window, (N,); nan where the share asked for changes all the time.

    A law that is told of a change leaves before it comes: then this says nothing of how well it holds.
    """
    held = np.zeros(trial.minute.size, dtype=np.bool_)
    for start, end in zip(trial.edges[:-1].astype(int), trial.edges[1:].astype(int), strict=True):
        if np.unique(trial.setpoint[start:end]).size == 1 and np.isfinite(trial.setpoint[start]):
            held[max(start, end - LAST_MIN) : end] = True
    error = np.abs(trial.share - trial.setpoint)[:, held]
    return np.asarray(error.mean(axis=1)) if held.any() else np.full(len(error), np.nan)


def _last_day(trial: CompositionTrial) -> Array:
    """Mean |r - setpoint| of the last day of a run of two days or more, else nan, (N,)."""
    if trial.minute[-1] < 2 * DAY_MIN:
        return np.full(len(trial.share), np.nan)
    return np.asarray(np.nanmean(np.abs(trial.share - trial.setpoint)[:, -DAY_MIN:], axis=1))


def _names(trial: CompositionTrial) -> dict[str, Any]:
    cell = trial.cell
    return {
        "controller": cell.law,
        "preview": trial.foresight,
        "plant": cell.plant,
        "scenario": cell.scenario,
        "density": cell.density,
        "calibrated": cell.calibrated,
    }


def row(trial: CompositionTrial) -> dict[str, Any]:
    """One entry of summary.json."""
    error = Spread(abs_error(trial))
    inside = (trial.low <= trial.share) & (trial.share <= trial.high)
    return _names(trial) | {
        "n": error.n,
        "ratio_abs_error_mean": error.mean,
        "ratio_abs_error_sd": error.sd,
        "ci95": error.ci95,
        "ratio_abs_error_last2h": Spread(last_hours(trial)).mean,
        "ratio_abs_error_last_day": Spread(_last_day(trial)).mean,
        "estimate_rms": float(np.sqrt(np.square(trial.estimate - trial.share).mean())),
        "band_covers": float(inside.mean()),
        "od_min": float(trial.od.min()),
        "od_max": float(trial.od.max()),
        "od_mean": float(trial.od.mean()),
    }


def pairs(trials: Sequence[CompositionTrial], against: str = BASELINE) -> list[dict[str, Any]]:
    """Every law minus `against` on the same reactors: mean difference, its 95 % interval, in how many it is lower."""
    of = {
        (t.cell.density, t.cell.plant, t.cell.scenario, t.cell.calibrated): t for t in trials if t.cell.law == against
    }
    found = []
    for trial in trials:
        other = of.get((trial.cell.density, trial.cell.plant, trial.cell.scenario, trial.cell.calibrated))
        if other is None or trial.cell.law == against:
            continue
        less = abs_error(trial) - abs_error(other)
        spread = Spread(less)
        found.append(
            _names(trial)
            | {"against": against, "n": spread.n, "difference": spread.mean, "ci95": spread.ci95}
            | {"lower_in": int((less < 0.0).sum())}
        )
    return found


def summarise(trials: Sequence[CompositionTrial], replicates: int, seed: int) -> dict[str, Any]:
    """All numbers of the trials."""
    return {"rows": [row(t) for t in trials], "paired": pairs(trials), "replicates": replicates, "seed": seed}
