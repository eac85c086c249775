"""One page that compares the configurations of a sweep, with its tables as CSV."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.reporting import charts
from experiments.reporting.page import Page
from experiments.reporting.sweep_results import (
    MERIT,
    Array,
    Configuration,
    Result,
    configurations,
    curve,
    label,
    number_or_text,
    statistics,
)  # fmt: skip
from experiments.reporting.tables import Emphasis, Table, interquartile_mean, number

LONG = 40  # a name of this many characters or more is replaced by its row number in figures
DRAWN = 8  # most configurations in a figure, one per colour; the table has all
SHOWN = 4  # most measures on the page
STATISTICS = ("n", "median", "IQM", "95 % of IQM", "worst")


def repeats(command: str, one: Configuration) -> str:
    """Return the command that repeats all runs (seeds) of a configuration."""
    first = dict(one.jobs[0].overrides)
    for key in first:
        several = list(dict.fromkeys(job.overrides[key] for job in one.jobs if key in job.overrides))
        if len(several) > 1:
            first[key] = ",".join(several)
    sweep = ["-m"] if any("," in value and not value.startswith("[") for value in first.values()) else []
    return shlex.join(["python", "-m", f"experiments.{command}", *sweep, *(f"{k}={v}" for k, v in first.items())])


def _measures(ranked: Sequence[Configuration]) -> list[str]:
    return list(dict.fromkeys(name for one in ranked for name in one.measured))[:SHOWN]


def _cells(one: Configuration, name: str) -> list[str]:
    if name not in one.measured:
        return ["–"] * len(STATISTICS)
    s = statistics(one.measured[name])
    interval = "–" if s.n < 2 else f"{number(s.interval[0])} to {number(s.interval[1])}"
    return [str(s.n), number(s.median), number(s.iqm), interval, number(s.worst)]


def _row(place: int, one: Configuration, names: Sequence[str]) -> tuple[str, ...]:
    cells = [f"#{place}", *map(number_or_text, one.values.values()), *(c for name in names for c in _cells(one, name))]
    return tuple(Emphasis(cell) if place == 1 else cell for cell in cells)


def _tables(page: Page, ranked: Sequence[Configuration], called: Callable[[str], str], note: str) -> None:
    """Add one table per measure, and a folded table of all measures, which is also written to configurations.csv."""
    names = _measures(ranked)
    for name in names:
        rows = tuple(_row(k + 1, one, [name]) for k, one in enumerate(ranked))
        columns = ("#", *ranked[0].values, *STATISTICS)
        page.table(Table(f"configurations_{name}", f"Configurations, best first: {called(name)}", columns, rows, note))
    rows = tuple(_row(k + 1, one, names) for k, one in enumerate(ranked))
    columns = ("#", *ranked[0].values, *(f"{name}: {what}" for name in names for what in STATISTICS))
    page.table(Table("configurations", "All measures", columns, rows), folded="All measures in one table")


def _headline(ranked: Sequence[Configuration], jobs: Sequence[Result], called: Callable[[str], str]) -> str:
    done = sum(job.state == "finished" for job in jobs)
    if not ranked or not ranked[0].measured:
        return f"{done} of {len(jobs)} jobs finished, but no result can be compared: none has a number."
    best, name = ranked[0], next(iter(ranked[0].measured))
    s = statistics(best.measured[name])
    what = called(name)
    head = (
        f"Of {len(ranked)} configurations, {best.name} is best"
        if len(ranked) > 1
        else f"One configuration, {best.name}"
    )
    middle = f" (interquartile mean of {s.n} seeds: {number(s.iqm)})" if s.n > 1 else ""
    text = f"{head}. Worst {what}: {number(s.worst)}{middle}"
    if len(ranked) > 1:
        other = statistics(ranked[1].measured[name])
        apart = s.n < 2 or other.n < 2 or s.interval[1] < other.interval[0]
        text += f"; second-best configuration: {number(other.worst)}"
        text += "" if apart else ", no significant difference (their 95 % intervals overlap)"
    if what == MERIT:
        text += f". A score of 1 is the task's limit: {'met' if s.worst <= 1.0 else 'not met'}"
    return f"{text}. {done} of {len(jobs)} jobs finished."


def _missing(page: Page, jobs: Sequence[Result], again: str) -> None:
    left = [job for job in jobs if job.state != "finished"]
    if not left:
        return
    page.section("Jobs without a result")
    rows = tuple(
        (j.folder.name, " ".join(f"{k}={v}" for k, v in j.overrides.items()), j.state, j.error or "–") for j in left
    )
    page.table(Table("missing_jobs", f"{len(left)} of {len(jobs)} jobs", ("job", "overrides", "state", "error"), rows))
    page.text("This command runs only the jobs without a result:")
    page.add("folded_text", heading="Command", text=again)


def _figures(page: Page, folder: Path, ranked: Sequence[Configuration], called: Callable[[str], str]) -> None:
    """Draw the learning curves, if the jobs have them, and then the values of each measure."""
    shown = {one.name if len(one.name) < LONG else f"#{k + 1}": one for k, one in enumerate(ranked[:DRAWN])}
    note = f"The best {DRAWN} of {len(ranked)} configurations." if len(ranked) > DRAWN else ""
    page.section("Figures")
    for tag in ("eval/regret_pct", "eval/steady_abs_error"):
        curves = [(key, *curve(one.jobs, tag)) for key, one in shown.items()]
        curves = [(key, steps, each) for key, steps, each in curves if each.size]
        if curves:
            name = tag.partition("/")[2]
            figure = learning_curves(curves, called(name))
            path = charts.save(figure, folder / "figures", f"learning_{name}").with_suffix(".svg")
            page.figure(path, f"Greedy policy on the selection grid: {called(name)}", note)
    for name in _measures(ranked):
        measured = {key: one.measured[name] for key, one in shown.items() if name in one.measured}
        path = charts.save(values(measured, called(name)), folder / "figures", f"values_{name}")
        page.figure(path.with_suffix(".svg"), f"Every value: {called(name)}", f"{note} Bar: interquartile mean.")


def of_sweep(folder: Path, command: str, jobs: Sequence[Result], again: str) -> Page:
    """Build the page of a sweep.

    Args: command: name of the command that was swept. jobs: all jobs, also those without a result. again: the command
      that runs the missing jobs.
    """
    ranked, common = configurations(jobs)
    task = next((job.task for job in jobs if job.state == "finished"), "density")

    def called(measure: str) -> str:
        return label(measure, task, command)

    page = Page(f"Sweep of {command}", str(folder))
    page.section("Result")
    page.text(_headline(ranked, jobs, called))
    if ranked and ranked[0].measured:
        page.add("keys", pairs=[("best", ranked[0].name), ("command to repeat its runs", repeats(command, ranked[0]))])
        shared = ", ".join(f"{key} = {value}" for key, value in common.items()) or "none"
        note = f"Each row pools its seeds; lower is better. IQM: interquartile mean. Overrides of all jobs: {shared}."
        _tables(page, ranked, called, note)
        _figures(page, folder, ranked, called)
    _missing(page, jobs, again)
    return page


def learning_curves(curves: Sequence[tuple[str, Array, Array]], quantity: str) -> Figure:
    """Draw learning curves in one colour per configuration: interquartile mean over seeds; the worst seed dashed.

    Args: curves: name, steps (K,) and values (K, S) of each configuration. quantity: label of the axis, with unit.
    """
    figure, (ax,) = charts.new_figure(9.0, 4.0 + 0.12 * len(curves))
    for k, (name, steps, each) in enumerate(curves):
        colour, floor = charts.COLOURS[k % len(charts.COLOURS)], np.maximum(each, 1e-4)
        middle, called = [interquartile_mean(row) for row in floor], f"{name} (n = {each.shape[1]})"
        ax.plot(steps, middle, color=colour, linewidth=1.6, label=called)
        ax.plot(steps, np.nanmax(floor, axis=1), color=colour, linewidth=0.9, linestyle="--")
    ax.plot([], [], color="black", linewidth=1.6, label="line: interquartile mean over seeds")
    ax.plot([], [], color="black", linewidth=0.9, linestyle="--", label="dashed: worst seed")
    ax.set(xlabel="environment step", ylabel=quantity, yscale="log")
    charts.plain(ax.yaxis)
    figure.legend(loc="outside lower left", ncols=1 if max(len(c[0]) for c in curves) > 40 else 2)
    return figure


def values(measured: Mapping[str, Array], quantity: str) -> Figure:
    """Draw one row per configuration: a dot per seed or reactor, and a bar at the interquartile mean.

    Args: measured: name -> values (n,), first on top. quantity: label of the axis, with unit.
    """
    figure, (ax,) = charts.new_figure(9.0, 1.2 + 0.3 * len(measured))
    for row, each in enumerate(measured.values()):
        ax.plot(each, np.full(each.size, row), "o", color=charts.COLOURS[0], alpha=0.5, markersize=5, markeredgewidth=0)
        ax.plot([interquartile_mean(each)] * 2, [row - 0.3, row + 0.3], color=charts.COLOURS[1], linewidth=2)
    ax.set(xlabel=quantity, ylim=(len(measured) - 0.4, -0.6))
    every = np.concatenate(list(measured.values()))
    if every.min() > 0.0 and every.max() > 30.0 * every.min():
        ax.set_xscale("log")
        charts.plain(ax.xaxis)
    ax.set_yticks(range(len(measured)), list(measured), fontsize=8)
    return figure
