"""Statistics of trials: means with intervals, and paired differences between controllers on the same vials.

The statistics are rows of summary.json. Each `RowColumn` is declared once, here or by a guest.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Self, TypedDict, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom
from scipy.stats import t as student

from experiments.comparison.trials import DensityTrial, Trial, Window, windows

Array = NDArray[np.float64]
NEGLIGIBLE = 1e-6  # smallest mean for a difference in percent
T = TypeVar("T", covariant=True)


@dataclass(frozen=True)
class RowColumn(Generic[T]):
    """Column of rows. key: in summary.json. title: of its table on the page. ranked: that table marks the lowest."""

    key: str
    title: str = ""
    ranked: bool = False


@dataclass(frozen=True)
class Row:
    """Row of summary.json. values: its entry, key of a column -> value; an unknown number is nan, in the file null."""

    signal: str
    controller: str
    plant: str
    scenario: str
    values: Mapping[str, Any]

    @classmethod
    def of(cls, names: Mapping[str, Any], columns: Mapping[RowColumn[Any], Any] | None = None) -> Self:
        """Return the row of an entry, or of names and further columns; a column whose value is None is left out."""
        more = {column.key: value for column, value in (columns or {}).items() if value is not None}
        known = {key: _known(value) for key, value in (*names.items(), *more.items())}
        return cls(known["signal"], known["controller"], known["plant"], known["scenario"], known)

    def __getitem__(self, column: RowColumn[T]) -> T:
        value: T = self.values[column.key]
        return value

    @property
    def law(self) -> str:
        """Displayed name of the controller."""
        return f"{self.controller}, with preview" if self.values.get("preview") else self.controller


def _known(value: Any) -> Any:
    return [*map(_known, value)] if isinstance(value, list) else float("nan") if value is None else value


class ScoreColumns:
    """Columns of a score, summed over windows: of the measured OD, of the noise-free OD, and of the sensor's noise."""

    def __init__(self, key: str, unit: str) -> None:
        names = (f"{key}_mean", f"{key}_sd", f"floor_{key}", f"{key}_per_window")
        self.mean, self.sd, self.floor, self.per_window = map(RowColumn[float], names)
        self.ci95, self.key, self.name, self.unit = RowColumn[list[float]](f"{key}_ci95"), key, key.upper(), unit
        title = f"{self.name} of the %s OD ({unit}), sum over the windows"
        self.median = RowColumn[float](f"{key}_median", f"{title % 'measured'}, median over vials", ranked=True)
        self.clean = RowColumn[float](f"clean_{key}", title % "noise-free", ranked=True)


WINDOW, AGAINST, METRIC, VERDICT = map(RowColumn[str], ("window", "against", "metric", "verdict"))
N, SETTLED, OVERFLOWED, LOWER_IN = map(RowColumn[int], ("n", "settled", "overflowed", "lower_in"))
ISE, ITAE = METRICS = ScoreColumns("ise", "OD² min"), ScoreColumns("itae", "OD min²")
WINDOW_MIN, SETPOINT, SETTLING = map(RowColumn[float], ("window_min", "setpoint", "settling_min"))
STEADY, CLEAN_ABS_ERROR = map(RowColumn[float], ("steady_abs_error", "clean_abs_error"))
DIFFERENCE, PERCENT, MEDIAN = map(RowColumn[float], ("difference", "percent", "median"))
CI95, MEDIAN_CI95 = map(RowColumn[list[float]], ("ci95", "median_ci95"))
CLEAN_STEADY = RowColumn[float]("clean_steady_abs_error", "Steady error of the noise-free OD", ranked=True)
EFFORT = RowColumn[float]("effort_ul_s", "Control effort (µL/s per decision)")
MEDIA = RowColumn[float]("media_ml", "Fresh medium used (mL per vial)")
HELD = RowColumn[float]("held", "Samples after which the interlock allowed no dose, per vial")
ERROR = RowColumn[float]("error_2sd_pct", "Decisions with the true error e within 2 sd of its estimate, %")
GROWTH = RowColumn[float]("share_2sd_pct", "Decisions with the true growth share s within 2 sd of its estimate, %")
SUPERVISED = RowColumn[float]("supervised_pct", "Decisions by the supervisor's controller, %")
ALARM = RowColumn[float]("alarm_pct", "Decisions by the supervisor's controller because of innovations, %")
TOLD = {SUPERVISED: "supervised", ALARM: "alarm", ERROR: "error", GROWTH: "growth_share"}


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


ROW = (WINDOW, SETPOINT, N, ISE.mean, ISE.sd, ITAE.mean, ITAE.sd, ISE.median, ITAE.median, ISE.ci95, ITAE.ci95,
       SETTLING, STEADY, MEDIA)  # fmt: skip
DETAIL = (WINDOW, WINDOW_MIN, ISE.per_window, ITAE.per_window, ISE.clean, ITAE.clean, CLEAN_ABS_ERROR, ISE.floor,
          ITAE.floor, EFFORT, SETTLED, OVERFLOWED)  # fmt: skip
TOTAL = (N, *(column for s in METRICS for column in (s.mean, s.sd, s.ci95, s.median, s.clean, s.floor)), CLEAN_STEADY,
         EFFORT, HELD, *TOLD, MEDIA)  # fmt: skip


def _row(columns: Sequence[RowColumn[Any]], trial: DensityTrial, *within: Window) -> Row:
    """Build the row of a trial in a window, or over several: with sums of the scores and means of the rest.

    Values are means over replicates, of the measured OD with T = 1 min unless stated; the settling time is a median.
    """
    scores = {of: [trial.score(window, of) for window in within] for of in ("measured", "clean", "floor")}

    def each(metric: str, of: str = "measured") -> Array:
        return np.array([getattr(score, metric) for score in scores[of]])

    minutes, settling = [w.end - w.start for w in within], each("settling_min")
    settled = float(np.median(np.nan_to_num(settling, nan=np.inf)))  # "never" is infinity
    efforts = [*map(trial.effort, within)]
    values: dict[RowColumn[Any], Any] = {
        WINDOW: within[0].label, WINDOW_MIN: minutes[0], SETPOINT: within[0].setpoint,
        SETTLING: settled if np.isfinite(settled) else float("nan"),
        SETTLED: int(np.isfinite(settling).sum()), OVERFLOWED: int(trial.overflowed.sum()),
    }  # fmt: skip
    means = {
        STEADY: each("steady_abs_error").mean(axis=0),
        CLEAN_STEADY: each("steady_abs_error", "clean").mean(axis=0),
        CLEAN_ABS_ERROR: each("abs_error", "clean").mean(axis=0),
        EFFORT: np.average(efforts, axis=0, weights=minutes) if len(within) > 1 else efforts[0],
        MEDIA: np.sum([*map(trial.media, within)], axis=0),
        HELD: trial.held,
    }
    for s in METRICS:
        of = Spread(each(s.key).sum(axis=0))
        values |= {N: of.n, s.mean: of.mean, s.sd: of.sd, s.median: of.median, s.ci95: of.ci95}
        means |= {s.per_window: each(f"{s.key}_mean").sum(axis=0)}
        means |= {s.clean: each(s.key, "clean").sum(axis=0), s.floor: each(s.key, "floor").sum(axis=0)}
    values |= {column: Spread(vials).mean for column, vials in means.items()}
    told = {column: trial.told.get(name) for column, name in TOLD.items()}
    values |= {column: None if part is None else 100.0 * Spread(part).mean for column, part in told.items()}
    return Row.of(trial.names(), {column: values[column] for column in columns})


def by_window(trial: DensityTrial, columns: Sequence[RowColumn[Any]] = ROW) -> list[Row]:
    return [_row(columns, trial, window) for window in windows(trial.schedule)]


ROWS: dict[str, Callable[[Any], list[Row]]] = {"density": by_window}
"""Signal -> function that builds the rows of a trial; a guest adds its own signal."""


def rows(trials: Sequence[Trial]) -> list[Row]:
    """List the rows of all trials; a density trial has one row per window."""
    return [found for trial in trials for found in ROWS[trial.cell.signal](trial)]


def details(trials: Sequence[DensityTrial]) -> list[Row]:
    """List further values per row: scores with T = window, of the noise-free OD and of the noise; control effort."""
    return [found for trial in trials for found in by_window(trial, DETAIL)]


def totals(trials: Sequence[DensityTrial]) -> list[Row]:
    """Build one row per trial: ISE and ITAE summed over its windows, medium used, control effort and so on."""
    return [_row(TOTAL, trial, *windows(trial.schedule)) for trial in trials]


def _pair(one: Trial, other: Trial, metric: str, window: str, mine: Array, theirs: Array) -> Row:
    found, mean = Spread(mine - theirs), Spread(theirs).mean
    return Row.of(one.names(), {
        AGAINST: other.cell.controller, WINDOW: window, METRIC: metric, N: found.n, DIFFERENCE: found.mean,
        CI95: found.ci95, MEDIAN: found.median, MEDIAN_CI95: found.median_ci95,
        PERCENT: 100.0 * found.mean / mean if mean > NEGLIGIBLE else float("nan"),
        LOWER_IN: int((mine < theirs).sum()),
        VERDICT: ("lower", "no difference shown", "higher")[found.sign + 1],
    })  # fmt: skip


Scored = list[tuple[str, str, Array]]
"""List of (window, metric, the metric's value in each replicate, (N,))."""


def _density_scores(trial: DensityTrial) -> Scored:
    scores = [(window.label, trial.score(window)) for window in windows(trial.schedule)]
    return [(label, metric.key, getattr(score, metric.key)) for label, score in scores for metric in METRICS]


SCORES: dict[str, Callable[[Any], Scored]] = {"density": _density_scores}
"""Signal -> function that returns the scores by which controllers are compared; a guest adds its own signal."""


def pairs(trials: Sequence[Trial], against: str, scores: Callable[[Any], Scored] | None = None) -> list[Row]:
    """Compare every controller with the controller `against` on the same vials, window by window.

    Args: scores: function that returns other scores to compare. Returns: per comparison, the mean difference over
    replicates with its 95 % interval, and the number of replicates in which the controller scores lower.
    """
    of = {t.cell.vials: t for t in trials if t.cell.controller == against}
    met = [(t, of[t.cell.vials]) for t in trials if t.cell.controller != against and t.cell.vials in of]
    found = []
    for one, other in met:
        of_one, of_other = map(scores or SCORES[one.cell.signal], (one, other))
        for (window, metric, mine), (_, _, theirs) in zip(of_one, of_other, strict=True):
            found.append(_pair(one, other, metric, window, mine, theirs))
    return found


def total_scores(trial: DensityTrial) -> Scored:
    found = _density_scores(trial)
    return [("all", m.key, np.sum([values for _, key, values in found if key == m.key], axis=0)) for m in METRICS]


class Summary(TypedDict, total=False):
    """Content of summary.json. beside_paper: names of the rows that correspond to the paper's Table 2."""

    loops: int
    rows: list[Row]
    paper: list[dict[str, Any]]
    paper_settling_min: float
    beside_paper: list[dict[str, str]]
    details: list[Row]
    totals: list[Row]
    paired: list[Row]
    paired_totals: list[Row]
    replicates: int
    seed: int
    calibration: dict[str, Any] | None
    agents: dict[str, Any]
    figures: list[dict[str, str]]


def content(summary: Summary) -> dict[str, Any]:
    """Return the content of summary.json."""
    lists = {key: value for key, value in summary.items() if isinstance(value, list)}
    return {**summary, **{k: [e.values if isinstance(e, Row) else e for e in v] for k, v in lists.items()}}


def read(text: str) -> Summary:
    """Return the summary of the text of summary.json."""
    return cast(Summary, json.loads(text, object_hook=lambda e: Row.of(e) if "signal" in e else e))
