"""The page of a benchmark: the paper's Table 2 beside this run's, all plants, and where the learned policy loses."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from conf import guests
from experiments.comparison.config import TABLE_2
from experiments.reporting.page import Page, provenance
from experiments.reporting.tables import Emphasis, Table, count, number, plus_minus

Row = Mapping[str, Any]
METRICS = ("ise", "itae")
PUBLISHED = ("dqn", "pi", "mpc")
UNITS = {"ise": "OD² min", "itae": "OD min²"}

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
RANKED = {"density": ("itae_mean", "ITAE, OD min²")}
"""Signal -> key and label of the measure that ranks controllers in the page's summary; a guest adds its own signal."""
OUT_OF_COMPETITION = ("oracle", "optimum")


def law_of(entry: Row) -> str:
    """Return the displayed name of an entry's controller."""
    return f"{entry['controller']}, with preview" if entry.get("preview") else str(entry["controller"])


def name_of(scenario: str, window: str) -> str:
    """Return the displayed name of a window: its temperature, hours or OD."""
    return f"{window} °C" if scenario == "temperature_switch" else window if "h" in window else f"OD {window}"


def _find(entries: Sequence[Row], **wanted: str) -> Row | None:
    return next((e for e in entries if all(e[k] == v for k, v in wanted.items())), None)


def _windows(rows: Sequence[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((r["scenario"], r["window"]) for r in rows))


def _lowest(values: Mapping[str, float]) -> str:
    return min(values, key=lambda k: values[k]) if values else "–"


def _mark(text: str, best: bool) -> str:
    return Emphasis(text) if best else text


def beside(summary: Row) -> list[Row]:
    keys = ("controller", "plant", "scenario", "window")
    chosen = [[b[k] for k in keys] for b in summary["beside_paper"]]
    return [r for r in summary["rows"] if [r[k] for k in keys] in chosen]


def table_2(rows: Sequence[Row], metric: str) -> Table:
    """Build a table of one metric: the paper's values, and beside them the values of this run.

    Controllers that are not in the paper have further columns. The lowest value of each side is marked, ignoring the
    oracle. The last two columns name the lowest of the paper's three controllers on each side.
    """
    body: list[tuple[str, ...]] = []
    others = [c for c in dict.fromkeys(str(r["controller"]) for r in rows) if c not in PUBLISHED]
    for scenario, window in _windows(rows):
        theirs = {
            p.controller: float(getattr(p, metric)) for p in TABLE_2 if (p.scenario, p.window) == (scenario, window)
        }
        found = {c: _find(rows, controller=c, scenario=scenario, window=window) for c in (*PUBLISHED, *others)}
        ours = {c: float(r[f"{metric}_mean"]) for c, r in found.items() if r is not None and _runs(r)}
        low_theirs, low_ours = _lowest(theirs), _lowest({c: v for c, v in ours.items() if c in PUBLISHED})
        cells = [name_of(scenario, window)]
        cells += [_mark(number(theirs.get(c), 4), c == low_theirs) for c in PUBLISHED]
        for c, r in found.items():
            text = "–" if r is None else plus_minus(r[f"{metric}_mean"], r[f"{metric}_sd"])
            cells.append(_mark(text, c == _lowest(ours)))
        body.append((*cells, low_theirs, low_ours))
    columns = ("window", *(f"{c}, published" for c in PUBLISHED), *(f"{c}, here" for c in (*PUBLISHED, *others)),
               "lowest published", "lowest of the three here")  # fmt: skip
    n = rows[0]["n"]
    return Table(
        f"table2_{metric}",
        f"Table 2, {metric.upper()} ({UNITS[metric]}, T = 1 min)",
        columns,
        tuple(body),
        f"Published: real reactors, n = 3. Here: simulation, n = {n}, mean ± standard deviation over replicates; "
        "plants " + ", ".join(dict.fromkeys(str(r["plant"]) for r in rows)) + ". Marked: lowest, without the oracle.",
    )


class Loss(NamedTuple):
    """Cell of the table in which one of the paper's controllers scores lower than the learned policy."""

    cell: str
    certain: bool  # the 95 % interval of the paired difference excludes 0
    sentence: str


def losses(rows: Sequence[Row], paired: Sequence[Row], learned: str = "dqn") -> list[Loss]:
    """List the paper's controllers that score lower here than the learned policy, cell by cell, the lowest first."""
    found = []
    for scenario, window in _windows(rows):
        for metric in METRICS:
            at = {c: _find(rows, controller=c, scenario=scenario, window=window) for c in (learned, *PUBLISHED[1:])}
            values = {c: float(r[f"{metric}_mean"]) for c, r in at.items() if r is not None}
            mine = at[learned]
            if mine is None:
                continue
            cell = f"{name_of(scenario, window)}, {metric.upper()}"
            for other in sorted((c for c in values if values[c] < values[learned]), key=lambda c: values[c]):
                sentence = f"{cell}: {learned} {number(values[learned])} loses to {other} {number(values[other])}"
                pair = _find(paired, controller=other, against=learned, plant=mine["plant"], scenario=scenario,
                             window=window, metric=metric)  # fmt: skip
                certain = False
                if pair is not None and pair["ci95"][0] is not None:
                    low, high = pair["ci95"]
                    certain = pair["verdict"] != "no difference shown"
                    sentence += (
                        f"; {other} minus {learned}: {number(pair['difference'])}, 95 % {number(low)} to {number(high)}"
                        f"{'' if certain else ', which includes 0'}"
                    )
                found.append(Loss(cell, certain, f"{sentence}."))
    return found


def published_losses() -> list[str]:
    """List the cells of the paper's table in which another controller beats the DQN."""
    found = []
    for metric in METRICS:
        for scenario, window in dict.fromkeys((p.scenario, p.window) for p in TABLE_2):
            best = min(
                (p for p in TABLE_2 if (p.scenario, p.window) == (scenario, window)), key=lambda p: getattr(p, metric)
            )
            if best.controller != "dqn":
                found.append(f"{name_of(scenario, window)} {metric.upper()} ({best.controller})")
    return found


def matrix(
    name: str,
    title: str,
    entries: Sequence[Row],
    text: Callable[[Row], str],
    note: str,
    ranked_by: str | None = None,
    floor: Callable[[Row], str] | None = None,
    laws_down: bool = False,
) -> Table:
    """Tabulate entries, one row per plant and one column per controller; mark each plant's lowest, except the oracle.

    Args: text: function that formats an entry as a cell. ranked_by: key that decides the lowest. floor: function that
      formats the score of the sensor's noise for a last column. laws_down: one row per controller, a column per plant.
    """
    laws = list(dict.fromkeys(map(law_of, entries)))
    body = []
    for plant in dict.fromkeys(str(e["plant"]) for e in entries):
        at = {law_of(e): e for e in entries if e["plant"] == plant}
        values = {c: r[ranked_by] for c, r in at.items() if ranked_by and c != "oracle" and r[ranked_by] is not None}
        least = min(values.values()) * (1.0 + 1e-9) if len(values) > 1 else float("-inf")
        cells = [plant]
        cells += [_mark(text(at[c]), values.get(c, float("inf")) <= least) if c in at else "–" for c in laws]
        if floor is not None:
            cells.append(floor(at.get("oracle") or next(iter(at.values()))))
        body.append(tuple(cells))
    columns = ("plant", *laws, *(("sensor-noise floor",) if floor else ()))
    if laws_down:
        (_, *columns_), *rows = zip(columns, *body, strict=True)
        return Table(name, title, ("controller", *columns_), tuple(rows), note)
    return Table(name, title, columns, tuple(body), note)


def _mean_sd(row: Row, metric: str, scale: float) -> str:
    sd = row[f"{metric}_sd"]
    return plus_minus(scale * row[f"{metric}_mean"], None if sd is None else scale * sd)


def scaled(row: Row, key: str, scale: float = 1.0) -> str:
    """Format a value of a row, multiplied by `scale`; a dash for an unknown value."""
    return number(None if row[key] is None else scale * row[key])


def _percent(pair: Row) -> str:
    low, high = pair["ci95"]
    if pair["percent"] is None:
        return number(pair["difference"])
    if low is None or not pair["difference"]:
        return f"{pair['percent']:+.1f}"
    scale = pair["percent"] / pair["difference"]
    return f"{pair['percent']:+.1f} [{scale * low:+.1f}, {scale * high:+.1f}]"


class Measure(NamedTuple):
    """Table of all controllers on all plants of a scenario. Attributes as in `matrix`; `note` has a field {n}."""

    key: str
    title: str
    text: Callable[[Row], str]
    note: str
    ranked_by: str | None = None
    floor: Callable[[Row], str] | None = None
    folded: bool = False


SCORES = [
    Measure(
        metric,
        f"{metric.upper()} of the measured OD ({unit}, T = 1 min), sum over the windows",
        partial(_mean_sd, metric=metric, scale=scale),
        "Mean ± standard deviation, n = {n}. Marked: lowest, not counting the oracle.",
        f"{metric}_mean",
        partial(scaled, key=f"floor_{metric}", scale=scale),
    )
    for metric, scale, unit in (("ise", 1000.0, "10⁻³ OD² min"), ("itae", 1.0, "OD min²"))
]
FURTHER = [
    Measure(key, title, partial(scaled, key=key), "Mean, n = {n}.", key if ranked else None, folded=True)
    for key, title, ranked in (
        ("itae_median", "ITAE of the measured OD (OD min²), sum over the windows, median over vials", True),
        ("clean_ise", "ISE of the noise-free OD (OD² min), sum over the windows", True),
        ("clean_itae", "ITAE of the noise-free OD (OD min²), sum over the windows", True),
        ("clean_steady_abs_error", "Steady error of the noise-free OD", True),
        ("effort_ul_s", "Control effort (µL/s per decision)", False),
        ("media_ml", "Fresh medium used (mL per vial)", False),
        ("held", "Samples after which the interlock allowed no dose, per vial", False),
    )
]
ESTIMATES = [
    Measure(key, title, partial(scaled, key=key), "{scenario}; mean, n = {n}.")
    for key, title in (
        ("error_2sd_pct", "Decisions with the true error e within 2 sd of its estimate, %"),
        ("share_2sd_pct", "Decisions with the true growth share s within 2 sd of its estimate, %"),
        ("supervised_pct", "Decisions by the supervisor's controller, %"),
        ("alarm_pct", "Decisions by the supervisor's controller because of innovations, %"),
    )
]


def tables(out: Page, scenario: str, entries: Sequence[Row], *measures: Measure, laws_down: bool = False) -> None:
    """Add one table per measure for a scenario, if there are entries of it."""
    known = [e for e in entries if e["scenario"] == scenario]
    for m in measures if known else ():
        note = m.note.format(n=known[0]["n"], scenario=scenario)
        table = matrix(f"{scenario}_{m.key}", m.title, known, m.text, note, m.ranked_by, m.floor, laws_down)
        out.table(table, folded=f"{m.title}: {scenario}" if m.folded else "")


def every_plant(out: Page, summary: Row, scenario: str) -> None:
    """Add the tables of a scenario on all plants: scores, paired differences, further measures."""
    out.add("subheading", text=scenario)
    tables(out, scenario, summary["totals"], *SCORES)
    for against, heading in (
        ("oracle", "Distance from the oracle"),
        ("dqn", "Paired difference to the learned policy"),
        ("dqn_adaptive", "Paired difference to the adaptive policy"),
    ):
        for metric in METRICS:
            chosen = [p for p in summary["paired_totals"] if p["against"] == against and p["metric"] == metric]
            note = f"Mean paired difference in % of {against}'s mean, 95 % interval in brackets, n = {{n}}. If "
            note += f"{against}'s mean is 0, the cell has the difference itself."
            title = f"{heading}, {metric.upper()}, %"
            tables(out, scenario, chosen, Measure(f"{metric}_vs_{against}", title, _percent, note, folded=True))
    tables(out, scenario, summary["totals"], *FURTHER)


def estimates(out: Page, summary: Row, scenario: str) -> None:
    """Add tables of the estimates' coverage and the supervisor's decisions in a scenario, on all plants."""
    tables(out, scenario, [e for e in summary["totals"] if ESTIMATES[0].key in e], *ESTIMATES)


def all_rows(summary: Row) -> Table:
    """Build a table of all rows of summary.json with their details."""
    body = []
    for row, more in zip(summary["rows"], summary["details"], strict=True):
        body.append(
            (
                f"{row['scenario']}, {row['plant']}, {row['controller']}, {name_of(row['scenario'], row['window'])}",
                str(row["n"]),
                plus_minus(row["ise_mean"], row["ise_sd"]),
                _interval(row["ise_ci95"]),
                plus_minus(row["itae_mean"], row["itae_sd"]),
                _interval(row["itae_ci95"]),
                number(more["ise_per_window"]),
                number(more["itae_per_window"]),
                number(row["settling_min"]),
                f"{more['settled']}/{row['n']}",
                number(row["steady_abs_error"]),
                number(more["floor_itae"]),
                number(row["media_ml"]),
                number(more["effort_ul_s"]),
            )
        )
    columns = ("scenario, plant, controller, window", "n", "ISE", "95 %", "ITAE", "95 %", "ISE, T = window",
               "ITAE, T = window", "settling, min", "settled", "steady error", "floor ITAE", "medium, mL",
               "effort, µL/s")  # fmt: skip
    return Table("rows", "Every controller, plant, scenario and window", columns, tuple(body))


def _interval(ci: Sequence[float | None]) -> str:
    return "–" if ci[0] is None else f"{number(ci[0])} to {number(ci[1])}"


def _in_short(out: Page, summary: Row) -> None:
    """Add the summary: the learned policy beside the paper's, and the lowest controller of each scenario and plant."""
    places: dict[tuple[str, str], dict[str, list[float]]] = {}
    for entry in (*summary["totals"], *(r for r in summary["rows"] if r["signal"] != "density")):
        key, _ = RANKED[str(entry["signal"])]
        if entry.get(key) is not None and _runs(entry):
            laws = places.setdefault((entry["scenario"], entry["plant"]), {})
            laws.setdefault(law_of(entry), []).append(float(entry[key]))
    unit = dict.fromkeys(RANKED[s][1] for s in dict.fromkeys(str(r["signal"]) for r in summary["rows"]))
    items = [f"{scenario} on {plant}: {_first(laws)}" for (scenario, plant), laws in places.items() if len(laws) > 1]
    alone = [] if items or summary["beside_paper"] else [_alone(summary, e) for e in summary["totals"] if _runs(e)]
    learned = summary["beside_paper"] and _find(beside(summary), controller="dqn")
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
    return entry["controller"] not in OUT_OF_COMPETITION


def _alone(summary: Row, entry: Row) -> str:
    """Return the scores of a controller, of the oracle if it was run, and of the sensor's noise, as text."""
    oracle = _find(summary["totals"], controller="oracle", plant=entry["plant"], scenario=entry["scenario"])
    scores = []
    for metric in METRICS:
        least = f"oracle {number(oracle[f'{metric}_mean'])}, " if oracle else ""
        own = plus_minus(entry[f"{metric}_mean"], entry[f"{metric}_sd"])
        scores.append(f"{metric.upper()} {own} {UNITS[metric]} ({least}noise {number(entry[f'floor_{metric}'])})")
    return f"{entry['controller']}, {entry['scenario']} on {entry['plant']}: {', '.join(scores)}"


def _first(laws: Mapping[str, Sequence[float]]) -> str:
    """Return the two controllers with the lowest means, as text. Args: laws: controller -> its values."""
    means = {law: sum(values) / len(values) for law, values in laws.items()}
    (law, value), (other, beyond), *_ = sorted(means.items(), key=lambda item: item[1])
    return f"{law} {number(value)}, then {other} {number(beyond)}"


def _beside_paper(out: Page, summary: Row) -> None:
    rows = beside(summary)
    lost, cells = losses(rows, summary["paired"]), 2 * len(_windows(rows))
    cells_lost = len({loss.cell for loss in lost})
    certain = len({loss.cell for loss in lost if loss.certain})
    if lost:
        claim = (
            f"Here the learned policy (dqn) loses {cells_lost} of {cells} cells, {certain} of them significantly "
            "(95 % interval of the paired difference without 0):"
        )
    else:
        claim = f"Here the learned policy (dqn) is lowest in all {cells} cells."
    theirs = published_losses()
    remark = f"In the paper's table the DQN loses {len(theirs)} of 10 cells: {', '.join(theirs)}."
    out.add("verdict", claim=claim, items=[loss.sentence for loss in lost], remark=remark)


def _learning_section(out: Page, summary: Row, run: Path) -> None:
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


def _density(out: Page, summary: Row, run: Path) -> None:
    """Add the sections of the density: the paper's Table 2, the figures, all plants, the estimates."""
    if summary["beside_paper"]:
        out.section("The paper's Table 2 beside this run")
        for metric in METRICS:
            out.table(table_2(beside(summary), metric))
    regulated = _find(summary["rows"], controller="dqn", scenario="regulation")
    rest = [f for f in summary["figures"] if not f["file"].startswith(("training/", "figures/fig2a"))]
    if rest:
        out.section("Figures")
        if regulated is not None:
            out.text(
                f"Settling time from 0.7 to 0.5: {number(regulated['settling_min'])} min (median of {regulated['n']} "
                f"replicates; paper: {summary['paper_settling_min']:g} min on average, start and band not stated)."
            )
        for f in rest:
            out.figure(run / f["file"], f["title"], f["caption"])
    wide = [
        s
        for s in dict.fromkeys(e["scenario"] for e in summary["totals"])
        if len({e["controller"] for e in summary["totals"] if e["scenario"] == s}) > 4
    ]
    if wide:
        out.section("Every plant")
        out.text(
            "On every plant, model-based controllers and the learned policy use the model of the configuration (env). "
            "The configuration below describes each plant."
        )
        for scenario in wide:
            every_plant(out, summary, scenario)
    estimated = dict.fromkeys(e["scenario"] for e in summary["totals"] if ESTIMATES[0].key in e)
    if estimated:
        out.section("Coverage of the estimates, and decisions of the supervisor")
        for scenario in estimated:
            estimates(out, summary, scenario)


class Section(NamedTuple):
    """Part of the page for a signal. title: of the page. add: adds the sections. definitions: term -> its meaning."""

    title: str
    add: Callable[[Page, Row, Path], None]
    definitions: Mapping[str, str]


SECTIONS = {
    "density": Section("Turbidostat control: benchmark", _density, DENSITY),
}


def of_benchmark(run: Path) -> Page:
    guests.load("experiments.comparison")
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    parts = [SECTIONS[s] for s in dict.fromkeys(r["signal"] for r in summary["rows"])] or [SECTIONS["density"]]
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
