"""The figure of a run against its model: growth, pump, and the error of predictions one sample ahead."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from envs.identification.agreement import Agreement, Compared
from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["agreement_figure"]

Array = NDArray[np.float64]

DATA, MODEL, ESTIMATOR, MARK = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[3]


def agreement_figure(found: Agreement, estimator: Mapping[str, Array], supervised: Array, title: str) -> Figure:
    """Growth rate and pump gain as the recording shows them, the model's values, and what its predictions missed.

    Args: estimator: what the controller believed: `minute`, and `mu` (1/min) or `gain` where it has one, all (K,).
      supervised: minutes at which a supervisor acted, (S,).
    """
    figure, axes = new_figure(9.5, 7.4, 3, sharex=True, height_ratios=(1.2, 1.2, 1.0))
    top, middle, bottom = axes
    _compared(top, found.growth, "growth rate µ, 1/min")
    net = [
        None if p is None else (p.low + found.growth.expected, p.high + found.growth.expected) for p in found.net.found
    ]
    for first, end, band in zip(found.net.first_min, found.net.end_min, net, strict=True):
        if band is not None:
            label = "if the pump is the model's" if first == found.net.first_min[0] else None
            top.fill_between([first / 60, end / 60], *band, color=MODEL, alpha=0.25, lw=0, label=label)
    _compared(middle, found.gain, "pump gain, 1 = the model's")
    for ax, key in ((top, "mu"), (middle, "gain")):
        if key in estimator:
            ax.plot(
                estimator["minute"] / 60, estimator[key], color=ESTIMATOR, lw=1.0, label="the controller's estimate"
            )
        ax.legend(loc="upper left", ncols=4)
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.2 * (high - low))
    hours = found.series.time / 60
    bottom.axhline(0.0, color="0.6", lw=0.8)
    bottom.plot(hours, found.series.od - found.predicted, ".", ms=2.5, color=DATA)
    bottom.plot(supervised / 60, np.zeros(len(supervised)), "|", ms=9, color=MARK, label="supervisor acted")
    if len(supervised):
        bottom.legend(loc="upper left")
    top.set_title(title)
    bottom.set_ylabel("measured minus\npredicted, OD")
    bottom.set_title(
        f"one sample ahead: rms {found.rms:.4f} OD, {found.attainable:.4f} without the model's error of net growth"
    )
    bottom.set_xlabel("time, h")
    return figure


def _compared(ax: Axes, c: Compared, label: str) -> None:
    """Draw a parameter's segments with their intervals over the model's value."""
    ax.axhline(c.expected, color="black", lw=1.0, ls="--", label="model")
    known = [(a / 60, b / 60, p) for a, b, p in zip(c.first_min, c.end_min, c.found, strict=True) if p is not None]
    if known:
        middle = np.array([0.5 * (a + b) for a, b, _ in known])
        value, low, high = np.array([(p.value, p.low, p.high) for _, _, p in known]).T
        ax.errorbar(
            middle, value, yerr=[np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)],
            xerr=[0.5 * (b - a) for a, b, _ in known], fmt="o", ms=4.5, color=DATA, elinewidth=1.1, capsize=2.5,
            label="segment alone, 95 %",
        )  # fmt: skip
        ends = np.concatenate([value, [c.expected]])
        spread = max(1.5 * float(np.ptp(ends)), 2.0 * float(np.median(high - low)), 0.1 * c.expected)
        ax.set_ylim(max(ends.mean() - spread, 0.0), ends.mean() + spread)  # one wide interval must not flatten the rest
    else:
        ax.text(0.5, 0.5, "not identifiable in any segment", transform=ax.transAxes, ha="center", color="0.4")
    ax.set_ylabel(label)
