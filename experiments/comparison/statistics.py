"""Statistics of trials: means with intervals, and paired differences between controllers on the same vials."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom
from scipy.stats import t as student

from experiments.comparison.trials import DensityTrial, Trial, Window, windows

Array = NDArray[np.float64]
METRICS = ("ise", "itae")
TOLD = {
    "supervised_pct": "supervised", "alarm_pct": "alarm", "error_2sd_pct": "error", "share_2sd_pct": "growth_share",
}  # fmt: skip
NEGLIGIBLE = 1e-6  # smallest mean for a difference in percent


class Spread:
    """Mean, median and standard deviation over replicates; 95 % intervals of the mean (Student's t) and the median.

    Replicates with value nan are ignored. With a single replicate the standard deviation and the intervals are nan.
    """

    def __init__(self, values: Array) -> None:
        finite = np.asarray(values, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        self.n = int(finite.size)
        self.mean = float(finite.mean()) if self.n else float("nan")
        self.median = float(np.median(finite)) if self.n else float("nan")
        self.sd = float(finite.std(ddof=1)) if self.n > 1 else float("nan")
        # interval of the median from order statistics (sign test); valid for every distribution
        ordered, below = np.sort(finite), int(binom.ppf(0.025, self.n, 0.5)) if self.n else 0
        self.median_ci95 = [float(ordered[below - 1]), float(ordered[-below])] if below else [float("nan")] * 2
        half = float(student.ppf(0.975, self.n - 1)) * self.sd / self.n**0.5 if self.n > 1 else float("nan")
        self.ci95 = [self.mean - half, self.mean + half]

    @property
    def sign(self) -> int:
        """Sign of the mean if its 95 % interval excludes zero, else 0."""
        low, high = self.ci95
        return -1 if high < 0.0 else 1 if low > 0.0 else 0


def row(trial: DensityTrial, window: Window) -> dict[str, Any]:
    """Build a row of summary.json: mean metrics of the measured OD (T = 1 min), and the median settling time."""
    score = trial.score(window)
    of = {metric: Spread(getattr(score, metric)) for metric in METRICS}
    columns = [(m, part) for parts in (("mean", "sd"), ("median",), ("ci95",)) for m in METRICS for part in parts]
    settled = float(np.median(np.nan_to_num(score.settling_min, nan=np.inf)))  # "never" is infinity
    return (
        trial.names()
        | {"window": window.label, "setpoint": window.setpoint, "n": of["ise"].n}
        | {f"{metric}_{part}": getattr(of[metric], part) for metric, part in columns}
        | {
            "settling_min": settled if np.isfinite(settled) else float("nan"),
            "steady_abs_error": Spread(score.steady_abs_error).mean,
            "media_ml": Spread(trial.media(window)).mean,
        }
    )


def rows(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """List the rows of all trials; a density trial has one row per window."""
    return [found for trial in trials for found in ROWS[trial.cell.signal](trial)]


ROWS: dict[str, Callable[[Any], list[dict[str, Any]]]] = {
    "density": lambda trial: [row(trial, window) for window in windows(trial.schedule)],
}
"""Signal -> function that builds the rows of a trial; a guest adds its own signal."""


def details(trials: Sequence[DensityTrial]) -> list[dict[str, Any]]:
    """List further values per row: scores with T = window, of the noise-free OD and of the noise; control effort."""
    return [_detail(trial, window) for trial in trials for window in windows(trial.schedule)]


def _detail(trial: DensityTrial, window: Window) -> dict[str, Any]:
    measured, clean, floor = (trial.score(window, of) for of in ("measured", "clean", "floor"))
    means = {
        "ise_per_window": measured.ise_mean,
        "itae_per_window": measured.itae_mean,
        "clean_ise": clean.ise,
        "clean_itae": clean.itae,
        "clean_abs_error": clean.abs_error,
        "floor_ise": floor.ise,
        "floor_itae": floor.itae,
        "effort_ul_s": trial.effort(window),
    }
    return (
        trial.names()
        | {"window": window.label, "window_min": window.end - window.start}
        | {key: Spread(values).mean for key, values in means.items()}
        | {"settled": int(np.isfinite(measured.settling_min).sum()), "overflowed": int(trial.overflowed.sum())}
    )


def _total(trial: DensityTrial, metric: str, of: str = "measured") -> Array:
    each = [getattr(trial.score(window, of), metric) for window in windows(trial.schedule)]
    return np.asarray(np.sum(each, axis=0))


def totals(trials: Sequence[DensityTrial]) -> list[dict[str, Any]]:
    """Build one entry per trial: ISE and ITAE summed over its windows, medium used, control effort and so on."""
    found = []
    for trial in trials:
        entry = trial.names() | {"n": int(trial.od.shape[0])}
        for metric in METRICS:
            value = Spread(_total(trial, metric))
            entry |= {f"{metric}_mean": value.mean, f"{metric}_sd": value.sd, f"{metric}_ci95": value.ci95}
            entry[f"{metric}_median"] = value.median
            entry |= {f"{of}_{metric}": Spread(_total(trial, metric, of)).mean for of in ("clean", "floor")}
        parts = windows(trial.schedule)
        length = np.array([w.end - w.start for w in parts])
        steady = np.mean([trial.score(w, "clean").steady_abs_error for w in parts], axis=0)
        entry["clean_steady_abs_error"] = Spread(steady).mean
        entry["effort_ul_s"] = Spread(np.average([trial.effort(w) for w in parts], axis=0, weights=length)).mean
        entry["held"] = Spread(trial.held).mean
        entry |= {key: 100.0 * Spread(trial.told[of]).mean for key, of in TOLD.items() if of in trial.told}
        entry["media_ml"] = Spread(np.sum([trial.media(w) for w in parts], axis=0)).mean
        found.append(entry)
    return found


def _pair(one: Trial, other: Trial, metric: str, window: str, mine: Array, theirs: Array) -> dict[str, Any]:
    found, mean = Spread(mine - theirs), Spread(theirs).mean
    return one.names() | {
        "against": other.cell.controller,
        "window": window,
        "metric": metric,
        "n": found.n,
        "difference": found.mean,
        "ci95": found.ci95,
        "median": found.median,
        "median_ci95": found.median_ci95,
        "percent": 100.0 * found.mean / mean if mean > NEGLIGIBLE else float("nan"),
        "lower_in": int((mine < theirs).sum()),
        "verdict": ("lower", "no difference shown", "higher")[found.sign + 1],
    }


Scored = list[tuple[str, str, Array]]
"""List of (window, metric, the metric's value in each replicate, (N,))."""


def _density_scores(trial: DensityTrial) -> Scored:
    scores = [(window.label, trial.score(window)) for window in windows(trial.schedule)]
    return [(label, metric, getattr(score, metric)) for label, score in scores for metric in METRICS]


SCORES: dict[str, Callable[[Any], Scored]] = {
    "density": _density_scores,
}
"""Signal -> function that returns the scores by which controllers are compared; a guest adds its own signal."""


def pairs(trials: Sequence[Trial], against: str, scores: Callable[[Any], Scored] | None = None) -> list[dict[str, Any]]:
    """Compare every controller with the controller `against` on the same vials, window by window.

    Args: scores: function that returns other scores to compare. Returns: per comparison, the mean difference over
    replicates with its 95 % interval, and the number of replicates in which the controller scores lower.
    """
    found = []
    of = {t.cell.vials: t for t in trials if t.cell.controller == against}
    met = [(t, of[t.cell.vials]) for t in trials if t.cell.controller != against and t.cell.vials in of]
    for one, other in met:
        of_one, of_other = map(scores or SCORES[one.cell.signal], (one, other))
        for (window, metric, mine), (_, _, theirs) in zip(of_one, of_other, strict=True):
            found.append(_pair(one, other, metric, window, mine, theirs))
    return found


def total_scores(trial: DensityTrial) -> Scored:
    return [("all", metric, _total(trial, metric)) for metric in METRICS]
