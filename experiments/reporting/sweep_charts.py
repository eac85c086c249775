"""Figures of a sweep: learning curves of its configurations, and all measured values."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray
from scipy.stats import trim_mean

from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["learning_curves", "values"]

Array = NDArray[np.float64]


def _plain(axis: Axis) -> None:
    """Write 0.01 instead of a power of ten."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _middle(row: Array) -> float:
    finite = row[np.isfinite(row)]
    return float(trim_mean(finite, 0.25)) if finite.size else float("nan")


def learning_curves(curves: Sequence[tuple[str, Array, Array]], quantity: str) -> Figure:
    """Draw the interquartile mean over seeds as a line, the worst seed dashed, a colour per configuration.

    Args: curves: name, steps (K,), values (K, S). quantity: with its unit.
    """
    figure, (ax,) = new_figure(9.0, 4.0 + 0.12 * len(curves))
    for k, (name, steps, each) in enumerate(curves):
        colour, floor = COLOURS[k % len(COLOURS)], np.maximum(each, 1e-4)
        ax.plot(
            steps, [_middle(row) for row in floor], color=colour, linewidth=1.6, label=f"{name} (n = {each.shape[1]})"
        )
        ax.plot(steps, np.nanmax(floor, axis=1), color=colour, linewidth=0.9, linestyle="--")
    ax.plot([], [], color="black", linewidth=1.6, label="line: interquartile mean over seeds")
    ax.plot([], [], color="black", linewidth=0.9, linestyle="--", label="dashed: worst seed")
    ax.set(xlabel="environment step", ylabel=quantity, yscale="log")
    _plain(ax.yaxis)
    figure.legend(loc="outside lower left", ncols=1 if max(len(c[0]) for c in curves) > 40 else 2)
    return figure


def values(measured: Mapping[str, Array], quantity: str) -> Figure:
    """Draw a row per configuration, the best on top: a dot per seed or reactor, a bar at the interquartile mean.

    Args: measured: name -> (n,). quantity: with its unit.
    """
    figure, (ax,) = new_figure(9.0, 1.2 + 0.3 * len(measured))
    for row, each in enumerate(measured.values()):
        ax.plot(each, np.full(each.size, row), "o", color=COLOURS[0], alpha=0.5, markersize=5, markeredgewidth=0)
        ax.plot([float(trim_mean(each, 0.25))] * 2, [row - 0.3, row + 0.3], color=COLOURS[1], linewidth=2)
    ax.set(xlabel=quantity, ylim=(len(measured) - 0.4, -0.6))
    every = np.concatenate(list(measured.values()))
    if every.min() > 0.0 and every.max() > 30.0 * every.min():
        ax.set_xscale("log")
        _plain(ax.xaxis)
    ax.set_yticks(range(len(measured)), list(measured), fontsize=8)
    return figure
