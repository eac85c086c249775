"""The page: complete, self-contained, and rendered by a real browser; its tables are the summary's numbers."""

import contextlib
import csv
import html.parser
import json
import os
import re
import shutil
import socket
import subprocess
import threading
from pathlib import Path

import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine

from conf import guests
from dqn import policy as policies
from experiments import report
from experiments.benchmark import main
from experiments.cli import files, frame
from experiments.comparison import page as comparison
from experiments.comparison.run import benchmark as run_benchmark
from experiments.comparison.statistics import Row
from experiments.reporting import charts
from experiments.reporting.page import Page
from experiments.reporting.tables import Emphasis, Table, count, number, plus_minus, typeset
from tests.experiments.test_deploy import inverse_policy
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.xdist_group("report")  # its tests share a run, made once
BROWSER = next((b for b in map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome")) if b), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine (apt-get install chromium)")
VOID = {"meta", "link", "br", "img", "hr"}


STUDIES = (
    "+studies.regulation={scenarios:[regulation],plants:[nominal_noise],controllers:[dqn,pi]}",
    "+studies.setpoint_steps={scenarios:[setpoint_steps],plants:[nominal_noise],controllers:[dqn,pi,mpc]}",
    "+studies.beyond={scenarios:[setpoint_steps],plants:[nominal,bench],"
    "controllers:[dqn,pi,adaptive_inverse,threshold,oracle]}",
    "controllers.mpc.swarm.particles=6", "controllers.mpc.swarm.iterations=8", "replicates=3", "workers=1",
    "calibration=true",
)  # fmt: skip


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory):
    """A small benchmark with everything the page can show but training."""
    folder = tmp_path_factory.mktemp("report")
    policies.save(folder / "policy.npz", inverse_policy())
    config = main.config([*STUDIES, f"policies.dqn={folder / 'policy.npz'}"])
    run = folder / "run"
    (run / ".hydra").mkdir(parents=True)
    frame.save_config(config, run)
    (run / ".hydra" / "overrides.yaml").write_text("- replicates=3\n")
    run_benchmark(config, run)
    return run


@pytest.fixture(scope="module")
def text(benchmark):
    return (benchmark / "report.html").read_text(encoding="utf-8")


class Strict(html.parser.HTMLParser):
    """Checks that every tag is closed in order, and collects ids and addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.ids += [v for k, v in attrs if k == "id"]
        self.addresses += [v for k, v in attrs if k in ("href", "src", "xlink:href", "srcset", "data", "action")]

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def well_formed(text: str) -> Strict:
    page = Strict()
    page.feed(text)
    assert page.open == []
    return page


@pytest.mark.slow
def test_page_is_well_formed_and_points_to_nothing_outside(text):
    page = well_formed(text)
    assert len(page.ids) == len(set(page.ids))
    assert page.addresses
    for address in page.addresses:
        assert address.startswith(("#", "data:"))
        assert not address.startswith("#") or address[1:] in page.ids
    assert "://" not in text
    assert "@import" not in text
    assert set(re.findall(r"url\((.)", text)) <= {"#"}
    assert "`" not in re.sub(r"<pre>.*?</pre>", "", text, flags=re.DOTALL)  # Markdown's


@pytest.mark.slow
def test_page_holds_what_it_must(text, benchmark):
    summary = json.loads((benchmark / "summary.json").read_text())
    for figure in summary["figures"]:
        assert figure["title"].replace("'", "&#39;") in text
    assert text.count("data:image/svg+xml;base64,") == len(summary["figures"]) >= 6
    assert "<td>replicates=3</td>" in text
    assert "gain_ml_s: 1.11" in text  # the plants' values stand in the unfolded configuration
    assert {f"table2_{metric}.{end}" for metric in ("ise", "itae") for end in ("csv", "tex")} | {"rows.csv"} <= {
        path.name for path in (benchmark / "tables").iterdir()
    }


LAWS = ("a", "b", "c", "d", "e", "f")
RANKED = ("ise_mean", "itae_mean", "itae_median", "clean_ise", "clean_itae", "clean_steady_abs_error")


def marked(page: Page, name: str) -> list[str]:
    """The laws that stand out in a table, whichever way round it is."""
    (table,) = (table for table in page.tables if table.name == name)
    across = [
        law for row in table.rows for law, cell in zip(table.columns, row, strict=True) if isinstance(cell, Emphasis)
    ]
    return across if table.columns[0] == "plant" else [row[0] for row in table.rows if isinstance(row[1], Emphasis)]


def test_every_table_marks_the_law_that_is_best_by_its_own_measure():
    """Six laws, each of which is best by one measure alone; the oracle is better still, and out of competition."""
    measures = (*RANKED, "effort_ul_s", "media_ml", "held")
    entries = [
        {"signal": "density", "controller": law, "plant": "p", "scenario": "s", "n": 3, "ise_sd": 0.1, "itae_sd": 0.1,
         "floor_ise": 0.1, "floor_itae": 0.1}
        | {key: 1.0 if LAWS.index(law) == i else 2.0 + i for i, key in enumerate(measures)} for law in LAWS
    ]  # fmt: skip
    entries.append({**entries[0], "controller": "oracle", **dict.fromkeys(measures, 0.5)})
    page = one_section()
    comparison.every_plant(page, {"totals": [*map(Row.of, entries)], "paired_totals": []}, "s")
    further = {table.title: str(table.rows[0][1]) for table in page.tables if table.note == "Mean, n = 3."}
    assert further == {  # law a's, which is 2 and more by measure
        "ITAE of the measured OD (OD min²), sum over the windows, median over vials": "4",
        "ISE of the noise-free OD (OD² min), sum over the windows": "5",
        "ITAE of the noise-free OD (OD min²), sum over the windows": "6", "Steady error of the noise-free OD": "7",
        "Control effort (µL/s per decision)": "8", "Fresh medium used (mL per vial)": "9",
        "Samples after which the interlock allowed no dose, per vial": "10",
    }  # fmt: skip
    assert {table.columns[:3] for table in page.tables} == {("plant", "a", "b")}
    for key, law in zip(RANKED, LAWS, strict=True):
        assert (key, marked(page, f"s_{key.removesuffix('_mean')}")) == (key, [law])
    for key in ("effort_ul_s", "media_ml", "held"):
        assert marked(page, f"s_{key}") == []


def test_every_table_of_a_share_marks_the_law_that_is_best_by_its_own_measure(tmp_path):
    measures = ("ratio_abs_error_mean", "ratio_abs_error_last2h", "ratio_abs_error_last_day")
    rest = dict.fromkeys(("estimate_rms", "band_covers", "od_min", "od_mean", "od_max"), 0.5)
    entries = [
        {"signal": "share", "controller": law, "plant": "p", "scenario": "s", "n": 3, **rest}
        | {key: 0.1 if LAWS.index(law) == i else 0.2 for i, key in enumerate(measures)}
        for law in LAWS[:3]
    ]
    pair = Row.of({**entries[1], "difference": -0.1, "ci95": [-0.12, -0.05], "lower_in": 2})
    page = one_section()
    guests.load("experiments.comparison")
    comparison.SECTIONS["share"].add(page, {"rows": [*map(Row.of, entries)], "paired": [pair], "figures": []}, tmp_path)
    (differences,) = (table for table in page.tables if table.name == "s_paired")
    assert differences.rows == (("b", "-0.1000 [-0.1200, -0.0500], lower in 2 of 3"),)
    assert [marked(page, f"s_{key}") for key in measures] == [["a"], ["b"], ["c"]]


def test_in_short_the_lowest_of_each_plant_is_named_and_the_oracle_is_not():
    def entry(signal, law, value, **more):
        key = "itae_mean" if signal == "density" else "ratio_abs_error_mean"
        return Row.of({"signal": signal, "controller": law, "plant": "p", "scenario": signal, key: value} | more)

    totals = [entry("density", law, value) for law, value in (("dqn", 9.0), ("mpc", 8.5), ("oracle", 3.0))]
    rows = [entry("share", "midpoint", value, preview=True) for value in (0.05, 0.03)]
    rows += [entry("share", "pi", 0.045), entry("density", "dqn", 1.0), entry("density", "mpc", 2.0)]
    page = one_section()
    comparison._in_short(page, {"beside_paper": [], "totals": totals, "rows": rows})
    text = page.html()
    assert "<h2>Summary</h2>" in text
    assert "<li>density on p: mpc 8.5, then dqn 9</li>" in text
    assert "<li>share on p: midpoint, with preview 0.04, then pi 0.045</li>" in text
    assert "Lowest mean |r - setpoint| and ITAE, OD min², mean of the replicates:" in text


@pytest.mark.parametrize("oracle", [True, False])
def test_in_short_a_law_without_rival_stands_beside_the_oracle_and_the_noise(oracle):
    """`+experiment=regulation` runs one law on one plant; it is held to the oracle, if any, and to the noise."""
    own = {"signal": "density", "controller": "dqn", "plant": "p", "scenario": "s", "ise_sd": 0.02, "itae_sd": 2.0}
    own |= {"ise_mean": 0.17, "itae_mean": 12.6, "floor_ise": 0.001, "floor_itae": 4.9}
    rows = [Row.of(own), Row.of(own | {"controller": "oracle", "ise_mean": 0.16, "itae_mean": 9.0})]
    page = one_section()
    comparison._in_short(page, {"beside_paper": [], "totals": rows[: 1 + oracle], "rows": rows[:1]})
    (said,) = re.findall("<li>dqn, s on p: (.*)</li>", page.html())
    ise, itae = (["0.17", "0.02", "0.16", "0.001"], ["12.6", "2", "9", "4.9"])
    assert re.findall(r"\d[\d.]*", said) == [n for n in ise + itae if oracle or n not in ("0.16", "9")]
    assert "Lowest" not in page.html()


def test_numbers_that_a_verdict_has_told_are_folded_without_empty_rows_and_typeset_as_it(tmp_path):
    """A calibration has sixty keys of a file; who has no verdict shows its numbers at once."""
    estimate = {"value": 0.03, "ci95": [0.029, 0.031]}
    found = {
        "verdict": {"word": "use", "why": "mu is known within +-3 %", "then": ""}, "mu": estimate, "tau": estimate,
        "doubling_min": 23.0, "pmse_pct": 1.0, "n_used": 90, "n_rejected": 0, "warnings": [], "notes": [],
    }  # fmt: skip
    run_folder(tmp_path / "run", found)
    text = report.write(tmp_path / "run").read_text(encoding="utf-8")
    rows = re.search(r"<details><summary>Every number</summary>(.*?)</details>", text, re.DOTALL)[1]
    assert "<th>mu.value, 1/min</th><td>0.03</td>" in rows
    assert "<th>verdict.why</th><td>mu is known within ±3 %</td>" in rows
    assert "verdict.then" not in text
    assert "+-" not in text
    run_folder(tmp_path / "other", {"answer": 42})
    text = report.write(tmp_path / "other").read_text(encoding="utf-8")
    assert "Every number" not in text
    assert "<th>answer</th><td>42</td>" in text


def test_numbers_are_readable():
    assert [count(n, "row") for n in (0, 1, 2)] == ["0 rows", "1 row", "2 rows"]
    assert [number(v) for v in (0.0, 1234.5, 0.01234, 7.3e-5, 1e6)] == ["0", "1234", "0.0123", "7.3e-5", "1000000"]
    assert number(None) == number(float("nan")) == "–"
    assert plus_minus(0.5, 1e-16) == "0.5"
    assert plus_minus(9.81, 0.912) == "9.81 ± 0.91"
    assert typeset("a-b -1 <2> [-3, 1e-5]") == "a-b −1 <2> [−3, 1e-5]"


def one_section() -> Page:
    built = Page("A & B", "")
    built.section("<first>")
    return built


def test_a_page_escapes_what_it_is_given():
    built = one_section()
    built.text("a-b -1 <2> [-3, 1e-5]")
    built.add("verdict", claim="<b>", items=["-2 > -3"], remark="&")
    text = built.html()
    assert "<p>a-b −1 &lt;2&gt; [−3, 1e-5]</p>" in text
    assert "<li>−2 &gt; −3</li>" in text
    assert "<title>A &amp; B</title>" in text
    assert "<h2>&lt;first&gt;</h2>" in text
    assert "<b>&lt;b&gt;</b>" in text


def test_a_table_escapes_what_each_format_reads_as_its_own():
    table = Table("t", "50 % & more_", ("a", "b"), (("x<y", Emphasis("1,5")),))
    built = one_section()
    built.table(table)
    assert "<th>x&lt;y</th>" in built.html()
    assert '<td class="best">1,5</td>' in built.html()
    assert list(csv.reader(table.csv().splitlines())) == [["a", "b"], ["x<y", "1,5"]]
    assert r"50 \% \& more\_" in table.latex()
    assert r"x$<$y & \textbf{1,5} \\" in table.latex()
    with pytest.raises(ValueError, match="row of 1 cells under 2 headings"):
        Table("t", "", ("a", "b"), (("x",),))


def run_folder(folder: Path, summary: dict) -> Path:
    folder.mkdir(parents=True)
    files.write_json(folder / "summary.json", summary)
    (folder / "config.yaml").write_text("seed: 7\nenv:\n  mu: 0.03 # <1/min>\n")
    return folder


def figure():
    drawn, (ax,) = charts.new_figure(3, 2)
    ax.plot([0, 1], [1, 2])
    return drawn


def test_any_run_gets_a_page(tmp_path):
    """Scalars, nested values, lists of entries, figures with and without SVG."""
    windows = [{"reactor": "M0", "ise": 0.25}, {"reactor": "M1", "ise": None, "note": "x & y"}]
    run = run_folder(tmp_path / "run", {"outcome": "done", "mu": {"value": 0.0301, "ci95": [0.02, 0.04]}, "w": windows})
    charts.save(figure(), run / "figures", "both")
    figure().savefig(run / "fit.png")
    text = report.write(run).read_text(encoding="utf-8")
    well_formed(text)
    assert text.count("data:image/svg+xml;base64,") == 1
    assert text.count("data:image/png;base64,") == 1
    for word in ("mu.value", "0.0301", "0.02, 0.04", "x &amp; y", "both", "fit", "seed: 7", "&lt;1/min&gt;"):
        assert word in text
    assert list(csv.reader((run / "tables" / "w.csv").read_text().splitlines())) == [
        ["reactor", "ise, OD² min", "note"], ["M0", "0.25", "–"], ["M1", "–", "x & y"]
    ]  # fmt: skip


def test_a_figure_is_laid_out_once_for_both_of_its_files(tmp_path, monkeypatch):
    layouts = []
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda self, drawn: layouts.append(drawn))
    drawn = figure()
    charts.save(drawn, tmp_path, "both")
    assert layouts == [drawn]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["both.png", "both.svg"]


@pytest.mark.parametrize(
    ("env", "unit"),
    [("density", "OD"), ("relative", "periods of full pump"), ("coculture", "of the share")],
)
def test_errors_of_a_training_are_in_the_unit_of_its_task(env, unit, tmp_path):
    errors = (
        "steady_abs_error", "steady_abs_error_last", "mean_abs_error", "optimum_steady_abs_error",
        "optimum_mean_abs_error", "myopic_steady_abs_error", "steady_abs_error_by_setpoint",
    )  # fmt: skip
    run = run_folder(
        tmp_path / "run", {key: [0.1] for key in errors} | {"regret_pct": [2.0], "setpoint": 0.5, "nodes": 3}
    )
    (run / "config.yaml").write_text(f"env:\n  kind: {env}\n")
    text = report.write(run).read_text(encoding="utf-8")
    said = dict(re.findall(r"<th>([^<,]+), ([^<]+)</th>", text))
    assert {key: said.get(key) for key in errors} == dict.fromkeys(errors, unit)
    assert (said["regret"], said["setpoint"]) == ("%", "OD")
    assert "<th>nodes</th>" in text


def test_every_number_of_a_run_has_its_own_unit(tmp_path):
    window = {"setpoint": 0.5, "start_min": 30.0, "temperature": 37.0, "ise": 0.2, "itae": 7.0, "ise_mean": 0.01}
    window |= {"itae_mean": 0.3, "steady_abs_error": 0.02, "settling_min": 4.5, "ratio_abs_error_mean": 0.04}
    window |= {"od_abs_error_mean": 0.006, "volume_ml": 8.0}
    rates = {"mu": {"value": 0.03, "ci95": [0.02, 0.05], "n": 4}, "tau": {"value": 0.3}, "pmse_pct": 6.0}
    run = run_folder(
        tmp_path / "run", {"windows": [window], **rates, "hold_s": 1.5, "many": list(range(13)), "few": []}
    )
    text = report.write(run).read_text(encoding="utf-8")
    with open(run / "tables" / "windows.csv", newline="") as f:
        head, cells = csv.reader(f)
    assert dict(zip(head, cells, strict=True)) == {
        "setpoint, OD": "0.5", "start, min": "30", "temperature, °C": "37", "ise, OD² min": "0.2",
        "itae, OD min²": "7", "ise_mean, OD²": "0.01", "itae_mean, OD min": "0.3", "steady_abs_error, OD": "0.02",
        "settling, min": "4.5", "ratio_abs_error_mean": "0.04", "od_abs_error_mean, OD": "0.006", "volume, mL": "8",
    }  # fmt: skip
    said = dict(re.findall(r"<tr><th>([^<]+)</th><td>([^<]*)</td></tr>", text))
    assert said.items() >= {
        "mu.value, 1/min": "0.03", "mu.ci95, 1/min": "0.02, 0.05", "mu.n": "4", "tau.value": "0.3", "pmse, %": "6",
        "hold, s": "1.5", "many": "13 values", "few": "none", "run folder": "run", "seed": "7",
    }.items()  # fmt: skip


def test_each_run_of_a_folder_has_its_own_seed_command_figures_and_tables(tmp_path):
    """Two runs of one command are called by their folders, and each figure stands in the section of its run."""
    for k, name in enumerate(("1_train", "2_train")):
        run = run_folder(tmp_path / "both" / name, {"windows": [{"reactor": name}], "marks": [{"text": name}]})
        (run / "config.yaml").write_text(f"env:\n  seed: 99\nseed: {40 + k}\n")
        (run / ".hydra").mkdir()
        (run / ".hydra" / "overrides.yaml").write_text(f"- env.mu=0.0{k + 2}\n")
        charts.save(figure(), run / "figures", f"drawn_{k}")
    text = report.write(tmp_path / "both").read_text(encoding="utf-8")
    sections = dict(re.findall(r"<h2>([^<]+)</h2>(.*?)</section>", text, re.DOTALL))
    assert list(sections) == [f"{k}_train: {what}" for k in (1, 2) for what in ("results", "command and configuration")]
    for k in (0, 1):
        assert re.findall(r"drawn \d", sections[f"{k + 1}_train: results"]) == [f"drawn {k}"] * 2
        ran = dict(re.findall(r"<tr><th>([^<]+)</th><td>([^<]*)</td>", list(sections.values())[2 * k + 1]))
        assert (ran["seed"], ran["overrides"], ran["run folder"]) == (
            str(40 + k), f"env.mu=0.0{k + 2}", f"{k + 1}_train",
        )  # fmt: skip
    assert {path.name: path.read_text().split() for path in (tmp_path / "both/tables").glob("*.csv")} == {
        f"{k}_train_{table}.csv": [column, f"{k}_train"]
        for k in (1, 2)
        for table, column in (("windows", "reactor"), ("marks", "text"))
    }


def test_a_table_for_a_paper_has_its_units_in_symbols():
    table = Table("t", "37 °C, 10⁻³ OD² min", ("law", "µL/s"), (("a~b", Emphasis("−1 ± 2")), ("{c}", "–")))
    assert table.latex().splitlines() == [
        r"\begin{table}", r"\caption{37 $^\circ$C, 10$^-$$^3$ OD$^2$ min}\label{tab:t}", r"\begin{tabular}{lr}",
        r"\toprule", r"law & $\mu$L/s \\", r"\midrule", r"a\textasciitilde{}b & \textbf{$-$1 $\pm$ 2} \\",
        r"\{c\} & -- \\", r"\bottomrule", r"\end{tabular}", r"\end{table}",
    ]  # fmt: skip


def test_a_sweep_is_reported_in_place_of_a_run_where_one_is_named(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(report, "compare", lambda folder: seen.append(("compare", folder)))
    monkeypatch.setattr(report, "write", lambda folder: seen.append(("write", folder)))
    (tmp_path / "one").mkdir()
    report.report(report.ReportConfig(run=str(tmp_path / "one")), tmp_path)
    report.report(report.ReportConfig(run=str(tmp_path / "one"), runs=str(tmp_path / "many")), tmp_path)
    assert seen == [("write", tmp_path / "one"), ("compare", tmp_path / "many")]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[]", ["none"]), ("[1, [2, [3.5]], null]", ["1, 2, 3.5, –"]), ("7", ["7"]), ("null", ["–"]),
        ('[{"a": 1}, {"b": {"c": "x"}}]', ["b.c", "<td>x</td>"]),
        ('{"mixed": [{"a": 1}, 2, [3]]}', ["mixed", "a", "3"]), ('{"empty": [{}], "e": {}}', ["empty"]),
        ('{"deep": {"deeper": {"deepest": [[{"a": [1]}]]}}}', ["deep.deeper.deepest"]),
        ('{"../../out": [{"a": 1}]}', ["../../out"]), ('{"a/b": [{"c": 1}]}', ["a/b"]),
        ('{"s": Infinity, "t": NaN, "u": 1e999}', ["inf"]),
    ],
)  # fmt: skip
def test_a_summary_of_any_shape_gets_a_page(content, words, tmp_path):
    run = tmp_path / "a" / "b" / "run"
    run.mkdir(parents=True)
    (run / "summary.json").write_text(content)
    text = report.write(run).read_text(encoding="utf-8")
    well_formed(text)
    for word in words:
        assert word in text
    assert {p.parent for p in tmp_path.rglob("*") if p.is_file()} <= {run, run / "tables"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no summary.json"), (b"{torn", "damaged"), (b"\xff\xfe\x00", "damaged"), (200_000 * b"[", "damaged"),
        (b'{"half": "\\ud800"}', "damaged"), (b'{"beside_paper": 3}', "not the summary.json of a benchmark"),
        (b'{"beside_paper": [], "rows": {}}', "not the summary.json of a benchmark"),
    ],
    ids=["absent", "torn", "no text", "deep", "half a character", "a number", "no rows"],
)  # fmt: skip
def test_what_is_no_run_ends_in_one_line(content, message, tmp_path):
    if content is not None:
        (tmp_path / "summary.json").write_bytes(content)
    with pytest.raises(frame.UserError, match=message):
        report.write(tmp_path)


@pytest.mark.parametrize(("name", "content"), [("a.svg", "not drawn"), ("b.png", "<svg>"), ("c.svg", "")])
def test_a_figure_that_is_none_ends_in_one_line(name, content, tmp_path):
    run = run_folder(tmp_path / "run", {})
    (run / name).write_text(content)
    with pytest.raises(frame.UserError, match=f"{name}: not an SVG or PNG; delete it or draw it again"):
        report.write(run)


def test_latest_is_the_newest_run(tmp_path):
    with pytest.raises(frame.UserError, match="no finished run"):
        report.find("latest", tmp_path)
    old, new = (run_folder(tmp_path / "train" / name, {}) for name in ("z", "a"))
    os.utime(old / "summary.json", (1, 1))
    assert report.find("latest", tmp_path) == new
    with pytest.raises(frame.UserError, match="no such folder"):
        report.find(str(tmp_path / "nowhere"))


def chromium(folder: Path, page: Path, *arguments: str) -> str:
    assert BROWSER is not None
    done = subprocess.run(
        [
            BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--disable-background-networking", f"--user-data-dir={folder / 'profile'}", "--window-size=1300,2400",
            *arguments, page.as_uri(),
        ],
        capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


PROBE = """<script>addEventListener('load', () => {
  const of = (selector) => [...document.querySelectorAll(selector)];
  document.body.dataset.probe = JSON.stringify({
    requests: performance.getEntriesByType('resource').map((e) => e.name).filter((n) => !n.startsWith('data:')),
    figures: of('figure img').map((s) => [s.getBoundingClientRect().width, s.getBoundingClientRect().height]),
    drawn: of('img').filter((i) => i.complete && i.naturalWidth > 0).length,
    tables: of('table').length,
    sideways: document.documentElement.scrollWidth - document.documentElement.clientWidth,
  });
});</script></body>"""


def probe(folder: Path, page: Path) -> dict:
    """What a browser makes of a page, by a script that looks; the page forbids all of them, its copy does not."""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text(encoding="utf-8"))
    (folder / "probed.html").write_text(text.replace("</body>", PROBE), encoding="utf-8")
    dom = chromium(folder, folder / "probed.html", "--dump-dom")
    return json.loads(re.search(r'data-probe="([^"]*)"', dom)[1].replace("&quot;", '"'))


HOSTILE = """<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" width="400" height="200"
 onload="top.document.title='owned'"><script>top.document.title='owned'; fetch('ADDRESS/script')</script>
<script href="ADDRESS/script.js"/><image href="ADDRESS/a.png" width="9" height="9"/>
<image xlink:href="ADDRESS/b.png" width="9" height="9" onerror="top.document.title='owned'"/>
<style>@import url(ADDRESS/c.css); rect { fill: url(ADDRESS/d.svg#e) }</style><use href="ADDRESS/f.svg#g"/>
<foreignObject width="99" height="99"><iframe xmlns="http://www.w3.org/1999/xhtml" src="ADDRESS/h"/></foreignObject>
<a href="javascript:top.document.title='owned'"><rect id="s0" width="300" height="150"/></a></svg>"""


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("guarded", [True, False])
def test_no_figure_runs_a_script_or_asks_for_anything(guarded, tmp_path):
    """In a browser, with a server that would hear of it: with the page's ban on scripts, and without it."""
    heard: list[bytes] = []
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(0.05)

    def listen():
        while listener.fileno() >= 0:
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                heard.append(connection.recv(200))
                connection.close()

    thread = threading.Thread(target=listen)
    thread.start()
    run = run_folder(tmp_path / "run", {"<img src=x onerror=document.title='owned'>": "<script>document.title='owned'"})
    (run / "figures").mkdir()
    svg = HOSTILE.replace("ADDRESS", f"http://127.0.0.1:{listener.getsockname()[1]}")
    (run / "figures" / "a.svg").write_text(svg)
    page = report.write(run)
    if guarded:
        dom = chromium(tmp_path, page, "--dump-dom")
    else:
        assert probe(tmp_path, page)["figures"] == [[400, 200]]
        dom = chromium(tmp_path, tmp_path / "probed.html", "--dump-dom")
    listener.close()
    thread.join()
    assert heard == []
    assert "owned</title>" not in dom


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_the_page(benchmark, tmp_path):
    """Rendered for real: figures have their size, text its width, nothing is asked from anywhere, nothing overflows."""
    found = probe(tmp_path, benchmark / "report.html")
    assert found["requests"] == []
    assert found["sideways"] == 0
    assert found["tables"] >= 5
    assert found["drawn"] == len(found["figures"]) >= 6
    assert all(width > 300 and height > 150 for width, height in found["figures"])


def test_several_runs_begin_with_what_each_came_to(tmp_path):
    for name, passed in (("1_first", True), ("2_second", False)):
        checks = [{"name": f"{name}'s", "holds": passed, "kind": "safety"}]
        found = {"cannot_hold": [], "observation": [name], "passed": passed, "checks": checks}
        run_folder(tmp_path / "both" / name, found)
    text = report.write(tmp_path / "both").read_text(encoding="utf-8")
    short = text[text.index("<h2>Summary") : text.index("<h2>First: results")]
    assert re.findall("for 1_first|for 2_second|Good: |Not safe: ", short) == [
        "for 1_first", "Good: ", "for 2_second", "Not safe: ",
    ]  # fmt: skip
