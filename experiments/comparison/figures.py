"""Figures of a benchmark, from trials and from the rows of its summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter
from numpy.typing import NDArray

from experiments.comparison.published import TABLE_2
from experiments.comparison.trials import Trial
from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["LONG_MIN", "bands", "differences", "plants", "published_and_ours"]

Array = NDArray[np.float64]

LONG_MIN = 360.0  # a schedule longer than this is drawn in blocks
BLOCK = 10  # samples
NOTHING = 1e-5  # scores below are those of a plant without noise

STYLE = {
    "dqn": (COLOURS[0], "o"),
    "dqn_paper": (COLOURS[4], "o"),
    "pi": (COLOURS[1], "s"),
    "mpc": (COLOURS[2], "^"),
    "pi_tuned": (COLOURS[5], "s"),
    "adaptive_inverse": (COLOURS[3], "D"),
    "threshold": (COLOURS[6], "v"),
    "hold": ("#b0a080", "P"),
    "oracle": (COLOURS[7], "*"),
}


def _style(controller: str) -> tuple[str, str]:
    return STYLE.get(controller, (COLOURS[0], "X"))


def _band(ax: Axes, minute: Array, values: Array, colour: str) -> None:
    """Mean over replicates and one standard deviation around it; values (N, K)."""
    mean = values.mean(axis=0)
    if values.shape[0] > 1:
        sd = values.std(axis=0, ddof=1)
        ax.fill_between(minute, mean - sd, mean + sd, color=colour, alpha=0.28, linewidth=0)
    ax.plot(minute, mean, color=colour, linewidth=1.3)


def _curves(trial: Trial) -> tuple[Array, Array, Array, Array]:
    """Time, OD (N, K), pump rate and temperature as they are drawn: as they are, or in blocks and without noise."""
    last = trial.minute.size - 1
    if trial.schedule.total_min <= LONG_MIN:
        return trial.minute[:last], trial.od[:, :last], trial.rate[:, :last], trial.temperature[:, :last]

    def blocks(values: Array) -> Array:
        whole = last // BLOCK * BLOCK
        return np.asarray(values[..., :whole].reshape(*values.shape[:-1], -1, BLOCK).mean(axis=-1))

    return blocks(trial.minute), blocks(trial.clean), blocks(trial.rate), blocks(trial.temperature)


def bands(trials: Sequence[Trial]) -> Figure:
    """OD over pump rate (over temperature), a column per controller: mean over replicates, band = one sd."""
    first = trials[0]
    switched = len(set(first.schedule.temperatures)) > 1
    rows, ratios = (3, [2.2, 1.1, 0.9]) if switched else (2, [2.2, 1.1])
    width = max(5.2, 3.2 * len(trials))
    figure, axes = new_figure(
        width, 3.9 + 0.9 * switched, rows, len(trials), sharex=True, sharey="row", height_ratios=ratios
    )
    for column, trial in enumerate(trials):
        top, middle = axes[column], axes[len(trials) + column]
        colour, _ = _style(trial.controller)
        edges = trial.schedule.edges
        goals = np.append(trial.schedule.setpoints, trial.schedule.setpoints[-1])
        top.step(edges, goals, where="post", color="black", linewidth=1.0, linestyle="--")
        minute, od, rate, temperature = _curves(trial)
        _band(top, minute, od, colour)
        _band(middle, minute, 1000.0 * rate, colour)
        if switched:
            bottom = axes[2 * len(trials) + column]
            _band(bottom, minute, temperature, colour)
            for ax in (top, middle, bottom):
                ax.axvline(edges[1], color="#888888", linewidth=0.8, linestyle=":")
        top.set_title(f"{trial.controller}, n = {trial.od.shape[0]}", fontsize=10)
        axes[(rows - 1) * len(trials) + column].set_xlabel("time, min")
    axes[0].set_ylabel("OD")
    axes[len(trials)].set(ylabel="pump rate, µL/s", ylim=(-0.8, 21.5))
    if switched:
        axes[2 * len(trials)].set_ylabel("vial, °C")
    return figure


def published_and_ours(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The cells of the paper's Table 2 (hollow) beside ours (filled, bar = 95 % interval of the mean)."""
    cells = list(dict.fromkeys((p.scenario, p.window) for p in TABLE_2))
    names = [f"{w} °C" if s == "temperature_switch" else f"OD {w}" for s, w in cells]
    figure, (left, right) = new_figure(9.6, 4.3, 1, 2, sharey=True)
    controllers = list(dict.fromkeys(p.controller for p in TABLE_2))
    for k, controller in enumerate(controllers):
        colour, marker = _style(controller)
        for metric, ax in (("ise", left), ("itae", right)):
            for p in (p for p in TABLE_2 if p.controller == controller):
                y = cells.index((p.scenario, p.window)) + 0.24 * (k - 1)
                ax.plot(getattr(p, metric), y, marker, color=colour, markerfacecolor="white", markersize=6)
                for r in rows:
                    if (r["controller"], r["scenario"], r["window"]) == (controller, p.scenario, p.window):
                        mean, (low, high) = r[f"{metric}_mean"], r[f"{metric}_ci95"]
                        if np.isfinite(low):
                            ax.plot([max(low, 1e-9), high], [y, y], color=colour, linewidth=1.2)
                        ax.plot(mean, y, marker, color=colour, markersize=6)
    low_ise = min([p.ise for p in TABLE_2] + [r["ise_mean"] for r in rows])
    left.set(xscale="log", xlabel="ISE (T = 1 min), OD² min", xlim=(0.6 * low_ise, None))
    left.set_yticks(range(len(cells)), names)
    left.invert_yaxis()
    right.set(xlabel="ITAE (T = 1 min), OD min²", xlim=(0.0, None))
    handles = [Line2D([], [], color=_style(c)[0], marker=_style(c)[1], linestyle="", label=c) for c in controllers]
    handles += [
        Line2D([], [], color="black", marker="o", markerfacecolor="white", linestyle="", label="published (n = 3)"),
        Line2D([], [], color="black", marker="o", linestyle="-", label="this run"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    return figure


def _plants(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(str(e["plant"]) for e in entries))


def _legend(figure: Figure, controllers: Sequence[str], extra: Sequence[Line2D] = ()) -> None:
    handles = [Line2D([], [], color=_style(c)[0], marker=_style(c)[1], linestyle="", label=c) for c in controllers]
    figure.legend(handles=[*handles, *extra], loc="outside upper center", ncols=5, frameon=False, fontsize=9)


def _log_axis(ax: Axes) -> None:
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ticks = [m * 10.0**e for e in range(-4, 5) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    ax.xaxis.set_major_locator(FixedLocator(ticks if len(ticks) <= 8 else ticks[::3]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def plants(entries: Sequence[Mapping[str, Any]]) -> Figure:
    """ISE and ITAE summed over the windows, a line per plant: mean and 95 % interval of every controller but `hold`.

    Args: entries: of `comparison.totals`, all of one scenario.
    """
    names = _plants(entries)
    entries = [e for e in entries if e["controller"] != "hold"]
    controllers = list(dict.fromkeys(str(e["controller"]) for e in entries))
    witness = "oracle" if "oracle" in controllers else controllers[0]  # whose run tells the floor; all nearly agree
    figure, axes = new_figure(10.4, 1.6 + 0.62 * len(names), 1, 2, sharey=True)
    for metric, ax in zip(("ise", "itae"), axes, strict=True):
        seen = np.array([e[key] for e in entries for key in (f"floor_{metric}", f"{metric}_mean")])
        ax.set_xlim(0.6 * seen[seen > NOTHING].min(), 1.8 * seen.max())
        for y in range(len(names)):
            if y % 2 == 0:
                ax.axhspan(y - 0.5, y + 0.5, color="#f3f5f7", zorder=0)
        for e in entries:
            y = names.index(e["plant"])
            colour, marker = _style(e["controller"])
            offset = 0.72 * ((controllers.index(e["controller"]) + 0.5) / len(controllers) - 0.5)
            low, high = e[f"{metric}_ci95"]
            if np.isfinite(low):
                ax.plot([max(low, 1e-12), high], [y + offset] * 2, color=colour, linewidth=1.3)
            ax.plot(e[f"{metric}_mean"], y + offset, marker, color=colour, markersize=5)
            floor = e[f"floor_{metric}"]
            if e["controller"] == witness and floor > NOTHING:
                ax.plot([floor, floor], [y - 0.42, y + 0.42], color="#b00020", linewidth=1.4, zorder=1)
        _log_axis(ax)
        unit = {"ise": "ISE, OD² min", "itae": "ITAE, OD min²"}[metric]
        ax.set(xlabel=f"{unit}, sum over the windows (T = 1 min)", ylim=(len(names) - 0.5, -0.5))
        ax.grid(False, axis="y")
    axes[0].set_yticks(range(len(names)), names)
    floor_line = Line2D([], [], color="#b00020", linewidth=1.4, label="sensor-noise floor")
    _legend(figure, controllers, [floor_line])
    return figure


def differences(entries: Sequence[Mapping[str, Any]], against: str) -> Figure:
    """Paired difference of ISE and ITAE to one controller, in % of its mean: mean and 95 % interval per plant.

    Args: entries: of `comparison.total_pairs`, all of one scenario; against: the controller at zero.
    """
    names = _plants(entries)
    shown = [e for e in entries if e["controller"] not in ("hold",)]
    controllers = list(dict.fromkeys(str(e["controller"]) for e in shown))
    figure, axes = new_figure(10.4, 1.6 + 0.62 * len(names), 1, 2, sharey=True)
    for metric, ax in zip(("ise", "itae"), axes, strict=True):
        for y in range(len(names)):
            if y % 2 == 0:
                ax.axhspan(y - 0.5, y + 0.5, color="#f3f5f7", zorder=0)
        ax.axvline(0.0, color="black", linewidth=1.0)
        ax.set_xscale("symlog", linthresh=20.0)
        for e in (e for e in shown if e["metric"] == metric and np.isfinite(e["percent"])):
            y = names.index(e["plant"])
            colour, marker = _style(e["controller"])
            offset = 0.72 * ((controllers.index(e["controller"]) + 0.5) / len(controllers) - 0.5)
            scale = e["percent"] / e["difference"] if e["difference"] else 0.0
            low, high = (scale * v for v in e["ci95"])
            if np.isfinite(low):
                ax.plot([low, high], [y + offset] * 2, color=colour, linewidth=1.3)
            certain = e["verdict"] != "no difference shown"
            ax.plot(e["percent"], y + offset, marker, color=colour, markersize=5,
                    markerfacecolor=colour if certain else "white")  # fmt: skip
        wide = ax.get_xlim()[1] > 200.0
        few, many = [-100, -20, 0, 20, 100, 1000, 10000], [-100, -50, -20, -10, 0, 10, 20, 50, 100, 200]
        ax.xaxis.set_major_locator(FixedLocator(few if wide else many))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:+g}" if v else "0"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.tick_params(axis="x", labelsize=8)
        ax.set(xlabel=f"{metric.upper()} minus that of {against}, %", ylim=(len(names) - 0.5, -0.5))
        ax.grid(False, axis="y")
    axes[0].set_yticks(range(len(names)), names)
    hollow = Line2D([], [], color="black", marker="o", markerfacecolor="white", linestyle="", label="interval holds 0")
    _legend(figure, controllers, [hollow])
    return figure
