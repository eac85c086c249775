"""Figures of a calibration: measured against model, drift along the recording, coverage of the intervals."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from envs.identification.fit import Parameter
from envs.identification.screening import Series
from envs.identification.window import Calibration, Segment
from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["coverage_figure", "drift_figure", "fit_figure"]

Array = NDArray[np.float64]

DATA, MODEL, PUMP, REJECTED, UNUSED = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[3], "#a9b4bf"


def fit_figure(raw: Series, result: Calibration, title: str) -> Figure:
    """Measured OD with the fitted trajectory, the residuals below, and the pump rate.

    Args: raw: the recording before screening, at the same positions as `result`'s. result: of `window.calibrate`.
    """
    figure, axes = new_figure(11.0, 7.2, 3, sharex=True, height_ratios=(3.0, 1.3, 0.8))
    top, middle, bottom = axes
    _measured(top, raw, result)
    a, b = result.window
    top.plot(raw.time[a:b] / 60, result.fit.model, color=MODEL, lw=1.8, label=_model_label(result))
    top.set_title(title)
    top.set_ylabel("OD")
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    middle.axhline(0.0, color="0.6", lw=0.8)
    middle.plot(raw.time[a:b] / 60, result.fit.residual, ".", ms=3, color=DATA)
    middle.set_ylabel("measured\nminus model, OD")
    middle.set_title(
        f"residuals: rms {result.fit.rms:.4f} OD, correlation from row to row {result.fit.autocorrelation:.2f}"
    )
    bottom.step(raw.time / 60, 1000.0 * raw.pump_rate, where="post", color=PUMP, lw=1.2)
    bottom.set_ylabel("pump rate,\nµL/s")
    bottom.set_xlabel("time, h")
    for ax in axes:
        ax.margins(x=0.01)
    return figure


def _model_label(result: Calibration) -> str:
    mu, tau = result.fit.mu, result.tau
    return (
        f"model: µ = {mu.value:.5f} ± {mu.half_width:.5f} /min, τ = {tau.value:.3f} ± {tau.half_width:.3f}, "
        f"PMSE {result.fit.pmse_pct:.2g} %"
    )


def _measured(axes: Axes, raw: Series, result: Calibration) -> None:
    """Readings by their fate; rejected ones beyond the scale sit as triangles on the upper edge."""
    hours, clean = raw.time / 60, result.screened.series.od
    a, b = result.window
    window = np.zeros(len(hours), dtype=np.bool_)
    window[a:b] = True
    good = np.isfinite(clean)
    ceiling = 1.15 * float(np.nanmax(clean))
    rejected = np.isfinite(raw.od) & ~good
    above = rejected & (raw.od > ceiling)
    axes.plot(hours[good & window], clean[good & window], ".", ms=4, color=DATA, label="measured, used")
    if (good & ~window).any():
        axes.plot(hours[good & ~window], clean[good & ~window], ".", ms=4, color=UNUSED, label="measured, not used")
        axes.axvspan(hours[a], hours[b - 1], color=MODEL, alpha=0.06, lw=0)
    if rejected.any():
        axes.plot(
            hours[rejected & ~above], raw.od[rejected & ~above], "x", ms=5, color=REJECTED, label="rejected reading"
        )
    if above.any():
        label = f"rejected, up to {np.nanmax(raw.od[above]):.3g}"
        axes.plot(hours[above], np.full(above.sum(), 0.97 * ceiling), "^", ms=4, color=REJECTED, label=label)
    axes.set_ylim(min(0.0, float(np.nanmin(clean))), ceiling)


def drift_figure(result: Calibration, title: str) -> Figure:
    """mu and tau of each segment fitted alone, beside the returned pair and its window."""
    figure, axes = new_figure(9.5, 6.2, 2, sharex=True)
    time = result.screened.series.time / 60
    a, b = result.window
    rows = (
        ("growth rate µ, 1/min", [s.mu for s in result.segments], result.fit.mu, result.drift_mu),
        ("dilution constant τ", [s.tau for s in result.segments], result.tau, result.drift_tau),
    )
    for ax, (label, values, pair, drift) in zip(axes, rows, strict=True):
        ax.axvspan(time[a], time[b - 1], color=MODEL, alpha=0.06, lw=0)
        ax.plot([time[a], time[b - 1]], [pair.value] * 2, color=MODEL, lw=1.8, label="returned pair, its window")
        ax.fill_between([time[a], time[b - 1]], pair.low, pair.high, color=MODEL, alpha=0.2, lw=0)
        known = _segments(ax, time, result.segments, values)
        if drift is not None and known:
            ends = [known[0], known[-1]]
            ax.plot(ends, [drift.first, drift.last], "--", color=PUMP, lw=1.2, label=f"trend {drift.change_pct:+.0f} %")
        ax.set_ylabel(label)
        ax.legend(loc="best", ncols=3)
    axes[0].set_title(title)
    axes[1].set_xlabel("time, h")
    axes[1].set_xlim(-0.01 * time[-1], 1.01 * time[-1])
    return figure


def _segments(ax: Axes, time: Array, segments: tuple[Segment, ...], values: list[Parameter | None]) -> list[float]:
    """Draw the estimates with their intervals; returns the middles (h) of the segments that have one."""
    known = [(s, v) for s, v in zip(segments, values, strict=True) if v is not None]
    if not known:
        ax.text(0.5, 0.5, "not identifiable in any segment", transform=ax.transAxes, ha="center", color="0.4")
        return []
    middle = np.array([s.middle_min / 60 for s, _ in known])
    value = np.array([v.value for _, v in known])
    across = np.array([0.5 * (time[s.end - 1] - time[s.first]) for s, _ in known])
    down, up = (
        np.array([max(d, 0.0) for d in side])
        for side in zip(*((v.value - v.low, v.high - v.value) for _, v in known), strict=True)
    )
    ax.errorbar(
        middle, value, yerr=[down, up], xerr=across, fmt="o", ms=5, color=DATA, elinewidth=1.1, capsize=2.5,
        label="segment alone, 95 % interval",
    )  # fmt: skip
    spread = value.max() - value.min() + 0.25 * abs(float(value.mean()))
    ax.set_ylim(max(0.0, value.min() - spread), value.max() + spread)  # one wide interval must not flatten the rest
    return [float(m) for m in middle]


def coverage_figure(mu: Array, tau: Array, truth: tuple[float, float], title: str) -> Figure:
    """Intervals of many simulated recordings against the truth, sorted by estimate; misses in colour.

    Args: mu, tau: (value, low, high) of each recording, shape (N, 3). truth: (mu, tau).
    """
    figure, axes = new_figure(10.5, 4.6, 1, 2)
    figure.suptitle(title, fontsize=10)
    names = (("growth rate µ, 1/min", mu, truth[0]), ("dilution constant τ", tau, truth[1]))
    for ax, (label, data, true) in zip(axes, names, strict=True):
        data = data[np.argsort(data[:, 0])]
        hit = (data[:, 1] <= true) & (true <= data[:, 2])
        for mask, colour, name in ((hit, DATA, "holds the truth"), (~hit, MODEL, "misses it")):
            ax.vlines(
                np.flatnonzero(mask), data[mask, 1], data[mask, 2], color=colour, lw=1.0,
                label=f"95 % interval {name}: {mask.sum()} of {len(mask)}",
            )  # fmt: skip
        ax.plot(data[:, 0], ".", ms=2.5, color="black", label="estimate")
        ax.axhline(true, color=PUMP, lw=1.3, label=f"truth {true:g}")
        ax.set_ylabel(label)
        ax.set_xlabel("simulated recording, sorted by estimate")
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.32 * (high - low))
        ax.legend(loc="upper left")
    return figure
