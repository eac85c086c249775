"""The page of a benchmark: the paper's Table 2 beside the run's, every plant, and what the learned policy loses."""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.comparison.published import TABLE_2, Published
from experiments.report import Page, provenance
from experiments.reporting.tables import Best, Cell, Table, number, plus_minus, typeset

__all__ = ["losses", "page", "table_2"]

Row = Mapping[str, Any]
METRICS = ("ise", "itae")
PUBLISHED = ("dqn", "pi", "mpc")
UNITS = {"ise": "OD² min", "itae": "OD min²"}

DEFINITIONS = {
    "error e": "measured OD minus setpoint, once a minute. A sample at the very end of a window belongs to it and to "
    "the next one.",
    "ISE and ITAE, T = 1 min": "ISE = (1/T) ∫ e² dt, ITAE = (1/T) ∫ t |e| dt, t in min from the start of the window, "
    "trapezoidal rule. The paper leaves T open; T = 1 min, the control period, is the only reading under which its "
    "table is consistent.",
    "ISE and ITAE, T = window": "the same integrals divided by the window's length (30 min in Table 2).",
    "settling time": "minutes after which |e| stays within 5 % of the setpoint to the end of the window; median over "
    "replicates, a dash where half or more never settle. The paper does not define its band.",
    "steady error": "mean |e| over the last 10 min of a window.",
    "sensor-noise floor": "the score of the sensor's own error, reading minus what it would show without noise: what a "
    "culture exactly on the setpoint would be given.",
    "oracle": "dynamic programming on each vial's own growth rate, pump and volume, seeing the OD without noise and "
    "not knowing setpoints ahead. On `nominal` nothing that starts a window from the same OD has a lower ISE; "
    "elsewhere it shows what full knowledge of the present is worth.",
    "noise-free": "the same metrics on the OD that a sensor without noise would have shown.",
    "interlock": "stands between every controller and the pumps, with the limits of a bench; a reading it does not "
    "believe gets no dose, whoever proposed one.",
    "control effort": "mean change of the pump rate from one minute to the next, µL/s.",
    "paired difference": "controller minus the other, replicate by replicate: both meet the same vials, pumps, sensors "
    "and noise. 95 % interval: Student's t of the mean over replicates, without correction for the number of "
    "comparisons.",
    "±": "one standard deviation over replicates.",
}


def name_of(scenario: str, window: str) -> str:
    """A window as a reader knows it."""
    return f"{window} °C" if scenario == "temperature_switch" else window if "h" in window else f"OD {window}"


def _find(entries: Sequence[Row], **wanted: str) -> Row | None:
    return next((e for e in entries if all(e[k] == v for k, v in wanted.items())), None)


def _windows(rows: Sequence[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((r["scenario"], r["window"]) for r in rows))


def _lowest(values: Mapping[str, float]) -> str:
    return min(values, key=lambda k: values[k]) if values else "–"


def _mark(text: str, best: bool) -> Cell:
    return Best(text) if best else text


def beside(summary: Row) -> list[Row]:
    """The rows that stand beside the paper's table."""
    chosen = [tuple(sorted(b.items())) for b in summary["beside_paper"]]
    keys = ("controller", "plant", "scenario", "window")
    return [r for r in summary["rows"] if tuple(sorted((k, r[k]) for k in keys)) in chosen]


def table_2(rows: Sequence[Row], metric: str) -> Table:
    """The paper's table for one metric beside this run's, the lowest of each side marked and named.

    What the paper does not have follows out of competition.
    """
    body: list[tuple[Cell, ...]] = []
    others = [c for c in dict.fromkeys(str(r["controller"]) for r in rows) if c not in PUBLISHED]
    for scenario, window in _windows(rows):
        theirs = {
            p.controller: float(getattr(p, metric)) for p in TABLE_2 if (p.scenario, p.window) == (scenario, window)
        }
        found = {c: _find(rows, controller=c, scenario=scenario, window=window) for c in (*PUBLISHED, *others)}
        ours = {c: float(r[f"{metric}_mean"]) for c, r in found.items() if r is not None and c in PUBLISHED}
        low_theirs, low_ours = _lowest(theirs), _lowest(ours)
        cells: list[Cell] = [name_of(scenario, window)]
        cells += [_mark(number(theirs.get(c), 4), c == low_theirs) for c in PUBLISHED]
        for c, r in found.items():
            text = "–" if r is None else plus_minus(r[f"{metric}_mean"], r[f"{metric}_sd"])
            cells.append(_mark(text, c == low_ours))
        body.append((*cells, low_theirs, low_ours))
    columns = ("window", *(f"{c}, published" for c in PUBLISHED), *(f"{c}, here" for c in (*PUBLISHED, *others)),
               "lowest published", "lowest here")  # fmt: skip
    n = rows[0]["n"]
    return Table(
        f"table2_{metric}",
        f"Table 2, {metric.upper()} ({UNITS[metric]}, T = 1 min)",
        columns,
        tuple(body),
        f"Published: real reactors, n = 3. Here: simulation, n = {n}, mean ± standard deviation over replicates; "
        "plants " + ", ".join(dict.fromkeys(str(r["plant"]) for r in rows)) + ". Marked: lowest of the three.",
    )


def cell_by_cell(rows: Sequence[Row]) -> Table:
    """Published beside ours for each controller, in both conventions, and which is lower."""
    body = []
    for p in TABLE_2:
        row = _find(rows, controller=p.controller, scenario=p.scenario, window=p.window)
        if row is None:
            continue
        cells: list[Cell] = [f"{name_of(p.scenario, p.window)}, {p.controller}"]
        for metric in METRICS:
            published, ours = getattr(p, metric), row[f"{metric}_mean"]
            cells += [f"{number(published, 4)} ({number(published / 30.0)})", f"{number(ours)} ({number(ours / 30.0)})"]
            cells.append("here" if ours < published else "published")
        body.append(tuple(cells))
    columns = ("cell", *(f"{m.upper()}{what}" for m in METRICS for what in (", published", ", here", ", lower")))
    return Table(
        "table2_cells",
        "Table 2 cell by cell: T = 1 min, and in brackets T = window",
        columns,
        tuple(body),
        "T = window: the integrals divided by 30 min. A lower value here means that a simulated culture is held closer "
        "than the published one, not that the controller is better: plant, pump and start are not the paper's.",
    )


def losses(rows: Sequence[Row], paired: Sequence[Row], learned: str = "dqn") -> list[str]:
    """A sentence for every cell in which the learned policy is not the lowest of the published three."""
    found = []
    for scenario, window in _windows(rows):
        for metric in METRICS:
            at = {c: _find(rows, controller=c, scenario=scenario, window=window) for c in (learned, *PUBLISHED[1:])}
            values = {c: float(r[f"{metric}_mean"]) for c, r in at.items() if r is not None}
            mine = at[learned]
            if mine is None or len(values) < 2 or _lowest(values) == learned:
                continue
            for other in sorted((c for c in values if values[c] < values[learned]), key=lambda c: values[c]):
                pair = _find(paired, controller=other, against=learned, plant=mine["plant"], scenario=scenario,
                             window=window, metric=metric)  # fmt: skip
                certainty = ""
                if pair is not None and pair["ci95"][0] is not None:
                    low, high = pair["ci95"]
                    certainty = (
                        f"; {other} minus {learned}: {number(pair['difference'])}, 95 % {number(low)} to {number(high)}"
                        f"{'' if pair['verdict'] != 'no difference shown' else ', which holds 0'}"
                    )
                found.append(
                    f"{name_of(scenario, window)}, {metric.upper()}: {learned} {number(values[learned])} loses to "
                    f"{other} {number(values[other])}{certainty}."
                )
    return found


def published_losses() -> list[str]:
    """The cells of the published table that its DQN loses."""
    found = []
    for metric in METRICS:
        for scenario, window in dict.fromkeys((p.scenario, p.window) for p in TABLE_2):
            cells: dict[str, Published] = {
                p.controller: p for p in TABLE_2 if (p.scenario, p.window) == (scenario, window)
            }
            best = min(cells.values(), key=lambda p: getattr(p, metric))
            if best.controller != "dqn":
                found.append(f"{name_of(scenario, window)} {metric.upper()} ({best.controller})")
    return found


def _matrix(
    name: str, title: str, entries: Sequence[Row], value: Callable[[Row], float | None], text: Callable[[Row], str],
    note: str, floor: str | None = None, lowest: bool = True, scale: float = 1.0,
) -> Table:  # fmt: skip
    """Plants down, controllers across; the lowest of a row is marked, the oracle out of competition."""
    controllers = list(dict.fromkeys(str(e["controller"]) for e in entries))
    body = []
    for plant in dict.fromkeys(str(e["plant"]) for e in entries):
        at = {c: _find(entries, controller=c, plant=plant) for c in controllers}
        values = {c: value(r) for c, r in at.items() if r is not None and c != "oracle"}
        known = {c: v for c, v in values.items() if v is not None}
        least = min(known.values()) if lowest and len(known) > 1 else None
        best = {c for c, v in known.items() if least is not None and v <= least * (1.0 + 1e-9)}
        cells: list[Cell] = [plant, *(_mark("–" if r is None else text(r), c in best) for c, r in at.items())]
        if floor is not None:
            told = at.get("oracle") or next(r for r in at.values() if r is not None)
            cells.append(number(scale * told[floor]))
        body.append(tuple(cells))
    columns = ("plant", *controllers, *(("sensor-noise floor",) if floor else ()))
    return Table(name, title, columns, tuple(body), note)


def _percent(pair: Row) -> str:
    low, high = pair["ci95"]
    if pair["percent"] is None:
        return number(pair["difference"])
    if low is None or not pair["difference"]:
        return f"{pair['percent']:+.1f}"
    scale = pair["percent"] / pair["difference"]
    return f"{pair['percent']:+.1f} [{scale * low:+.1f}, {scale * high:+.1f}]"


def every_plant(out: Page, summary: Row, scenario: str) -> None:
    """Tables of one scenario on every plant."""
    totals = [e for e in summary["totals"] if e["scenario"] == scenario]
    pairs = [e for e in summary["paired_totals"] if e["scenario"] == scenario]
    n = totals[0]["n"]
    out.add(f"<h3>{html.escape(scenario)}</h3>")
    for metric, scale, unit in (("ise", 1000.0, "10⁻³ OD² min"), ("itae", 1.0, "OD min²")):

        def text(r: Row, m: str = metric, k: float = scale) -> str:
            return plus_minus(k * r[f"{m}_mean"], None if r[f"{m}_sd"] is None else k * r[f"{m}_sd"])

        out.table(
            _matrix(
                f"{scenario}_{metric}",
                f"{metric.upper()} of the measured OD ({unit}, T = 1 min), sum over the windows",
                totals, lambda r, m=metric: r[f"{m}_mean"], text,  # type: ignore[misc]
                f"Mean ± standard deviation, n = {n}. Marked: lowest; the oracle is out of competition.",
                f"floor_{metric}", scale=scale,
            )
        )  # fmt: skip
    for against, heading in (
        ("oracle", "Distance from the oracle"),
        ("dqn", "Paired difference to the learned policy"),
    ):
        for metric in METRICS:
            chosen = [p for p in pairs if p["against"] == against and p["metric"] == metric]
            if chosen:
                out.table(
                    _matrix(
                        f"{scenario}_{metric}_vs_{against}", f"{heading}, {metric.upper()}, %", chosen,
                        lambda p: p["percent"], _percent,
                        f"Mean paired difference in % of {against}'s mean, 95 % interval in brackets, n = {n}. Where "
                        f"{against}'s mean is 0 the difference itself.", lowest=False,
                    ),
                    folded=f"{heading}, {metric.upper()}: {scenario}",
                )  # fmt: skip
    extra = (
        ("clean_itae", "ITAE of the noise-free OD (OD min²), sum over the windows", True),
        ("clean_steady_abs_error", "Steady error of the noise-free OD", True),
        ("effort_ul_s", "Control effort (µL/s per minute)", False),
        ("media_ml", "Fresh medium used (mL per vial)", False),
        ("held", "Samples on which the interlock allowed no dose, per vial", False),
    )
    for key, title, ranked in extra:
        table = _matrix(
            f"{scenario}_{key}", title, totals, lambda r, k=key: r[k],  # type: ignore[misc]
            lambda r, k=key: number(r[k]), f"Mean, n = {n}.", lowest=ranked,  # type: ignore[misc]
        )  # fmt: skip
        out.table(table, folded=f"{title}: {scenario}")


def all_rows(summary: Row) -> Table:
    """Every row of summary.json beside its details."""
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


def _paper_section(out: Page, summary: Row) -> None:
    rows = beside(summary)
    out.section("The paper's Table 2 beside this run")
    for metric in METRICS:
        out.table(table_2(rows, metric))
    lost, cells = losses(rows, summary["paired"]), 2 * len(_windows(rows))
    cells_lost = len({(s.split(":")[0]) for s in lost})
    certain = len({(s.split(":")[0]) for s in lost if "95 %" in s and "holds 0" not in s})
    items = "".join(f"<li>{typeset(s)}</li>" for s in lost)
    known = any(r["controller"] == "dqn" for r in rows)
    verdict = (
        f"Of {cells} cells here, the learned policy (dqn) loses {cells_lost}, {certain} of them with a 95 % interval "
        "of the paired difference that excludes 0:"
    ) if lost else (
        f"The learned policy (dqn) is lowest in all {cells} cells here." if known else "No learned policy was run."
    )  # fmt: skip
    theirs = published_losses()
    out.add(
        f'<div class="verdict"><p><b>{html.escape(verdict)}</b></p><ul>{items}</ul>'
        f"<p>In the published table the DQN loses {len(theirs)} of 10: {html.escape(', '.join(theirs))}.</p></div>"
    )
    out.table(cell_by_cell(rows))
    bounded = _below_bound(summary)
    if bounded:
        out.text(bounded)


def _below_bound(summary: Row) -> str:
    """Published ISE that no controller can reach on the training model, where the oracle was run on it."""
    found = []
    for p in TABLE_2:
        if p.scenario != "setpoint_steps":
            continue
        row = _find(summary["rows"], controller="oracle", plant="nominal", scenario=p.scenario, window=p.window)
        if row is not None and p.ise < row["ise_mean"]:
            found.append(f"{p.controller} at {name_of(p.scenario, p.window)} ({p.ise:g} against {row['ise_mean']:.3f})")
    if not found:
        return ""
    return (
        "Published ISE below what even the oracle reaches on the nominal model, where the pump limits a step down: "
        + ", ".join(found)
        + ". The paper's pump outran its culture's growth by more than the nominal values allow, or its step began "
        "lower; it reports neither."
    )


def _settings(agents: Mapping[str, Row]) -> Table | None:
    """The hyper-parameters in which the agents trained here differ."""
    trained = {name: told["agent"] for name, told in agents.items() if "agent" in told}
    if len(trained) < 2:
        return None
    keys = [k for k in next(iter(trained.values())) if len({str(agent[k]) for agent in trained.values()}) > 1]
    body = tuple((k, *(str(agent[k]).replace("[]", "none") for agent in trained.values())) for k in keys)
    return Table(
        "agents", "What tells the agents apart", ("hyper-parameter", *trained), body,
        "dqn_paper: what the paper states, and what is customary where it says nothing. Everything else is the same.",
    ) if keys else None  # fmt: skip


def _learning_section(out: Page, summary: Row, run: Path) -> None:
    first = [f for f in summary["figures"] if f["file"].startswith(("training/", "figures/fig2a"))]
    if not first and not summary["agents"]:
        return
    out.section("Model and learned policy")
    fitted = summary["calibration"]
    if fitted:
        parts = [
            f"{k} {number(fitted[k]['value'], 4)} (95 % {number(fitted[k]['ci95'][0], 4)} to "
            f"{number(fitted[k]['ci95'][1], 4)}; true {number(fitted[k]['truth'], 4)})"
            for k in ("mu", "tau")
        ]
        out.text(f"Calibration: {', '.join(parts)}; PMSE {number(fitted['pmse_pct'])} %.")
    settings = _settings(summary["agents"])
    if settings is not None:
        out.table(settings)
    for name, told in summary["agents"].items():
        regret = told["regret_pct"]
        shown = ", ".join(number(r) for r in regret) if isinstance(regret, list) else number(regret)
        out.text(f"{name}: regret against the optimum of the model, % per seed: {shown}.")
    for f in first:
        if (run / f["file"]).is_file():
            out.figure(run / f["file"], f["title"], f["caption"])


def page(run: Path) -> Page:
    """The page of a benchmark's run folder."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    out = Page(
        "Turbidostat control: benchmark",
        f"{len(summary['totals'])} closed loops of {summary['replicates']} simulated replicates each, "
        f"seed {summary['seed']}",
    )
    out.section("What was run")
    provenance(out, run)
    _learning_section(out, summary, run)
    if summary["beside_paper"]:
        _paper_section(out, summary)
    regulated = _find(summary["rows"], controller="dqn", scenario="regulation")
    rest = [f for f in summary["figures"] if not f["file"].startswith(("training/", "figures/fig2a"))]
    if rest:
        out.section("Figures")
        if regulated is not None:
            out.text(
                f"Settling at 0.5 from 0.7: {number(regulated['settling_min'])} min (median of {regulated['n']}; "
                f"paper: {summary['paper_settling_min']:g} min on average, start and band not stated)."
            )
        for f in rest:
            out.figure(run / f["file"], f["title"], f["caption"])
    wide = [s for s in dict.fromkeys(e["scenario"] for e in summary["totals"])
            if len({e["controller"] for e in summary["totals"] if e["scenario"] == s}) > 4]  # fmt: skip
    if wide:
        out.section("Every plant")
        out.text(
            "Model-based controllers and the learned policy believe the model of the configuration (env) whatever the "
            "plant is; what each plant is stands in the configuration above."
        )
        for scenario in wide:
            every_plant(out, summary, scenario)
    out.section("Definitions")
    out.add(
        "<dl>"
        + "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in DEFINITIONS.items())
        + "</dl>"
    )
    if summary["rows"]:
        out.section("All numbers")
        out.table(all_rows(summary), folded=f"{len(summary['rows'])} rows; also in tables/rows.csv")
    return out
