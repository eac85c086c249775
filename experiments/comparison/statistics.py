"""From trials to numbers: means with intervals, and paired differences between controllers that met the same draws."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom
from scipy.stats import t as student

from experiments.comparison.trials import Trial, Window, windows

__all__ = ["Spread", "details", "pairs", "row", "rows", "total_pairs", "totals"]

Array = NDArray[np.float64]
METRICS = ("ise", "itae")
NEGLIGIBLE = 1e-6  # a difference is not stated in percent of a mean below this


class Spread:
    """Mean, median and standard deviation over replicates, 95 % intervals of mean (Student's) and median; nan left out.

    With one replicate there is no deviation and no interval (nan).
    """

    def __init__(self, values: Array) -> None:
        finite = np.asarray(values, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        self.n = int(finite.size)
        self.mean = float(finite.mean()) if self.n else float("nan")
        self.median = float(np.median(finite)) if self.n else float("nan")
        self.sd = float(finite.std(ddof=1)) if self.n > 1 else float("nan")
        self.median_ci95 = _around_median(np.sort(finite))
        half = float(student.ppf(0.975, self.n - 1)) * self.sd / self.n**0.5 if self.n > 1 else float("nan")
        self.ci95 = [self.mean - half, self.mean + half]

    @property
    def sign(self) -> int:
        """-1 or 1 where the interval excludes zero, else 0. Without any spread the sign of the mean counts."""
        low, high = self.ci95
        return -1 if high < 0.0 else 1 if low > 0.0 else 0


def _around_median(ordered: Array) -> list[float]:
    """95 % interval of the median whatever the distribution: order statistics, by the binomial of a sign test."""
    n = ordered.size
    below = int(binom.ppf(0.025, n, 0.5)) if n else 0
    return [float(ordered[below - 1]), float(ordered[n - below])] if below else [float("nan")] * 2


def _median_or_never(settling: Array) -> float:
    """Median over replicates with "never" as infinity; nan where half or more never settle."""
    middle = float(np.median(np.where(np.isfinite(settling), settling, np.inf))) if settling.size else float("nan")
    return middle if np.isfinite(middle) else float("nan")


def _names(trial: Trial) -> dict[str, Any]:
    return {"controller": trial.controller, "plant": trial.plant, "scenario": trial.scenario}


def row(trial: Trial, window: Window) -> dict[str, Any]:
    """One row of summary.json: measured OD, T = 1 min; settling is the median, the other values are means."""
    score = trial.score(window)
    ise, itae = Spread(score.ise), Spread(score.itae)
    return _names(trial) | {
        "window": window.label,
        "setpoint": window.setpoint,
        "n": ise.n,
        "ise_mean": ise.mean,
        "ise_sd": ise.sd,
        "itae_mean": itae.mean,
        "itae_sd": itae.sd,
        "ise_median": ise.median,
        "itae_median": itae.median,
        "ise_ci95": ise.ci95,
        "itae_ci95": itae.ci95,
        "settling_min": _median_or_never(score.settling_min),
        "steady_abs_error": Spread(score.steady_abs_error).mean,
        "media_ml": Spread(trial.media(window)).mean,
    }


def rows(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """`row` of every trial and window."""
    return [row(trial, window) for trial in trials for window in windows(trial.schedule)]


def details(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """What `rows` leaves out, one entry per row: the other convention, the noise-free OD, the floor, the effort."""
    found = []
    for trial in trials:
        for window in windows(trial.schedule):
            measured, clean, floor = trial.score(window), trial.score_clean(window), trial.score_floor(window)
            found.append(
                _names(trial)
                | {
                    "window": window.label,
                    "window_min": window.end - window.start,
                    "ise_per_window": Spread(measured.ise_mean).mean,
                    "itae_per_window": Spread(measured.itae_mean).mean,
                    "clean_ise": Spread(clean.ise).mean,
                    "clean_itae": Spread(clean.itae).mean,
                    "clean_abs_error": Spread(clean.abs_error).mean,
                    "floor_ise": Spread(floor.ise).mean,
                    "floor_itae": Spread(floor.itae).mean,
                    "effort_ul_s": Spread(trial.effort(window)).mean,
                    "settled": int(np.isfinite(measured.settling_min).sum()),
                    "overflowed": int(trial.overflowed.sum()),
                }
            )
    return found


def _total(trial: Trial, metric: str, kind: str = "score") -> Array:
    """Sum of a metric over the windows of a trial, (N,)."""
    each = [getattr(getattr(trial, kind)(window), metric) for window in windows(trial.schedule)]
    return np.asarray(np.sum(each, axis=0))


def totals(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """One entry per trial: ISE and ITAE summed over its windows, and what it cost in medium and pump moves."""
    found = []
    for trial in trials:
        entry = _names(trial) | {"n": int(trial.od.shape[0])}
        for metric in METRICS:
            value = Spread(_total(trial, metric))
            entry |= {f"{metric}_mean": value.mean, f"{metric}_sd": value.sd, f"{metric}_ci95": value.ci95}
            entry[f"{metric}_median"] = value.median
            entry[f"clean_{metric}"] = Spread(_total(trial, metric, "score_clean")).mean
            entry[f"floor_{metric}"] = Spread(_total(trial, metric, "score_floor")).mean
        parts = windows(trial.schedule)
        length = np.array([w.end - w.start for w in parts])
        steady = np.mean([trial.score_clean(w).steady_abs_error for w in parts], axis=0)
        entry["clean_steady_abs_error"] = Spread(steady).mean
        entry["effort_ul_s"] = Spread(np.average([trial.effort(w) for w in parts], axis=0, weights=length)).mean
        entry["held"] = Spread(trial.held).mean
        entry["media_ml"] = Spread(np.sum([trial.media(w) for w in parts], axis=0)).mean
        found.append(entry)
    return found


def _pair(one: Trial, other: Trial, metric: str, window: str, mine: Array, theirs: Array) -> dict[str, Any]:
    found, mean = Spread(mine - theirs), Spread(theirs).mean
    return {
        "controller": one.controller,
        "against": other.controller,
        "plant": one.plant,
        "scenario": one.scenario,
        "window": window,
        "metric": metric,
        "n": found.n,
        "difference": found.mean,
        "ci95": found.ci95,
        "median": found.median,
        "median_ci95": found.median_ci95,
        "percent": 100.0 * found.mean / mean if mean > NEGLIGIBLE else float("nan"),
        "verdict": ("lower", "no difference shown", "higher")[found.sign + 1],
    }


def _partners(trials: Sequence[Trial], against: str) -> list[tuple[Trial, Trial]]:
    of = {(t.plant, t.scenario): t for t in trials if t.controller == against}
    return [(t, of[t.plant, t.scenario]) for t in trials if t.controller != against and (t.plant, t.scenario) in of]


def pairs(trials: Sequence[Trial], against: str) -> list[dict[str, Any]]:
    """Every controller minus `against`, window by window: mean difference over replicates and its 95 % interval."""
    found = []
    for one, other in _partners(trials, against):
        for window in windows(one.schedule):
            mine, theirs = one.score(window), other.score(window)
            scores = ((metric, getattr(mine, metric), getattr(theirs, metric)) for metric in METRICS)
            found += [_pair(one, other, metric, window.label, a, b) for metric, a, b in scores]
    return found


def total_pairs(trials: Sequence[Trial], against: str) -> list[dict[str, Any]]:
    """As `pairs`, of the sums over windows."""
    return [
        _pair(one, other, metric, "all", _total(one, metric), _total(other, metric))
        for one, other in _partners(trials, against)
        for metric in METRICS
    ]
