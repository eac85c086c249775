"""Figures of a benchmark, drawn from its trials and from the rows of its summary."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter
from numpy.typing import NDArray

from experiments.comparison.config import TABLE_2
from experiments.comparison.statistics import CI95, DIFFERENCE, ISE, METRIC, METRICS, PERCENT, VERDICT, WINDOW, Row
from experiments.comparison.trials import DensityTrial
from experiments.reporting.charts import COLOURS, new_figure, pump_end
from experiments.reporting.tables import clock

Array = NDArray[np.float64]

LONG_MIN = 360.0  # a scenario longer than this is drawn in blocks
BLOCK_MIN = 10.0
LEAST = 1e-9  # drawn lower end, on a logarithmic axis, of an interval that reaches zero
NOISELESS = 1e-5  # a lower score means that the plant has no noise

MARKS = {
    "dqn": (COLOURS[0], "o"),
    "dqn_paper": (COLOURS[4], "o"),
    "dqn_adaptive": ("#003f6b", "h"),
    "inverse": ("#8c3f73", "D"),
    "pi": (COLOURS[1], "s"),
    "mpc": (COLOURS[2], "^"),
    "pi_tuned": (COLOURS[5], "s"),
    "adaptive_inverse": (COLOURS[3], "D"),
    "threshold": (COLOURS[6], "v"),
    "hold": ("#b0a080", "P"),
    "oracle": (COLOURS[7], "*"),
}


def _mark(controller: str) -> tuple[str, str]:
    return MARKS.get(controller, (COLOURS[0], "X"))


def _handles(controllers: Iterable[str]) -> list[Line2D]:
    marks = {c: _mark(c) for c in controllers}
    return [Line2D([], [], color=colour, marker=m, linestyle="", label=c) for c, (colour, m) in marks.items()]


def estimate(
    ax: Axes, mark: tuple[str, str], y: float, value: float, interval: Sequence[float], hollow: bool = False
) -> None:
    """Draw a value as a controller's mark, and its interval as a line unless it is nan. Args: mark: colour, marker."""
    colour, marker = mark
    if np.isfinite(interval[0]):
        ax.plot(interval, [y, y], color=colour, linewidth=1.3)
    ax.plot(value, y, marker, color=colour, markersize=5, markerfacecolor="white" if hollow else colour)


def _band(ax: Axes, time: Array, values: Array, colour: str) -> None:
    """Draw the mean over replicates, and a band of ± one standard deviation. Args: values: (N, K)."""
    mean = values.mean(axis=0)
    if values.shape[0] > 1:
        sd = values.std(axis=0, ddof=1)
        ax.fill_between(time, mean - sd, mean + sd, color=colour, alpha=0.28, linewidth=0)
    ax.plot(time, mean, color=colour, linewidth=1.3)


def _curves(trial: DensityTrial) -> tuple[Array, Array, Array, Array]:
    """Return minutes (K,), OD, pump rate, temperature (N, K); for a long scenario block means with noise-free OD."""
    last = trial.minute.size - 1
    if trial.schedule.total_min <= LONG_MIN:
        return trial.minute[:last], trial.od[:, :last], trial.rate[:, :last], trial.temperature[:, :last]

    size = max(round(BLOCK_MIN / float(trial.minute[1] - trial.minute[0])), 1)

    def blocks(values: Array) -> Array:
        whole = last // size * size
        return np.asarray(values[..., :whole].reshape(*values.shape[:-1], -1, size).mean(axis=-1))

    return blocks(trial.minute), blocks(trial.clean), blocks(trial.rate), blocks(trial.temperature)


def bands(trials: Sequence[DensityTrial]) -> Figure:
    """Draw OD, pump rate and, if it is switched, temperature; a column per trial. Line: mean; band: ± one sd."""
    first = trials[0]
    switched = len(set(first.schedule.temperatures)) > 1
    rows, ratios = (3, [2.2, 1.1, 0.9]) if switched else (2, [2.2, 1.1])
    width, (unit, sign) = max(5.2, 3.2 * len(trials)), clock(first.schedule.total_min)
    figure, axes = new_figure(
        width, 3.9 + 0.9 * switched, rows, len(trials), sharex=True, sharey="row", height_ratios=ratios
    )
    for column, trial in enumerate(trials):
        top, middle = axes[column], axes[len(trials) + column]
        colour, _ = _mark(trial.cell.controller)
        edges = trial.schedule.edges / unit
        goals = np.append(trial.schedule.setpoints, trial.schedule.setpoints[-1])
        top.step(edges, goals, where="post", color="black", linewidth=1.0, linestyle="--")
        minute, od, rate, temperature = _curves(trial)
        time = minute / unit
        _band(top, time, od, colour)
        _band(middle, time, 1000.0 * rate, colour)
        if switched:
            bottom = axes[2 * len(trials) + column]
            _band(bottom, time, temperature, colour)
            for edge, (before, after) in zip(edges[1:-1], pairwise(trial.schedule.temperatures), strict=True):
                for ax in (top, middle, bottom) if after != before else ():
                    ax.axvline(edge, color="#888888", linewidth=0.8, linestyle=":")
        top.set_title(f"{trial.cell.controller}, n = {trial.od.shape[0]}")
        axes[(rows - 1) * len(trials) + column].set_xlabel(f"time, {sign}")
    axes[0].set_ylabel("OD")
    axes[len(trials)].set(ylabel="pump rate, µL/s", ylim=(-0.8, 0.5 + pump_end(*(trial.rate for trial in trials))))
    if switched:
        axes[2 * len(trials)].set_ylabel("vial, °C")
    return figure


def published_and_ours(rows: Sequence[Row]) -> Figure:
    """Draw the values of the paper's Table 2 (hollow) and of this run (filled; bar: 95 % interval of the mean)."""
    cells = list(dict.fromkeys((p.scenario, p.window) for p in TABLE_2))
    names = [f"{w} °C" if s == "temperature_switch" else f"OD {w}" for s, w in cells]
    figure, (left, right) = new_figure(9.6, 4.3, 1, 2, sharey=True)
    controllers = list(dict.fromkeys(p.controller for p in TABLE_2))
    for k, controller in enumerate(controllers):
        for metric, ax in zip(METRICS, (left, right), strict=True):
            for p in (p for p in TABLE_2 if p.controller == controller):
                y = cells.index((p.scenario, p.window)) + 0.24 * (k - 1)
                estimate(ax, _mark(controller), y, getattr(p, metric.key), (np.nan, np.nan), hollow=True)
                for r in rows:
                    if (r.controller, r.scenario, r[WINDOW]) == (controller, p.scenario, p.window):
                        low, high = r[metric.ci95]
                        estimate(ax, _mark(controller), y, r[metric.mean], (max(low, LEAST), high))
    low_ise = min([p.ise for p in TABLE_2] + [r[ISE.mean] for r in rows])
    left.set(xscale="log", xlabel="ISE (T = 1 min), OD² min", xlim=(0.6 * low_ise, None))
    left.set_yticks(range(len(cells)), names)
    left.invert_yaxis()
    right.set(xlabel="ITAE (T = 1 min), OD min²", xlim=(0.0, None))
    handles = [
        *_handles(controllers),
        Line2D([], [], color="black", marker="o", markerfacecolor="white", linestyle="", label="published (n = 3)"),
        Line2D([], [], color="black", marker="o", linestyle="-", label="this run"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=5)
    return figure


def by_plant(
    entries: Sequence[Row], handles: Sequence[Line2D], width: float = 10.4, panels: int = 2
) -> tuple[Figure, list[Axes], Callable[[Row], float]]:
    """Create empty panels with one row per plant; return figure, axes, and a function (entry) -> vertical position.

    Args: entries: of all plants and controllers to draw. handles: of the legend. panels: number of panels.
    """
    names = list(dict.fromkeys(e.plant for e in entries))
    controllers = list(dict.fromkeys(e.law for e in entries))
    figure, axes = new_figure(width, 1.6 + 0.62 * len(names), 1, panels, sharey=True)
    for ax in axes:
        for row in range(0, len(names), 2):
            ax.axhspan(row - 0.5, row + 0.5, color="#f3f5f7", zorder=0)
        ax.grid(False, axis="y")
        ax.set_ylim(len(names) - 0.5, -0.5)
    axes[0].set_yticks(range(len(names)), names)
    figure.legend(handles=list(handles), loc="outside upper center", ncols=5)

    def height(entry: Row) -> float:
        offset = (controllers.index(entry.law) + 0.5) / len(controllers) - 0.5
        return names.index(entry.plant) + 0.72 * offset

    return figure, axes, height


def _log_axis(ax: Axes) -> None:
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ticks = [m * 10.0**e for e in range(-4, 5) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    ax.xaxis.set_major_locator(FixedLocator(ticks if len(ticks) <= 8 else ticks[::3]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def plants(entries: Sequence[Row]) -> Figure:
    """Draw ISE and ITAE, summed over the windows, one row per plant: mean and 95 % interval. `hold` is left out.

    Args: entries: from `statistics.totals`, all of one scenario.
    """
    entries = [e for e in entries if e.controller != "hold"]
    # One floor per plant is drawn: all controllers have the same sensors, so their floors nearly agree.
    witness = next((e for e in entries if e.controller == "oracle"), entries[0]).controller
    floor_line = Line2D([], [], color="#b00020", linewidth=1.4, label="sensor-noise floor")
    figure, axes, height = by_plant(entries, [*_handles(e.controller for e in entries), floor_line])
    for metric, ax in zip(METRICS, axes, strict=True):
        seen = np.array([e[column] for e in entries for column in (metric.floor, metric.mean)])
        ax.set_xlim(0.6 * seen[seen > NOISELESS].min(), 1.8 * seen.max())
        for e in entries:
            low, high = e[metric.ci95]
            estimate(ax, _mark(e.controller), height(e), e[metric.mean], (max(low, LEAST), high))
            floor = e[metric.floor]
            if e.controller == witness and floor > NOISELESS:
                row = round(height(e))
                ax.plot([floor, floor], [row - 0.42, row + 0.42], color="#b00020", linewidth=1.4, zorder=1)
        _log_axis(ax)
        ax.set_xlabel(f"{metric.name}, {metric.unit}, sum over the windows (T = 1 min)")
    return figure


def differences(entries: Sequence[Row], against: str) -> Figure:
    """Draw paired differences of ISE and ITAE to the controller `against`, in % of its mean, with 95 % intervals.

    Args: entries: from `statistics.pairs` with `total_scores`, all of one scenario.
    """
    entries = [e for e in entries if e.controller != "hold"]
    open_mark = Line2D([], [], color="black", marker="o", mfc="white", linestyle="", label="interval includes 0")
    figure, axes, height = by_plant(entries, [*_handles(e.controller for e in entries), open_mark])
    for metric, ax in zip(METRICS, axes, strict=True):
        ax.axvline(0.0, color="black", linewidth=1.0)
        ax.set_xscale("symlog", linthresh=20.0)
        for e in (e for e in entries if e[METRIC] == metric.key and np.isfinite(e[PERCENT])):
            scale = e[PERCENT] / e[DIFFERENCE] if e[DIFFERENCE] else 0.0
            hollow = e[VERDICT] == "no difference shown"
            estimate(ax, _mark(e.controller), height(e), e[PERCENT], [scale * v for v in e[CI95]], hollow)
        wide = ax.get_xlim()[1] > 200.0
        few, many = [-100, -20, 0, 20, 100, 1000, 10000], [-100, -50, -20, -10, 0, 10, 20, 50, 100, 200]
        ax.xaxis.set_major_locator(FixedLocator(few if wide else many))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:+g}" if v else "0"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.tick_params(axis="x", labelsize=8)
        ax.set_xlabel(f"{metric.name} minus that of {against}, %")
    return figure
