"""Figures and page of a comparison of the composition."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.comparison.composition_trials import CompositionTrial
from experiments.reporting import charts
from experiments.reporting.charts import COLOURS, new_figure
from experiments.reporting.page import Page, provenance
from experiments.reporting.tables import Best, Table, number

__all__ = ["draw", "of_composition", "shares", "whole"]

Array = NDArray[np.float64]
Row = Mapping[str, Any]

STEP = 5  # minutes between the points of a curve
SHOWN = ("pi", "proportional", "dqn", "midpoint", "dqn_preview", "optimum")  # where there are more than so many laws

DEFINITIONS = {
    "error": "mean over the scenario of |r - setpoint|, r the true share of P. putida, wherever a share is asked for.",
    "told ahead": "changes of the setpoint are announced, as early as the scenario's announce_min; `optimum` knows the "
    "whole program in either case.",
    "calibrated": "the estimator knows each reactor's factor and offset of the light sensor, with errors of 2 % and "
    "5 counts; otherwise it begins from the mean of 17 real reactors.",
    "paired": "law minus the vendor's PI, reactor by reactor: both meet the same vials, sensors and noise.",
    "band covers": "share of all minutes in which the true share lies within the estimate's 95 % band.",
}


def _label(row: Row) -> str:
    return f"{row['controller']}, told ahead" if row["preview"] else str(row["controller"])


def whole(rows: Sequence[Row], name: str, title: str, text: Callable[[Row], str], ranked: str = "") -> Table:
    """Laws down, plants across; the lowest `ranked` of each plant is marked."""
    plants = list(dict.fromkeys(str(r["plant"]) for r in rows))
    labels = list(dict.fromkeys(_label(r) for r in rows))
    at = {(_label(r), str(r["plant"])): r for r in rows}
    least = {p: min(r[ranked] for r in rows if r["plant"] == p) for p in plants} if ranked else {}
    body = []
    for label in labels:
        cells = [label]
        for plant in plants:
            row = at.get((label, plant))
            shown = "\N{EN DASH}" if row is None else text(row)
            cells.append(Best(shown) if row is not None and ranked and row[ranked] <= least[plant] else shown)
        body.append(tuple(cells))
    return Table(name, title, ("law", *plants), tuple(body), f"n = {rows[0]['n']} reactors each.")


def shares(trials: Sequence[CompositionTrial]) -> Figure:
    """A column per law: true share with the setpoint, and the vials' temperature; median and the middle 90 %."""
    columns = len(trials)
    figure, axes = new_figure(2.7 * columns, 4.6, 2, columns, sharex=True, sharey="row", height_ratios=[2, 1])
    for k, trial in enumerate(trials):
        top, bottom, hours = axes[k], axes[columns + k], trial.minute[::STEP] / 60.0
        for ax, values, colour in ((top, trial.share, COLOURS[0]), (bottom, trial.temperature, COLOURS[1])):
            low, middle, high = np.quantile(values[:, ::STEP], (0.05, 0.5, 0.95), axis=0)
            ax.fill_between(hours, low, high, color=colour, alpha=0.28, linewidth=0)
            ax.plot(hours, middle, color=colour, linewidth=1.2)
        top.plot(hours, trial.setpoint[::STEP], color="black", linewidth=1.0, linestyle="--")
        top.set_title(f"{trial.cell.law}{', told ahead' if trial.foresight else ''}")
        bottom.set_xlabel("hours")
    axes[0].set(ylabel="share of P. putida", ylim=(0.0, 1.0))
    axes[columns].set_ylabel("vial, \N{DEGREE SIGN}C")
    return figure


def _overview(rows: Sequence[Row]) -> Figure:
    """Error of every law on every plant of one scenario: mean and 95 % interval."""
    plants = list(dict.fromkeys(str(r["plant"]) for r in rows))
    labels = list(dict.fromkeys(_label(r) for r in rows))
    figure, (ax,) = new_figure(9.0, 1.6 + 0.55 * len(plants))
    for k, label in enumerate(labels):
        chosen = [r for r in rows if _label(r) == label]
        y = [plants.index(str(r["plant"])) + 0.7 * ((k + 0.5) / len(labels) - 0.5) for r in chosen]
        colour, marker = COLOURS[k % len(COLOURS)], "o" if k < len(COLOURS) else "D"
        ax.plot([r["ratio_abs_error_mean"] for r in chosen], y, marker, color=colour, markersize=5, label=label)
        for r, height in zip(chosen, y, strict=True):
            ax.plot(r["ci95"], [height, height], color=colour, linewidth=1.3)
    ax.set_yticks(range(len(plants)), plants)
    ax.invert_yaxis()
    ax.set(xlabel="mean |r - setpoint|", xlim=(0.0, None))
    figure.legend(loc="outside upper center", ncols=5)
    return figure


def draw(trials: Sequence[CompositionTrial], rows: Sequence[Row], folder: Path) -> list[dict[str, str]]:
    """Write the figures of every scenario; returns file, title and caption of each."""
    shown = []
    for scenario in dict.fromkeys(t.cell.scenario for t in trials):
        here = [t for t in trials if t.cell.scenario == scenario]
        first = [t for t in here if t.cell.plant == here[0].cell.plant]
        if len(first) > len(SHOWN):
            first = [t for t in first if t.cell.law in SHOWN]
        told = "Line: median over the reactors; band: the middle 90 %; dashed: setpoint."
        for name, figure, title, caption in (
            ("laws", _overview([r for r in rows if r["scenario"] == scenario]), "every law and plant",
             "Mean and 95 % interval over the reactors."),
            ("shares", shares(first), f"shares on {here[0].cell.plant}", told),
        ):  # fmt: skip
            charts.save(figure, folder / "figures", f"composition_{scenario}_{name}")
            file = f"figures/composition_{scenario}_{name}.svg"
            shown.append({"file": file, "title": f"{scenario}: {title}", "caption": caption})
    return shown


def _lower(pair: Row) -> str:
    low, high = pair["ci95"]
    between = "" if low is None or low != low else f" [{low:+.4f}, {high:+.4f}]"
    return f"{pair['difference']:+.4f}{between}, lower in {pair['lower_in']} of {pair['n']}"


def of_composition(run: Path) -> Page:
    """The page of a run folder."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    rows, paired = summary["rows"], summary["paired"]
    loops = f"{len(rows)} closed loops of {summary['replicates']} simulated reactors each, seed {summary['seed']}"
    out = Page("Composition of two species: comparison", loops)
    out.section("What was run")
    provenance(out, run)
    for scenario in dict.fromkeys(str(r["scenario"]) for r in rows):
        here = [r for r in rows if r["scenario"] == scenario]
        out.section(scenario)
        for key, title in (
            ("ratio_abs_error_mean", "Mean |r - setpoint|"),
            ("ratio_abs_error_last2h", "Mean |r - setpoint| in the last 2 h of each window"),
            ("ratio_abs_error_last_day", "Mean |r - setpoint| on the last day"),
        ):
            known = [r for r in here if r[key] is not None]
            if known:
                out.table(whole(known, f"{scenario}_{key}", title, lambda r, k=key: number(r[k]), key))  # type: ignore[misc]
        against = [p for p in paired if p["scenario"] == scenario]
        if against:
            out.table(whole(against, f"{scenario}_paired", "Difference to the vendor's PI", _lower))
        out.table(
            whole(here, f"{scenario}_estimate", "Error of the estimate (rms), and how much its band covers",
                  lambda r: f"{number(r['estimate_rms'])}, {100.0 * r['band_covers']:.0f} %"),
            folded=f"Estimate: {scenario}",
        )  # fmt: skip
        out.table(
            whole(here, f"{scenario}_od", "OD: least, mean, largest",
                  lambda r: f"{r['od_min']:.3f}, {r['od_mean']:.3f}, {r['od_max']:.3f}"),
            folded=f"OD: {scenario}",
        )  # fmt: skip
        for f in (f for f in summary["figures"] if f["title"].startswith(f"{scenario}:")):
            out.figure(run / f["file"], f["title"], f["caption"])
    out.section("Definitions")
    out.add("definitions", pairs=list(DEFINITIONS.items()))
    return out
