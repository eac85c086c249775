"""The page of a benchmark: the paper's Table 2 beside this run's, all plants, and where the learned policy loses."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

from conf import guests
from experiments.comparison import statistics as of
from experiments.comparison.config import TABLE_2
from experiments.comparison.statistics import Row, RowColumn, ScoreColumns, Summary
from experiments.reporting.page import Page, provenance
from experiments.reporting.tables import Emphasis, Table, count, number, plus_minus

PUBLISHED = ("dqn", "pi", "mpc")

DENSITY = {
    "error e": "measured OD minus setpoint, once a minute. A sample at the end of a window belongs to this and to the "
    "next window.",
    "ISE and ITAE, T = 1 min": "ISE = (1/T) ∫ e² dt, ITAE = (1/T) ∫ t |e| dt, t in min from the start of the window, "
    "trapezoidal rule. The paper does not state T; its table is consistent only with T = 1 min, the control period.",
    "ISE and ITAE, T = window": "the same integrals divided by the window's length (30 min in Table 2).",
    "settling time": "minutes after which |e| stays within 5 % of the setpoint to the end of the window; median over "
    "replicates. A dash: half of the replicates or more never settle. The paper does not define its band.",
    "steady error": "mean |e| over the last 10 min of a window.",
    "sensor-noise floor": "score of the sensor's error alone (reading minus noise-free reading). A culture exactly on "
    "the setpoint has this score.",
    "oracle": "dynamic programming with each vial's true growth rate, pump, volume and noise-free OD, but without "
    "knowledge of future setpoints. On the plant nominal, no controller that starts a window from the same OD has a "
    "lower ISE; on other plants the oracle shows the benefit of knowing the present state exactly.",
    "noise-free": "the same metrics on the noise-free OD.",
    "interlock": "checks every command between controller and pumps, with the limits of a real bench. After a rejected "
    "reading it allows no dose, whatever the controller.",
    "control effort": "mean change of the pump rate from one decision to the next, µL/s.",
    "paired difference": "one controller's score minus the other's in the same replicate, that is with the same vial, "
    "pump, sensor and noise. 95 % interval: Student's t of the mean over replicates, without correction for the number "
    "of comparisons.",
    "±": "one standard deviation over replicates.",
}
RANKED = {"density": (of.ITAE.mean, "ITAE, OD min²")}
"""Signal -> column and label of the measure that ranks controllers in the summary; a guest adds its own signal."""
OUT_OF_COMPETITION = ("oracle", "optimum")


def name_of(scenario: str, window: str) -> str:
    """Return the displayed name of a window: its temperature, hours or OD."""
    return f"{window} °C" if scenario == "temperature_switch" else window if "h" in window else f"OD {window}"


def _at(rows: Iterable[Row]) -> dict[tuple[str, str], dict[str, Row]]:
    """Group rows: scenario and window -> controller -> row."""
    found: dict[tuple[str, str], dict[str, Row]] = {}
    for row in rows:
        found.setdefault((row.scenario, row[of.WINDOW]), {})[row.controller] = row
    return found


def _lowest(values: Mapping[str, float]) -> str:
    return min(values, key=lambda k: values[k]) if values else "–"


def _mark(text: str, best: bool) -> str:
    return Emphasis(text) if best else text


def beside(summary: Summary) -> list[Row]:
    keys = ("controller", "plant", "scenario", "window")
    return [r for r in summary["rows"] if {k: r.values.get(k) for k in keys} in summary["beside_paper"]]


def _published(cell: tuple[str, str], metric: ScoreColumns) -> dict[str, float]:
    return {p.controller: getattr(p, metric.key) for p in TABLE_2 if (p.scenario, p.window) == cell}


def table_2(rows: Sequence[Row], metric: ScoreColumns) -> Table:
    """Build a table of one metric: the paper's values, and beside them the values of this run.

    Controllers that are not in the paper have further columns. The lowest value of each side is marked, ignoring the
    oracle. The last two columns name the lowest of the paper's three controllers on each side.
    """
    body: list[tuple[str, ...]] = []
    here = (*PUBLISHED, *dict.fromkeys(r.controller for r in rows if r.controller not in PUBLISHED))
    for cell, found in _at(rows).items():
        theirs = _published(cell, metric)
        ours = {c: r[metric.mean] for c, r in found.items() if _runs(r)}
        low_theirs, low_ours = _lowest(theirs), _lowest({c: ours[c] for c in PUBLISHED if c in ours})
        cells = [name_of(*cell)]
        cells += [_mark(number(theirs.get(c), 4), c == low_theirs) for c in PUBLISHED]
        cells += [_mark(_mean_sd(found[c], metric) if c in found else "–", c == _lowest(ours)) for c in here]
        body.append((*cells, low_theirs, low_ours))
    columns = ("window", *(f"{c}, published" for c in PUBLISHED), *(f"{c}, here" for c in here), "lowest published",
               "lowest of the three here")  # fmt: skip
    return Table(
        f"table2_{metric.key}",
        f"Table 2, {metric.name} ({metric.unit}, T = 1 min)",
        columns,
        tuple(body),
        f"Published: real reactors, n = 3. Here: simulation, n = {rows[0][of.N]}, mean ± standard deviation over "
        f"replicates; plants {', '.join(dict.fromkeys(r.plant for r in rows))}. Marked: lowest, without the oracle.",
    )


class Measure(NamedTuple):
    """Table of all controllers on all plants of a scenario; the plants' lowest is marked, except the oracle.

    text: function that formats a row as a cell. note: with fields {n} and {scenario}. ranked_by: column that decides
    the lowest. floor: function that formats the score of the sensor's noise for a last column.
    """

    key: str
    title: str
    text: Callable[[Row], str]
    note: str
    ranked_by: RowColumn[float] | None = None
    floor: Callable[[Row], str] | None = None
    folded: bool = False


def matrix(name: str, measure: Measure, entries: Sequence[Row], note: str, laws_down: bool = False) -> Table:
    """Tabulate a measure, one row per plant and one column per controller. Args: laws_down: the other way round."""
    laws, by, floor = list(dict.fromkeys(e.law for e in entries)), measure.ranked_by, measure.floor
    body = []
    for plant in dict.fromkeys(e.plant for e in entries):
        at = {e.law: e for e in entries if e.plant == plant}
        values = {c: r[by] for c, r in at.items() if by and c != "oracle" and isfinite(r[by])}
        least = min(values.values()) * (1.0 + 1e-9) if len(values) > 1 else -inf
        cells = [plant, *(_mark(measure.text(at[c]), values.get(c, inf) <= least) if c in at else "–" for c in laws)]
        body.append((*cells, floor(at.get("oracle") or next(iter(at.values())))) if floor else tuple(cells))
    columns = ("controller" if laws_down else "plant", *laws, *(("sensor-noise floor",) if floor else ()))
    columns, *rows = zip(columns, *body, strict=True) if laws_down else (columns, *body)
    return Table(name, measure.title, columns, tuple(rows), note)


def _mean_sd(row: Row, metric: ScoreColumns, scale: float = 1.0) -> str:
    return plus_minus(scale * row[metric.mean], scale * row[metric.sd])


def _percent(pair: Row) -> str:
    percent, difference, (low, high) = pair[of.PERCENT], pair[of.DIFFERENCE], pair[of.CI95]
    if not isfinite(percent):
        return number(difference)
    if not isfinite(low) or not difference:
        return f"{percent:+.1f}"
    return f"{percent:+.1f} [{percent / difference * low:+.1f}, {percent / difference * high:+.1f}]"


def of_column(column: RowColumn[float], note: str, folded: bool = False) -> Measure:
    """Return the measure of a column with a title."""
    ranked = column if column.ranked else None
    return Measure(column.key, column.title, lambda row: number(row[column]), note, ranked, folded=folded)


def _of_score(metric: ScoreColumns, scale: float, unit: str) -> Measure:
    return Measure(
        metric.key,
        f"{metric.name} of the measured OD ({unit}, T = 1 min), sum over the windows",
        lambda row: _mean_sd(row, metric, scale),
        "Mean ± standard deviation, n = {n}. Marked: lowest, not counting the oracle.",
        metric.mean,
        lambda row: number(scale * row[metric.floor]),
    )


SCORES = _of_score(of.ISE, 1000.0, "10⁻³ OD² min"), _of_score(of.ITAE, 1.0, "OD min²")
FURTHER = [
    of_column(column, "Mean, n = {n}.", folded=True)
    for column in (of.ITAE.median, of.ISE.clean, of.ITAE.clean, of.CLEAN_STEADY, of.EFFORT, of.MEDIA, of.HELD)
]
ESTIMATES = [of_column(c, "{scenario}; mean, n = {n}.") for c in (of.ERROR, of.GROWTH, of.SUPERVISED, of.ALARM)]


def tables(out: Page, scenario: str, entries: Sequence[Row], *measures: Measure, laws_down: bool = False) -> None:
    """Add one table per measure for a scenario, if there are entries of it."""
    known = [e for e in entries if e.scenario == scenario]
    for m in measures if known else ():
        table = matrix(f"{scenario}_{m.key}", m, known, m.note.format(n=known[0][of.N], scenario=scenario), laws_down)
        out.table(table, folded=f"{m.title}: {scenario}" if m.folded else "")


def every_plant(out: Page, summary: Summary, scenario: str) -> None:
    """Add the tables of a scenario on all plants: scores, paired differences, further measures."""
    out.add("subheading", text=scenario)
    tables(out, scenario, summary["totals"], *SCORES)
    for against, heading in (
        ("oracle", "Distance from the oracle"),
        ("dqn", "Paired difference to the learned policy"),
        ("dqn_adaptive", "Paired difference to the adaptive policy"),
    ):
        for metric in of.METRICS:
            chosen = [p for p in summary["paired_totals"] if (p[of.AGAINST], p[of.METRIC]) == (against, metric.key)]
            note = f"Mean paired difference in % of {against}'s mean, 95 % interval in brackets, n = {{n}}. If "
            note += f"{against}'s mean is 0, the cell has the difference itself."
            title = f"{heading}, {metric.name}, %"
            tables(out, scenario, chosen, Measure(f"{metric.key}_vs_{against}", title, _percent, note, folded=True))
    tables(out, scenario, summary["totals"], *FURTHER)


def all_rows(summary: Summary) -> Table:
    """Build a table of all rows of summary.json with their details."""
    found = zip((r for r in summary["rows"] if r.signal == "density"), summary["details"], strict=True)
    headings, texts = zip(*ALL, strict=True)
    body = tuple(tuple(text(row, more) for text in texts) for row, more in found)
    return Table("rows", "Every controller, plant, scenario and window", headings, body)


def _place(row: Row, _: Row) -> str:
    return f"{row.scenario}, {row.plant}, {row.controller}, {name_of(row.scenario, row[of.WINDOW])}"


def _interval(ci: Sequence[float]) -> str:
    return f"{number(ci[0])} to {number(ci[1])}" if isfinite(ci[0]) else "–"


ALL: tuple[tuple[str, Callable[[Row, Row], str]], ...] = (
    ("scenario, plant, controller, window", _place),
    ("n", lambda row, _: str(row[of.N])),
    ("ISE", lambda row, _: _mean_sd(row, of.ISE)),
    ("95 %", lambda row, _: _interval(row[of.ISE.ci95])),
    ("ITAE", lambda row, _: _mean_sd(row, of.ITAE)),
    ("95 %", lambda row, _: _interval(row[of.ITAE.ci95])),
    ("ISE, T = window", lambda _, more: number(more[of.ISE.per_window])),
    ("ITAE, T = window", lambda _, more: number(more[of.ITAE.per_window])),
    ("settling, min", lambda row, _: number(row[of.SETTLING])),
    ("settled", lambda row, more: f"{more[of.SETTLED]}/{row[of.N]}"),
    ("steady error", lambda row, _: number(row[of.STEADY])),
    ("floor ITAE", lambda _, more: number(more[of.ITAE.floor])),
    ("medium, mL", lambda row, _: number(row[of.MEDIA])),
    ("effort, µL/s", lambda _, more: number(more[of.EFFORT])),
)
"""Columns of the table of all rows."""


def _in_short(out: Page, summary: Summary) -> None:
    """Add the summary: the learned policy beside the paper's, and the lowest controller of each scenario and plant."""
    places: dict[tuple[str, str], dict[str, list[float]]] = {}
    for entry in (*summary["totals"], *(r for r in summary["rows"] if r.signal != "density")):
        cost = entry[RANKED[entry.signal][0]]
        if isfinite(cost) and _runs(entry):
            laws = places.setdefault((entry.scenario, entry.plant), {})
            laws.setdefault(entry.law, []).append(cost)
    unit = dict.fromkeys(RANKED[r.signal][1] for r in summary["rows"])
    items = [f"{scenario} on {plant}: {_first(laws)}" for (scenario, plant), laws in places.items() if len(laws) > 1]
    alone = [] if items or summary["beside_paper"] else [_alone(summary, e) for e in summary["totals"] if _runs(e)]
    learned = summary["beside_paper"] and any(r.controller == "dqn" for r in beside(summary))
    if items or alone or learned:
        out.section("Summary")
    if learned:
        _beside_paper(out, summary)
    if items:
        out.add("verdict", claim=f"Lowest {' and '.join(unit)}, mean of the replicates:", items=items, remark="")
    if alone:
        claim = "Mean ± standard deviation over the replicates, and the score of the sensor's noise alone:"
        out.add("verdict", claim=claim, items=alone, remark="")


def _runs(entry: Row) -> bool:
    return entry.controller not in OUT_OF_COMPETITION


def _alone(summary: Summary, entry: Row) -> str:
    """Return the scores of a controller, of the oracle if it was run, and of the sensor's noise, as text."""
    names = ("oracle", entry.plant, entry.scenario)
    oracle = next((e for e in summary["totals"] if (e.controller, e.plant, e.scenario) == names), None)
    scores = []
    for metric in of.METRICS:
        least = f"oracle {number(oracle[metric.mean])}, " if oracle else ""
        noise = f"({least}noise {number(entry[metric.floor])})"
        scores.append(f"{metric.name} {_mean_sd(entry, metric)} {metric.unit} {noise}")
    return f"{entry.controller}, {entry.scenario} on {entry.plant}: {', '.join(scores)}"


def _first(laws: Mapping[str, Sequence[float]]) -> str:
    """Return the two controllers with the lowest means, as text. Args: laws: controller -> its values."""
    means = {law: sum(values) / len(values) for law, values in laws.items()}
    (law, value), (other, beyond), *_ = sorted(means.items(), key=lambda item: item[1])
    return f"{law} {number(value)}, then {other} {number(beyond)}"


def _beside_paper(out: Page, summary: Summary) -> None:
    """Add the cells in which one of the paper's controllers scores lower here than the learned policy."""
    learned, rows, lost, certain, items = "dqn", _at(beside(summary)), set(), set(), []
    met = {(p.controller, p[of.AGAINST], p.plant, p.scenario, p[of.WINDOW], p[of.METRIC]): p for p in summary["paired"]}
    for ((scenario, window), at), metric in product(rows.items(), of.METRICS):
        values = {c: at[c][metric.mean] for c in (learned, *PUBLISHED[1:]) if c in at}
        cell = f"{name_of(scenario, window)}, {metric.name}"
        for other in sorted((c for c in values if values[c] < values.get(learned, -inf)), key=lambda c: values[c]):
            lost.add(cell)
            items.append(f"{cell}: {learned} {number(values[learned])} loses to {other} {number(values[other])}")
            pair = met.get((other, learned, at[learned].plant, scenario, window, metric.key))
            if pair is not None and isfinite(pair[of.CI95][0]):
                items[-1] += (
                    f"; {other} minus {learned}: {number(pair[of.DIFFERENCE])}, 95 % {_interval(pair[of.CI95])}"
                )
                if pair[of.VERDICT] == "no difference shown":
                    items[-1] += ", which includes 0"
                else:
                    certain.add(cell)
            items[-1] += "."
    claim = f"Here the learned policy (dqn) is lowest in all {2 * len(rows)} cells."
    if lost:
        claim = (
            f"Here the learned policy (dqn) loses {len(lost)} of {2 * len(rows)} cells, {len(certain)} of them "
            "significantly (95 % interval of the paired difference without 0):"
        )
    published = product(of.METRICS, dict.fromkeys((p.scenario, p.window) for p in TABLE_2))
    best = {(metric, cell): _lowest(_published(cell, metric)) for metric, cell in published}
    theirs = [f"{name_of(*cell)} {metric.name} ({c})" for (metric, cell), c in best.items() if c != "dqn"]
    remark = f"In the paper's table the DQN loses {len(theirs)} of 10 cells: {', '.join(theirs)}."
    out.add("verdict", claim=claim, items=items, remark=remark)


def _learning_section(out: Page, summary: Summary, run: Path) -> None:
    first = [f for f in summary["figures"] if f["file"].startswith(("training/", "figures/fig2a"))]
    if not first and not summary["agents"]:
        return
    out.section("Model and learned policy")
    if fitted := summary["calibration"]:
        parts = [
            f"{k} {number(fitted[k]['value'], 4)} (95 % {number(fitted[k]['ci95'][0], 4)} to "
            f"{number(fitted[k]['ci95'][1], 4)}; true {number(fitted[k]['truth'], 4)})"
            for k in ("mu", "tau")
        ]
        out.text(f"Calibration: {', '.join(parts)}; PMSE {number(fitted['pmse_pct'])} %.")
    for name, entry in summary["agents"].items():
        regret = entry["regret_pct"]
        shown = ", ".join(number(r) for r in regret) if isinstance(regret, list) else number(regret)
        out.text(f"{name}: regret against the model's optimum, %, one value per seed: {shown}.")
    for f in first:
        if (run / f["file"]).is_file():
            out.figure(run / f["file"], f["title"], f["caption"])


def _density(out: Page, summary: Summary, run: Path) -> None:
    """Add the sections of the density: the paper's Table 2, the figures, all plants, the estimates."""
    if summary["beside_paper"]:
        out.section("The paper's Table 2 beside this run")
        for metric in of.METRICS:
            out.table(table_2(beside(summary), metric))
    regulated = [r for r in summary["rows"] if (r.controller, r.scenario) == ("dqn", "regulation")]
    rest = [f for f in summary["figures"] if not f["file"].startswith(("training/", "figures/fig2a"))]
    if rest:
        out.section("Figures")
        for row in regulated[:1]:
            out.text(
                f"Settling time from 0.7 to 0.5: {number(row[of.SETTLING])} min (median of {row[of.N]} "
                f"replicates; paper: {summary['paper_settling_min']:g} min on average, start and band not stated)."
            )
        for f in rest:
            out.figure(run / f["file"], f["title"], f["caption"])
    laws: dict[str, set[str]] = {}
    for e in summary["totals"]:
        laws.setdefault(e.scenario, set()).add(e.controller)
    wide = [scenario for scenario, names in laws.items() if len(names) > 4]
    if wide:
        out.section("Every plant")
        out.text(
            "On every plant, model-based controllers and the learned policy use the model of the configuration (env). "
            "The configuration below describes each plant."
        )
        for scenario in wide:
            every_plant(out, summary, scenario)
    estimated = [e for e in summary["totals"] if of.ERROR.key in e.values]
    if estimated:
        out.section("Coverage of the estimates, and decisions of the supervisor")
    for scenario in dict.fromkeys(e.scenario for e in estimated):
        tables(out, scenario, estimated, *ESTIMATES)


class Section(NamedTuple):
    """Part of the page for a signal. title: of the page. add: adds the sections. definitions: term -> its meaning."""

    title: str
    add: Callable[[Page, Summary, Path], None]
    definitions: Mapping[str, str]


SECTIONS = {"density": Section("Turbidostat control: benchmark", _density, DENSITY)}


def of_benchmark(run: Path) -> Page:
    guests.load("experiments.comparison")
    summary = of.read((run / "summary.json").read_text(encoding="utf-8"))
    parts = [SECTIONS[s] for s in dict.fromkeys(r.signal for r in summary["rows"])] or [SECTIONS["density"]]
    out = Page(
        parts[0].title,
        f"{count(summary['loops'], 'closed loop')} of {count(summary['replicates'], 'simulated replicate')}"
        f"{' each' if summary['loops'] > 1 else ''}, seed {summary['seed']}",
    )
    _in_short(out, summary)
    for part in parts:
        part.add(out, summary, run)
    _learning_section(out, summary, run)
    out.section("Definitions")
    out.add("definitions", pairs=[pair for part in parts for pair in part.definitions.items()])
    if summary["details"]:
        out.section("All numbers")
        out.table(all_rows(summary), folded=f"{count(len(summary['details']), 'row')}; also in tables/rows.csv")
    out.section("Command and configuration")
    provenance(out, run)
    return out
