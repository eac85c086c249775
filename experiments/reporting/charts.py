"""The style of all figures, and the figures of training and deployment.

Each function takes arrays and returns a matplotlib Figure; `save` writes it as SVG and PNG.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from numpy.typing import NDArray

from experiments.reporting.tables import clock

Array = NDArray[np.float64]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
"""Okabe and Ito's palette: distinguishable with any colour vision."""

matplotlib.rcParams.update(
    {
        "axes.axisbelow": True,
        "axes.grid": True,
        "axes.spines.right": False,
        "axes.spines.top": False,
        "axes.titlesize": 10,
        "grid.color": "#e6e6e6",
        "grid.linewidth": 0.6,
        "legend.fontsize": 8,
        "legend.frameon": False,
        "svg.fonttype": "none",  # text stays text
        "svg.hashsalt": "turbidostat-dqn",  # makes files reproducible
    }
)


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **kwargs: Any
) -> tuple[Figure, list[Axes]]:
    """Create a figure and return its axes, row by row; `kwargs` are passed to `Figure.subplots`."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **kwargs).flat)


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write folder/name.svg and folder/name.png; return the path of the PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    figure.set_layout_engine(None)  # the layout is final; computing it again takes longer than drawing
    figure.savefig(folder / f"{name}.png", dpi=150)
    return folder / f"{name}.png"


def plain(axis: Axis) -> None:
    """Label the ticks of a logarithmic axis 0.01, not 10^-2, because superscripts are slow to draw."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(_Plain(labelOnlyBase=False))


class _Plain(LogFormatter):
    """Formatter that labels the same ticks as `LogFormatter`, with plain numbers."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def pump_end(*rates: Array) -> float:
    """Return the upper end of a pump rate axis, uL/s: 21, or 5 % above the largest rate. Args: rates: mL/s."""
    return max(21.0, *(1050.0 * float(np.nanmax(rate, initial=0.0)) for rate in rates))


def _population(ax: Axes, x: Array, curves: Array, colour: str, label: str) -> None:
    """Draw a line for one agent; the median, quartiles and range of several agents. Args: curves: (K, S)."""
    if curves.shape[1] == 1:
        ax.plot(x, curves[:, 0], color=colour, linewidth=1.2, label=label)
        return
    low, q1, middle, q3, high = np.nanpercentile(curves, [0, 25, 50, 75, 100], axis=1)
    n = curves.shape[1]
    ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0, label=f"range of {n} seeds")
    ax.fill_between(x, q1, q3, color=colour, alpha=0.35, linewidth=0, label="middle half")
    ax.plot(x, middle, color=colour, linewidth=1.4, label=f"{label}, median")


def learning(episode_return: Array, eval_step: Array, regret_pct: Array, best_step: Array) -> Figure:
    """Draw the cost per episode (the paper's Fig. 2b) and the regret of the greedy policy during training of S agents.

    Args:
      episode_return: reward per episode, (episodes, S). eval_step: environment steps of the K evaluations, (K,).
      regret_pct: regret on the selection grid, (K, S). best_step: step at which the kept policy was saved, (S,).
    """
    figure, (left, right) = new_figure(9.0, 3.4, 1, 2)
    episodes = np.arange(1, episode_return.shape[0] + 1)
    _population(left, episodes, -episode_return, COLOURS[0], "exploring agent")
    left.set(xlabel="episode", ylabel="cost of the episode, sum of (x − setpoint)²", yscale="log")
    left.set_title("Cost per training episode (minus the reward)")
    left.legend()
    _population(right, eval_step, np.maximum(regret_pct, 1e-3), COLOURS[1], "greedy policy")
    if best_step.size == 1:
        right.axvline(best_step[0], color=COLOURS[2], linewidth=1, linestyle="--", label="policy kept")
    right.set(xlabel="environment step", ylabel="regret against the optimum, %", yscale="log")
    right.set_title("Greedy policy on the selection grid")
    plain(left.yaxis)
    plain(right.yaxis)
    right.legend()
    return figure


def policy_map(od: Array, setpoint: Array, learned: Array, optimal: Array) -> Figure:
    """Draw the learned and the optimal pump rate as maps over OD and setpoint.

    Args: od: (X,). setpoint: (Y,). learned, optimal: pump rates, mL/s, (Y, X).
    """
    most, ends = max(20.0, 1000.0 * float(learned.max()), 1000.0 * float(optimal.max())), setpoint[[0, -1]]
    labels = "OD x", "setpoint, OD", "pump rate, µL/s"
    return _maps(od, setpoint, (1000.0 * learned, 1000.0 * optimal), most, (ends, ends), labels)


def relative_map(error: Array, share: Array, learned: Array, optimal: Array) -> Figure:
    """Draw the learned and the optimal dose as maps over error and growth share.

    Args: error: in periods of full pump, (X,). share: growth share, (Y,). learned, optimal: dose as a fraction of a
      period of full pump, (Y, X).
    """
    labels = "error e, periods of full pump", "growth share s", "dose, fraction of full pump"
    return _maps(error, share, (learned, optimal), 1.0, (np.zeros(2), share[[0, -1]]), labels)


def _maps(
    x: Array, y: Array, levels: tuple[Array, Array], most: float, target: tuple[Array, Array],
    labels: tuple[str, str, str],
) -> Figure:  # fmt: skip
    figure, axes = new_figure(9.0, 3.6, 1, 2, sharey=True)
    for ax, level, title in zip(axes, levels, ("learned policy", "optimum (dynamic programming)"), strict=True):
        mesh = ax.pcolormesh(x, y, level, cmap="viridis", vmin=0.0, vmax=most, rasterized=True)
        ax.plot(*target, color="white", linewidth=1, linestyle="--")
        ax.set(xlabel=labels[0], title=title)
        ax.grid(False)
    axes[0].set_ylabel(labels[1])
    figure.colorbar(mesh, ax=axes, label=labels[2])
    return figure


def trajectories(minutes: Array, od: Array, best: Array, setpoint: Array, rates: Array, best_rates: Array) -> Figure:
    """Draw noise-free closed loops of the learned policy and the optimum, from the same starts; a column per setpoint.

    Args:
      minutes: (K + 1,). od, best: OD of the learned policy and of the optimum, with the start, (K + 1, G).
      setpoint: (G,). rates, best_rates: their pump rates, mL/s, (K, G).
    """
    unit, sign = clock(minutes[-1])
    labels, end = ("OD", "pump rate, µL/s", f"time, {sign}"), (-0.5, pump_end(rates, best_rates))
    series = minutes / unit, od, best, 1000.0 * rates, 1000.0 * best_rates
    return _loops(series, setpoint, "setpoint {:g}", labels, end, target=True)


def relative_trajectories(error: Array, best: Array, share: Array, levels: Array, best_levels: Array) -> Figure:
    """Draw noise-free closed loops in relative coordinates, as `trajectories` does; a column per growth share.

    Args: error, best: error e of the learned policy and of the optimum, with the start, (K + 1, G). share: growth
      share, (G,). levels, best_levels: their doses as fractions of a period of full pump, (K, G).
    """
    labels = "error e, periods of full pump", "dose, fraction of full pump", "control periods"
    shown = 40  # periods; the loop has settled by then
    series = (np.arange(shown), *(each[:shown] for each in (error, best, levels, best_levels)))
    return _loops(series, share, "growth takes {:g} of the pump", labels, (-0.03, 1.03))


def _loops(
    series: Sequence[Any], group: Array, title: str, labels: tuple[str, str, str], end: tuple[float, float],
    target: bool = False,
) -> Figure:  # fmt: skip
    """Draw state (above) and action (below) over time, with those of the optimum; a column per value of `group`."""
    time, state, best, action, best_action = series
    groups, until = np.unique(group), time[: len(action)]
    figure, axes = new_figure(3.4 * groups.size, 4.6, 2, groups.size, sharex=True, sharey="row", height_ratios=[2, 1])
    for column, value in enumerate(groups):
        top, bottom = axes[column], axes[groups.size + column]
        if target:
            top.axhline(value, color="black", linewidth=0.8, linestyle="--", label="setpoint")
        for k, g in enumerate(np.flatnonzero(group == value)):
            top.plot(time, state[:, g], color=COLOURS[k], linewidth=1.5, label=f"learned, from {state[0, g]:g}")
            top.plot(time, best[:, g], color="black", linewidth=1.0, linestyle=":", label=None if k else "optimum")
            bottom.step(until, action[:, g], where="post", color=COLOURS[k], linewidth=1.0)
            bottom.step(until, best_action[:, g], where="post", color="black", linewidth=0.8, linestyle=":")
        top.set_title(title.format(value))
        bottom.set(xlabel=labels[2], ylim=end)
    axes[0].legend()
    axes[0].set_ylabel(labels[0])
    axes[groups.size].set_ylabel(labels[1])
    return figure


def closed_loop(
    minutes: Array,
    od: Array,
    setpoint: Array,
    rate: Array,
    names: Sequence[str],
    temperature: Array | None = None,
    title: str = "",
    marks: Sequence[tuple[float, str]] = (),
    refused: Array | None = None,
    aim: Array | None = None,
) -> Figure:
    """Draw a recorded closed loop of N reactors: OD with its setpoint, pump rate, and temperature if given.

    Args: minutes, od, setpoint, rate, temperature: (K, N), nan where a reactor has no sample. names: N labels.
      marks: minute and text of vertical lines. refused: rejected OD readings, (K, N); a value beyond the axis is
      drawn at its edge. aim: setpoint given to the controller, which may be an announced one, (K, N).
    """
    unit, sign = clock(float(np.nanmax(minutes, initial=0.0)))
    time, rows = minutes / unit, 2 if temperature is None else 3
    ratios = [2.2, 1.0] if temperature is None else [2.2, 1.0, 0.8]
    figure, axes = new_figure(8.0, 4.6 + 0.9 * (rows - 2), rows, 1, sharex=True, height_ratios=ratios)
    for n, name in enumerate(names):
        colour = COLOURS[n % len(COLOURS)]
        axes[0].plot(time[:, n], od[:, n], color=colour, linewidth=1.2, label=name)
        axes[0].step(
            time[:, n], setpoint[:, n], where="post", color="black" if n == 0 else colour, linewidth=0.9,
            linestyle="--", label="setpoint" if n == 0 else None,
        )  # fmt: skip
        if aim is not None:
            axes[0].step(
                time[:, n], aim[:, n], where="post", color=colour, linewidth=0.9, linestyle=":",
                label="given to the controller" if n == 0 else None,
            )  # fmt: skip
        axes[1].step(time[:, n], rate[:, n] * 1000.0, where="post", color=colour, linewidth=1.0)
        if temperature is not None:
            axes[2].plot(time[:, n], temperature[:, n], color=colour, linewidth=1.0)
    for minute, text in marks:
        for ax in axes:
            ax.axvline(minute / unit, color="#7f7f7f", linewidth=0.9, linestyle=":")
        place: dict[str, Any] = {"rotation": 90, "fontsize": 7, "va": "bottom", "ha": "right", "color": "#4d4d4d"}
        axes[0].text(minute / unit, 0.02, text, transform=axes[0].get_xaxis_transform(), **place).set_in_layout(False)
    if refused is not None and np.isfinite(refused).any():
        low, high = axes[0].get_ylim()
        axes[0].plot(
            time, np.clip(refused, low, high), "x", color="#7f7f7f", markersize=4, clip_on=False,
            label=["rejected reading", *[None] * (len(names) - 1)],
        )  # fmt: skip
        axes[0].set_ylim(low, high)
    axes[0].set(ylabel="OD", title=title)
    axes[0].legend(ncols=3)
    axes[1].set(ylabel="pump rate, µL/s", ylim=(-0.5, pump_end(rate)))
    if temperature is not None:
        axes[2].set_ylabel("temperature, °C")
    axes[-1].set_xlabel(f"time, {sign}")
    return figure
