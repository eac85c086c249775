"""Figures of a calibration (measurement and model, drift, coverage), and of the comparison of a run with its model."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from envs.identification.agreement import Agreement, Compared
from envs.identification.drift import Segment
from envs.identification.model import Parameter
from envs.identification.screening import Series
from envs.identification.twin import Twin
from envs.identification.verdict import Calibration
from experiments.reporting.charts import COLOURS, Array, new_figure

DATA, MODEL, PUMP, REJECTED, UNUSED = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[3], "#a9b4bf"
ESTIMATOR, MARK = PUMP, REJECTED


def fit_figure(raw: Series, result: Calibration, title: str) -> Figure:
    """Draw three charts: measured OD with the fitted model, the model's errors, and the pump rate.

    For method prediction_error it draws one-step predictions and innovations; a dashed line shows the free run of the
    same pair. For method free_run it draws a simulation that uses no readings after the start, and its residuals.
    Args: raw: the recording before screening, with the same rows as in `result`. result: as `calibrate` returns.
    """
    figure, axes = new_figure(11.0, 7.2, 3, sharex=True, height_ratios=(3.0, 1.3, 0.8))
    top, middle, bottom = axes
    _measured(top, raw, result)
    a, b = result.window
    hours = raw.time[a:b] / 60
    found = result.estimate if result.method == "prediction_error" else None
    free = f"free run of this pair, PMSE {result.pair_pmse_pct:.2g} %"
    if found is None:
        top.plot(hours, result.model, color=MODEL, lw=1.8, label=_model_label(result))
        residual = result.inside.od - result.model
        middle.axhline(0.0, color="0.6", lw=0.8)
        middle.plot(hours, residual, ".", ms=3, color=DATA)
        middle.set_ylabel("measured\nminus model, OD")
        middle.set_title(f"residuals of the free run: rms {np.sqrt(np.nanmean(residual**2)):.4f} OD")
    else:
        top.plot(hours, result.model, color="0.35", lw=1.0, ls="--", label=free)
        top.plot(hours, found.expected, color=MODEL, lw=1.2, label=_model_label(result))
        _innovations(middle, hours, found.innovation, found.quality.autocorrelation)
    top.set_title(title)
    top.set_ylabel("OD")
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    bottom.step(raw.time / 60, 1000.0 * raw.pump_rate, where="post", color=PUMP, lw=1.2)
    bottom.set_ylabel("pump rate,\nµL/s")
    bottom.set_xlabel("time, h")
    for ax in axes:
        ax.margins(x=0.01)
    return figure


def _innovations(ax: Axes, hours: Array, innovation: Array, correlation: float) -> None:
    """Draw innovations in predicted standard deviations; for a correct model 95 % lie in the shaded band."""
    ax.axhspan(-1.96, 1.96, color=MODEL, alpha=0.08, lw=0)
    ax.axhline(0.0, color="0.6", lw=0.8)
    ax.plot(hours, innovation, ".", ms=3, color=DATA)
    ax.set_ylabel("innovation,\npredicted sd")
    inside = 100.0 * float(np.mean(np.abs(innovation[np.isfinite(innovation)]) < 1.96))
    ax.set_title(
        f"one-step innovations: {inside:.0f} % in the 95 % band, correlation of consecutive rows {correlation:.2f}"
    )


def _model_label(result: Calibration) -> str:
    mu, tau = result.mu, result.tau
    what = "one step ahead" if result.method == "prediction_error" else "free run"
    return f"{what}: µ = {mu.value:.5f} ± {mu.half_width:.5f} /min, τ = {tau.value:.3f} ± {tau.half_width:.3f}"


def _measured(axes: Axes, raw: Series, result: Calibration) -> None:
    """Draw used and rejected readings; a triangle on the upper edge marks a rejected reading beyond the scale."""
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
    """Draw mu and tau over time: the estimate of each segment, and the returned pair over its window."""
    figure, axes = new_figure(9.5, 6.2, 2, sharex=True)
    time = result.screened.series.time / 60
    a, b = result.window
    rows = (
        ("growth rate µ, 1/min", [s.mu for s in result.segments], result.mu, result.drift_mu),
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
    axes[1].set_xlim(time[0] - 0.01 * np.ptp(time), time[-1] + 0.01 * np.ptp(time))
    at, row = (np.concatenate([2 * v[:1] - v[-1:], v, 2 * v[-1:] - v[:1]]) for v in (time, result.screened.series.row))
    ways = (lambda hour: np.interp(hour, at, row)), (lambda number: np.interp(number, row, at))
    axes[0].secondary_xaxis("top", functions=ways).set_xlabel("row")
    return figure


def _segments(ax: Axes, time: Array, segments: tuple[Segment, ...], values: list[Parameter | None]) -> list[float]:
    """Draw the segments' estimates and intervals; return the middle time, h, of each segment with an estimate."""
    spans = [(s.middle_min / 60, 0.5 * (time[s.end - 1] - time[s.first])) for s in segments]
    middle, value, low, high = _alone(ax, spans, values)
    if len(middle):
        margin = 0.15 * max(value.max() - value.min(), 0.05 * abs(float(value.mean())))
        down, up = np.median(np.maximum(value - low, 0.0)), np.median(np.maximum(high - value, 0.0))
        least, most = value.min() - 1.1 * down - margin, value.max() + 1.1 * up + margin
        ax.set_ylim(
            least, most + 0.2 * (most - least)
        )  # clip a very wide interval, so that the others stay visible; leave space for the legend
    return [float(m) for m in middle]


def _alone(ax: Axes, spans: Sequence[tuple[float, float]], found: Sequence[Parameter | None]) -> Array:
    """Draw the estimates of separately fitted segments; return middle time (h), value, low, high of each, (4, K).

    Args: spans: middle and half length of each segment, h. found: estimate of each segment, or None.
    """
    known = [(*span, p.value, p.low, p.high) for span, p in zip(spans, found, strict=True) if p is not None]
    middle, across, value, low, high = np.array(known).reshape(-1, 5).T
    if known:
        down, up = np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)
        style: dict[str, Any] = {"ms": 5, "color": DATA, "elinewidth": 1.1, "capsize": 2.5}
        ax.errorbar(middle, value, [down, up], across, "o", label="segment alone, 95 % interval", **style)
    else:
        ax.text(0.5, 0.5, "not identifiable in any segment", transform=ax.transAxes, ha="center", color="0.4")
    return np.array([middle, value, low, high])


def coverage_figure(mu: Array, tau: Array, truth: tuple[Array, Array], title: str) -> Figure:
    """Draw 95 % intervals of N simulated recordings, sorted by estimate; colour marks intervals without the true value.

    Args: mu, tau: (value, low, high) of each recording, shape (N, 3). truth: true mu and true tau, shape (N,) each.
    """
    figure, axes = new_figure(10.5, 4.6, 1, 2)
    figure.suptitle(title, fontsize=10)
    names = (("growth rate µ / true value", mu, truth[0]), ("dilution constant τ / true value", tau, truth[1]))
    for ax, (label, data, true) in zip(axes, names, strict=True):
        data = data / true[:, None]
        data = data[np.argsort(data[:, 0])]
        hit = (data[:, 1] <= 1.0) & (data[:, 2] >= 1.0)
        for mask, colour, name in ((hit, DATA, "with true value"), (~hit, MODEL, "without true value")):
            ax.vlines(
                np.flatnonzero(mask), data[mask, 1], data[mask, 2], color=colour, lw=1.0,
                label=f"95 % interval {name}: {mask.sum()} of {len(mask)}",
            )  # fmt: skip
        ax.plot(data[:, 0], ".", ms=2.5, color="black", label="estimate")
        ax.axhline(1.0, color=PUMP, lw=1.3, label="true value")
        ax.set_ylabel(label)
        ax.set_xlabel("simulated recording, sorted by estimate")
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.32 * (high - low))
        ax.legend(loc="upper left")
    return figure


def twin_figure(raw: Series, result: Calibration, behind: Twin, title: str) -> Figure:
    """Draw three charts over time: mu and tau of the twin with 95 % bands, and the readings that were not rejected.

    Args: raw, result: as in `fit_figure`. behind: the twin.
    """
    figure, axes = new_figure(9.5, 7.2, 3, sharex=True, height_ratios=(1.2, 1.2, 1.0))
    clean, (a, b) = result.screened.series, result.window
    start = clean.time[np.searchsorted(clean.row, behind.rows[0])]
    hours = (behind.knot_min + start) / 60
    rows = (
        ("growth rate µ, 1/min", behind.mu, [s.mu for s in result.segments], result.mu),
        ("dilution constant τ", behind.tau, [s.tau for s in result.segments], result.tau),
    )
    for ax, (label, course, values, pair) in zip(axes, rows, strict=False):
        ax.fill_between(hours, course.low, course.high, color=MODEL, alpha=0.18, lw=0, label="twin's 95 % band")
        ax.plot(hours, course.value, "o-", ms=4, color=MODEL, lw=1.6, label="twin")
        ax.plot(raw.time[[a, b - 1]] / 60, [pair.value] * 2, color="0.35", lw=1.0, ls="--", label="returned pair")
        known = [(s.middle_min / 60, v.value) for s, v in zip(result.segments, values, strict=True) if v is not None]
        if known:
            ax.plot(*zip(*known, strict=True), "s", ms=4, color=DATA, mfc="none", label="segment alone")
        ax.set_ylim(0.0, 1.3 * max(float(course.high.max()), *(v for _, v in known), 0.0))
        ax.set_ylabel(label)
        ax.legend(loc="upper left", ncols=4)
    noise = behind.noise
    axes[0].set_title(title)
    axes[2].plot(clean.time / 60, clean.od, ".", ms=2.5, color=DATA)
    axes[2].set_ylabel("OD")
    axes[2].set_xlabel("time, h")
    axes[2].set_title(
        f"reading: sd hypot({noise.floor:.4f}, {100 * noise.relative:.1f} % of OD), correlation {noise.lag1:.2f}; "
        f"doses spread {100 * noise.dose_cv:.0f} %; outliers {100 * noise.outlier_rate:.2f} %"
    )
    return figure


def agreement_figure(found: Agreement, estimator: Mapping[str, Array], supervised: Array, title: str) -> Figure:
    """Compare a recording with its model in three charts: growth rate, pump gain, and errors of one-step predictions.

    Args: estimator: the controller's estimates, (K,): `minute`; `mu` (1/min) and `gain`, where it estimates them.
      supervised: minutes at which the supervisor acted, (S,).
    """
    figure, axes = new_figure(9.5, 7.4, 3, sharex=True, height_ratios=(1.2, 1.2, 1.0))
    top, middle, bottom = axes
    _compared(top, found.growth, "growth rate µ, 1/min")
    net = [
        None if p is None else (p.low + found.growth.expected, p.high + found.growth.expected) for p in found.net.found
    ]
    for first, end, band in zip(found.net.first_min, found.net.end_min, net, strict=True):
        if band is not None:
            label = "if the pump gain is 1" if first == found.net.first_min[0] else None
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
        f"error of one-step predictions: rms {found.rms:.4f} OD, {found.attainable:.4f} with the correct net growth"
    )
    bottom.set_xlabel("time, h")
    return figure


def _compared(ax: Axes, c: Compared, label: str) -> None:
    """Draw a parameter's estimate and interval in each segment, and the model's value as a line."""
    ax.axhline(c.expected, color="black", lw=1.0, ls="--", label="model")
    spans = [((a + b) / 120, (b - a) / 120) for a, b in zip(c.first_min, c.end_min, strict=True)]
    middle, value, low, high = _alone(ax, spans, c.found)
    if len(middle):
        ends = np.append(value, c.expected)
        spread = max(1.5 * float(np.ptp(ends)), 2.0 * float(np.median(high - low)), 0.1 * c.expected)
        ax.set_ylim(max(ends.mean() - spread, 0.0), ends.mean() + spread)  # clip very wide intervals
    ax.set_ylabel(label)
