"""What stands on the page of a comparison, from numbers made up: each beside its own law, plant and unit."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from experiments.coculture import comparison
from experiments.comparison import figures, page, statistics, studies
from experiments.comparison.config import SETTLING_MIN, TABLE_2, BenchmarkConfig, StudyConfig
from experiments.comparison.statistics import Row, Summary
from experiments.comparison.trials import Cell, DensityTrial, Trial, cells
from experiments.reporting import charts
from experiments.reporting.page import Page
from experiments.reporting.tables import Emphasis
from tests.experiments.test_benchmark import load

FLOOR_RED = "#b00020"
STEPS = (
    "+experiment=setpoint_steps", "studies.setpoint_steps.plants=[upset_pump,bench]",
    "studies.setpoint_steps.controllers=[mpc,pi,dqn]", "replicates=2",
)  # fmt: skip


def trial(config: BenchmarkConfig, cell: Cell, number: int) -> DensityTrial:
    """Two vials off the setpoint by so many hundredths, whose pump moves by so many uL/s a minute."""
    schedule = config.scenarios[cell.scenario]
    minute = np.arange(schedule.total_min + 1.0)
    asked = np.asarray(schedule.setpoints)[np.minimum(np.searchsorted(schedule.edges, minute, "right") - 1, 2)]
    od = asked + 0.01 * number + np.array([[0.0], [0.001]])
    rate = np.where(minute % 2 == 0, 0.01, 0.01 - 0.001 * number) * np.ones_like(od)
    none = np.zeros(2)
    return DensityTrial(
        cell, schedule, minute, np.full_like(od, 37.0), od, od - 0.002, rate, minute * np.ones_like(od), none, none > 0
    )


def test_each_number_stands_beside_its_own_plant_and_law_whatever_order_a_study_names_them_in() -> None:
    """The paper's table has those of the study's first plant alone."""
    config = load(*STEPS)
    number = {cell: k for k, cell in enumerate(cells(config), 1)}
    trials: list[Trial] = [trial(config, cell, k) for cell, k in number.items()]
    summary = studies.summarise(config, trials)
    of = {(cell.plant, cell.controller): k for cell, k in number.items()}
    lines = page.all_rows(summary).rows
    assert len(lines) == 3 * 6
    for line in lines:
        _, plant, law, _ = line[0].split(", ")
        assert float(line[-1]) == pytest.approx(of[plant, law]), "effort, uL/s"
    for entry in summary["totals"]:
        assert entry[statistics.EFFORT] == pytest.approx(of[entry.plant, entry.controller])
    assert [(e.plant, e.controller) for e in summary["totals"]] == [
        (plant, law) for plant in config.plants for law in config.controllers if (plant, law) in of
    ]
    assert {b["plant"] for b in summary["beside_paper"]} == {"upset_pump"}
    assert len(summary["beside_paper"]) == 3 * 3
    (beside,) = [d.figure for d in studies.draw(config, trials, summary) if d.name == "table2"]
    for axes in beside.axes:
        filled = [line for line in axes.get_lines() if _dot(line) and to_hex(line.get_markerfacecolor()) != "#ffffff"]
        assert len(filled) == 3 * 3
        heights = [float(np.asarray(line.get_ydata())[0]) for line in filled]
        assert len(set(np.round(heights, 6))) == 3 * 3


def _dot(line: Any) -> bool:
    return line.get_marker() not in ("", "None", None) and len(line.get_xdata()) == 1


def entry(plant: str, law: str, floor: float, **more: Any) -> Row:
    """As `statistics.totals` has it, of an ISE of 0.05 and an ITAE of 20."""
    found: dict[str, Any] = {"signal": "density", "scenario": "day", "plant": plant, "controller": law, "n": 4}
    for metric, mean, noise in (("ise", 0.05, floor), ("itae", 20.0, 1000.0 * floor)):
        found |= {f"{metric}_mean": mean, f"{metric}_sd": 0.1 * mean, f"{metric}_ci95": [0.9 * mean, 1.1 * mean]}
        found |= {f"floor_{metric}": noise, f"clean_{metric}": mean, f"{metric}_median": mean}
    return Row.of(found | {"clean_steady_abs_error": 0.01, "effort_ul_s": 1.0, "media_ml": 1.0, "held": 0.0} | more)


def section() -> Page:
    out = Page("", "")
    out.section("")
    return out


FLOORS = {"nominal_noise": 0.004, "bench": 0.006, "upset_pump": 0.009, "tired_pump": 0.013}


@pytest.mark.parametrize("laws", [("oracle", "dqn", "pi", "mpc", "hold", "inverse"), ("pi", "mpc", "dqn", "oracle")])
def test_the_noise_floor_is_in_the_unit_and_the_row_of_its_plant(laws: tuple[str, ...]) -> None:
    """In 10^-3 OD^2 min, as everything else in the table of the ISE; a red line at the height of the plant's name."""
    totals = [entry(plant, law, floor) for plant, floor in FLOORS.items() for law in laws]
    out = section()
    page.every_plant(out, {"totals": totals, "paired_totals": []}, "day")
    tables = {table.name: table for table in out.tables}
    for metric, mean, scale in (("ise", "50 ± 5", 1000.0), ("itae", "20 ± 2", 1000.0)):
        table = tables[f"day_{metric}"]
        assert table.columns[-1] == "sensor-noise floor"
        for row, (plant, floor) in zip(table.rows, FLOORS.items(), strict=True):
            assert str(row[0]) == plant
            assert {str(cell) for cell in row[1:-1]} == {mean}
            assert float(row[-1]) == pytest.approx(scale * floor)
    drawn = figures.plants(totals)
    names = [label.get_text() for label in drawn.axes[0].get_yticklabels()]
    for axes, scale in zip(drawn.axes, (1.0, 1000.0), strict=True):
        at = {}
        for line in axes.get_lines():
            if to_hex(line.get_color()) == FLOOR_RED:
                low, high = sorted(np.asarray(line.get_ydata(), dtype=float))
                at[names[round(0.5 * (low + high))]] = float(np.asarray(line.get_xdata())[0])
                assert 0.5 * (low + high) == pytest.approx(names.index(names[round(0.5 * (low + high))]))
        assert at == pytest.approx({plant: scale * floor for plant, floor in FLOORS.items()})


def test_a_cell_that_the_policy_loses_to_two_is_lost_once() -> None:
    """Both are lower in ISE at 0.8, one surely; one alone is surely lower in ITAE at 0.65, and surely nobody is
    elsewhere."""
    ise = {"0.8": (0.05, 0.04, 0.03), "0.65": (0.02, 0.04, 0.03), "0.5": (0.05, 0.04, 0.06)}
    itae = {"0.8": (5.0, 6.0, 7.0), "0.65": (9.0, 8.0, 10.0), "0.5": (5.0, 6.0, 7.0)}
    sure = {("pi", "0.8", "ise"), ("mpc", "0.8", "ise"), ("pi", "0.65", "itae")}
    beyond = {"0.8": -0.015, "0.65": -0.012, "0.5": -0.018}
    rows, paired = [], []
    for window in ise:
        for k, law in enumerate(("dqn", "pi", "mpc")):
            at = {"signal": "density", "controller": law, "plant": "bench", "scenario": "setpoint_steps"}
            row: dict[str, Any] = at | {"window": window, "n": 4}
            for metric, values in (("ise", ise), ("itae", itae)):
                mean = values[window][k]
                row |= {f"{metric}_mean": mean, f"{metric}_sd": 0.001, f"{metric}_ci95": [mean, mean]}
                known = (law, window, metric) in sure
                said = {
                    "verdict": "lower" if known else "no difference shown",
                    "ci95": [-0.02, -0.01 if known else 1.0],
                }
                if law != "dqn":
                    more = {"against": "dqn", "metric": metric, "window": window, "difference": beyond[window]}
                    paired.append(Row.of(at | more | said))
            rows.append(Row.of(row))
    keys = ("controller", "plant", "scenario", "window")
    places = [{k: r.values[k] for k in keys} for r in rows]
    out = section()
    page._beside_paper(out, {"rows": rows, "paired": paired, "beside_paper": places})
    (said,) = [content for _, blocks in out.sections for kind, content in blocks if kind == "verdict"]
    assert [word for word in said["claim"].replace(",", "").split() if word.isdigit()][:3] == ["3", "6", "2"]
    assert len(said["items"]) == 4
    assert all(part in said["items"][0] for part in ("OD 0.8", "ISE", "dqn 0.05", "mpc 0.03"))
    each = [item.split(" minus dqn: ")[1].split(",")[0] for item in said["items"]]
    assert each == ["-0.015", "-0.015", "-0.012", "-0.018"]
    assert ["includes 0" in item for item in said["items"]] == [False, False, False, True]


def texts(out: Page) -> list[str]:
    return [content["text"] for _, blocks in out.sections for kind, content in blocks if kind == "paragraph"]


def test_every_number_of_a_row_stands_under_its_own_heading() -> None:
    """No two numbers of the row are alike, and three of four vials settled."""
    names = {"signal": "density", "scenario": "day", "plant": "bench", "controller": "pi"}
    row = names | {"window": "6-12 h", "n": 4, "ise_mean": 0.1}
    row |= {"ise_sd": 0.02, "ise_ci95": [0.06, 0.16], "itae_mean": 7.0, "itae_sd": 0.5, "itae_ci95": [6.0, 8.5]}
    row |= {"settling_min": 12.0, "steady_abs_error": 0.013, "media_ml": 41.0, "ise_median": 0.3, "itae_median": 9.0}
    more = {"ise_per_window": 0.0033, "itae_per_window": 0.23, "settled": 3, "floor_itae": 1.7, "effort_ul_s": 2.6}
    more |= {"clean_ise": 0.08, "clean_itae": 5.5, "floor_ise": 0.9, "clean_abs_error": 0.011, "overflowed": 1}
    table = page.all_rows({"rows": [Row.of(row)], "details": [Row.of(names | more)]})
    assert list(zip(table.columns, table.rows[0], strict=True)) == [
        ("scenario, plant, controller, window", "day, bench, pi, 6-12 h"), ("n", "4"), ("ISE", "0.1 ± 0.02"),
        ("95 %", "0.06 to 0.16"), ("ITAE", "7 ± 0.5"), ("95 %", "6 to 8.5"), ("ISE, T = window", "0.0033"),
        ("ITAE, T = window", "0.23"), ("settling, min", "12"), ("settled", "3/4"), ("steady error", "0.013"),
        ("floor ITAE", "1.7"), ("medium, mL", "41"), ("effort, µL/s", "2.6"),
    ]  # fmt: skip


def test_differences_to_each_law_stand_in_a_table_of_their_own_by_metric() -> None:
    """Of pi on two plants against three laws; a difference to a mean of nothing is no percentage."""
    totals = [entry(plant, law, 0.004) for plant in ("nominal", "bench") for law in ("pi", "mpc")]
    pairs = []
    for k, against in enumerate(("oracle", "dqn", "dqn_adaptive")):
        for j, metric in enumerate(("ise", "itae")):
            for i, plant in enumerate(("nominal", "bench")):
                percent = 10.0 * k + 3.0 * j + i + 1.0
                low, high = percent / 200.0, percent / 50.0
                value = {"percent": percent, "difference": percent / 100.0, "ci95": [low, high]}
                pairs.append(entry(plant, "pi", 0.004, against=against, metric=metric, **value))
    pairs[-1] = Row.of({**pairs[-1].values, "percent": None, "difference": 0.75})
    out = section()
    page.every_plant(out, {"totals": totals, "paired_totals": pairs}, "day")
    tables = {table.name: table for table in out.tables}
    shown = {(k, m): tables[f"day_{m}_vs_{k}"] for k in ("oracle", "dqn", "dqn_adaptive") for m in ("ise", "itae")}
    assert [[str(row[1]) for row in table.rows] for table in shown.values()] == [
        ["+1.0 [+0.5, +2.0]", "+2.0 [+1.0, +4.0]"], ["+4.0 [+2.0, +8.0]", "+5.0 [+2.5, +10.0]"],
        ["+11.0 [+5.5, +22.0]", "+12.0 [+6.0, +24.0]"], ["+14.0 [+7.0, +28.0]", "+15.0 [+7.5, +30.0]"],
        ["+21.0 [+10.5, +42.0]", "+22.0 [+11.0, +44.0]"], ["+24.0 [+12.0, +48.0]", "0.75"],
    ]  # fmt: skip
    for (k, m), table in shown.items():
        assert table.title.endswith(f", {m.upper()}, %")
        assert f"in % of {k}'s mean" in table.note


def test_what_estimates_and_supervisor_did_stands_under_its_own_title_and_law(tmp_path: Path) -> None:
    """A law that estimates nothing is not among them, nor what happened in another scenario."""
    parts = {"error_2sd_pct": 91.0, "share_2sd_pct": 83.0, "supervised_pct": 12.0, "alarm_pct": 4.0}
    totals = [
        entry("bench", "dqn_adaptive", 0.004, **parts),
        entry("bench", "pi", 0.004),
        entry("nominal", "dqn_adaptive", 0.004, **{key: value / 2.0 for key, value in parts.items()}),
        entry("bench", "dqn_adaptive", 0.004, **dict.fromkeys(parts, 1.0), scenario="night"),
    ]
    out = section()
    page._density(out, {"totals": totals, "rows": [], "beside_paper": [], "figures": []}, tmp_path)
    day = [table for table in out.tables if table.name.startswith("day_")]
    said = {table.title: (table.columns, [tuple(map(str, row)) for row in table.rows]) for table in day}
    columns = ("plant", "dqn_adaptive")
    assert said == {
        "Decisions with the true error e within 2 sd of its estimate, %":
            (columns, [("bench", "91"), ("nominal", "45.5")]),
        "Decisions with the true growth share s within 2 sd of its estimate, %":
            (columns, [("bench", "83"), ("nominal", "41.5")]),
        "Decisions by the supervisor's controller, %": (columns, [("bench", "12"), ("nominal", "6")]),
        "Decisions by the supervisor's controller because of innovations, %":
            (columns, [("bench", "4"), ("nominal", "2")]),
    }  # fmt: skip


def share_entry(scenario: str, plant: str, law: str, k: float) -> Row:
    errors = {"ratio_abs_error_mean": 0.01 * k, "ratio_abs_error_last2h": 0.02 * k, "ratio_abs_error_last_day": None}
    rest = {"estimate_rms": 0.03 * k, "band_covers": 0.09 * k, "od_min": 0.1 * k, "od_mean": 0.2 * k, "od_max": 0.4 * k}
    names = {"signal": "share", "scenario": scenario, "plant": plant, "controller": law, "n": 3}
    return Row.of(names | errors | rest)


def test_shares_stand_beside_their_law_plant_and_scenario_with_what_the_estimate_covers_and_the_density(tmp_path):
    """Laws down, plants across; one law did not run on the second plant; no reading is of a last day."""
    rows = [share_entry("steps", "one", "pi", 1.0), share_entry("steps", "one", "midpoint", 2.0)]
    rows += [share_entry("steps", "two", "midpoint", 3.0), share_entry("sine", "one", "pi", 4.0)]
    at = {"signal": "share", "plant": "one", "controller": "midpoint", "n": 3}
    paired = [
        Row.of({**at, "scenario": "steps", "difference": 0.01, "ci95": [-0.002, 0.03], "lower_in": 1}),
        Row.of({**at, "scenario": "sine", "difference": -0.02, "ci95": [None, None], "lower_in": 3}),
    ]
    out = section()
    page.SECTIONS["share"].add(out, {"rows": rows, "paired": paired, "figures": []}, tmp_path)
    tables = {table.name: (table.columns, [tuple(map(str, row)) for row in table.rows]) for table in out.tables}
    two = ("controller", "one", "two")
    assert tables.pop("steps_ratio_abs_error_mean") == (two, [("pi", "0.01", "–"), ("midpoint", "0.02", "0.03")])
    assert tables.pop("steps_ratio_abs_error_last2h") == (two, [("pi", "0.02", "–"), ("midpoint", "0.04", "0.06")])
    assert tables.pop("steps_estimate") == (two, [("pi", "0.03, 9 %", "–"), ("midpoint", "0.06, 18 %", "0.09, 27 %")])
    density = [("pi", "0.100, 0.200, 0.400", "–"), ("midpoint", "0.200, 0.400, 0.800", "0.300, 0.600, 1.200")]
    assert tables.pop("steps_od") == (two, density)
    assert tables.pop("steps_paired")[1] == [("midpoint", "+0.0100 [-0.0020, +0.0300], lower in 1 of 3")]
    assert tables.pop("sine_paired")[1] == [("midpoint", "-0.0200, lower in 3 of 3")]
    assert tables.pop("sine_ratio_abs_error_mean") == (("controller", "one"), [("pi", "0.04")])
    assert set(tables) == {"sine_ratio_abs_error_last2h", "sine_estimate", "sine_od"}
    assert [heading for heading, _ in out.sections[1:]] == ["steps", "sine"]


def paper_row(law: str, scenario: str, window: str, value: float, plant: str = "nominal") -> Row:
    numbers = {"ise_mean": value, "ise_sd": 0.0, "itae_mean": value, "itae_sd": 0.0, "settling_min": 100.0 * value}
    names = {"signal": "density", "controller": law, "plant": plant, "scenario": scenario, "window": window, "n": 5}
    return Row.of(names | numbers)


def test_the_lowest_of_all_controllers_but_the_oracle_is_marked() -> None:
    rows = [paper_row(law, "setpoint_steps", "0.8", k) for k, law in enumerate(("oracle", "mine", "pi", "mpc"), 1)]
    [row] = page.table_2(rows, statistics.ISE).rows
    assert [str(cell)[0] for cell in row[4:] if isinstance(cell, page.Emphasis)] == ["2"]


def test_agents_are_told_apart_by_their_own_regrets(tmp_path: Path) -> None:
    fitted = {"mu": {"value": 0.0312, "ci95": [0.0301, 0.0319], "truth": 0.03}, "pmse_pct": 4.5, "n_used": 300}
    fitted["tau"] = {"value": 0.352, "ci95": [0.331, 0.366], "truth": 0.34}
    agents = {
        "dqn": {"regret_pct": [0.25, 1.5]},
        "dqn_paper": {"regret_pct": [7.0, 3.0]},
        "dqn_adaptive": {"regret_pct": 0.125, "policy": "shipped"},
    }
    out = Page("", "")
    page._learning_section(out, {"figures": [], "agents": agents, "calibration": fitted}, tmp_path)
    first, *each = texts(out)
    numbers = "0.0312 95 0.0301 0.0319 0.03 0.352 95 0.331 0.366 0.34 4.5"
    assert re.findall(r"\d[\d.]*\d|\d", first) == numbers.split()
    assert [(line.split(":")[0], line.rpartition(": ")[2]) for line in each] == [
        ("dqn", "0.25, 1.5."), ("dqn_paper", "7, 3."), ("dqn_adaptive", "0.125.")
    ]  # fmt: skip


def test_the_settling_time_beside_the_paper_s_is_that_of_the_policy_in_the_regulation(tmp_path: Path) -> None:
    rows = [paper_row("pi", "regulation", "0.5", 0.2), paper_row("dqn", "setpoint_steps", "0.8", 0.3)]
    rows.append(paper_row("dqn", "regulation", "0.5", 0.125))
    charts.save(charts.new_figure(2.0, 2.0)[0], tmp_path / "figures", "regulation")
    figure = {"file": "figures/regulation.svg", "title": "", "caption": ""}
    summary: Summary = {"rows": rows, "beside_paper": [], "figures": [figure], "totals": [], "paper_settling_min": 10.0}
    out = Page("", "")
    page._density(out, summary, tmp_path)
    assert texts(out) == [
        "Settling time from 0.7 to 0.5: 12.5 min (median of 5 replicates; "
        "paper: 10 min on average, start and band not stated)."
    ]


def compared(
    name: str, scenarios: tuple[str, ...], laws: tuple[str, ...], plants: tuple[str, ...]
) -> tuple[BenchmarkConfig, list[Trial]]:
    """A study of this name, in scenarios that are all the paper's steps, and its numbered trials."""
    config = load(*STEPS)
    same = dict.fromkeys(scenarios, config.scenarios["setpoint_steps"])
    study = StudyConfig(scenarios, plants, laws)
    config = replace(config, seed=7, scenarios=config.scenarios | same, studies={name: study})
    return config, [trial(config, cell, k) for k, cell in enumerate(cells(config), 1)]


def marks_of(axes: Any, law: str) -> list[float]:
    """Where a law's marks stand, from the first plant to the last."""
    colour, marker = figures.MARKS[law]
    own = [line for line in axes.get_lines() if _dot(line) and line.get_marker() == marker]
    own = sorted((line for line in own if to_hex(line.get_color()) == to_hex(colour)), key=lambda x: x.get_ydata()[0])
    return [float(line.get_xdata()[0]) for line in own]


def test_every_scenario_has_figures_of_its_own_numbers_against_the_adaptive_policy_where_there_is_one() -> None:
    """Two scenarios whose errors differ, which are too many for curves."""
    laws = ("pi", "dqn", "mpc", "dqn_adaptive", "hold")
    config, trials = compared("mine", ("setpoint_steps", "again"), laws, ("bench",))
    summary = studies.summarise(config, trials)
    assert (summary["seed"], summary["replicates"], summary["loops"]) == (7, 2, 10)
    assert {p[statistics.AGAINST] for p in summary["paired"]} == {"dqn", "dqn_adaptive"}
    drawn = {d.name: d for d in studies.draw(config, trials, summary)}
    assert {name: d.title for name, d in drawn.items()} == {
        "plants_setpoint_steps": "Every plant, setpoint_steps", "plants_again": "Every plant, again",
        "differences_setpoint_steps": "Difference to dqn_adaptive, setpoint_steps",
        "differences_again": "Difference to dqn_adaptive, again",
    }  # fmt: skip
    for scenario in ("setpoint_steps", "again"):
        for metric, axes in zip(("ise", "itae"), drawn[f"plants_{scenario}"].figure.axes, strict=True):
            own = [e for e in summary["totals"] if (e.scenario, e.controller) == (scenario, "pi")]
            assert marks_of(axes, "pi") == pytest.approx([e.values[f"{metric}_mean"] for e in own])
        for metric, axes in zip(("ise", "itae"), drawn[f"differences_{scenario}"].figure.axes, strict=True):
            assert axes.get_xlabel() == f"{metric.upper()} minus that of dqn_adaptive, %"
            wanted = {"scenario": scenario, "controller": "mpc", "against": "dqn_adaptive", "metric": metric}
            pairs = [p for p in summary["paired_totals"] if wanted.items() <= p.values.items()]
            of = {p.plant: p[statistics.PERCENT] for p in pairs}
            names = [text.get_text() for text in drawn[f"differences_{scenario}"].figure.axes[0].get_yticklabels()]
            assert marks_of(axes, "mpc") == pytest.approx([of[plant] for plant in names])


def test_a_study_of_the_paper_on_two_plants_leaves_a_file_of_each() -> None:
    """Each vial is off by so many hundredths, half of a thousandth more in the mean."""
    config, trials = compared("setpoint_steps", ("setpoint_steps",), ("pi", "mpc"), ("upset_pump", "bench"))
    drawn = [d for d in studies.draw(config, trials, studies.summarise(config, trials)) if d.name != "table2"]
    names = [f"setpoint_steps_setpoint_steps_{plant}" for plant in ("upset_pump", "bench")]
    assert [d.name for d in drawn] == names
    assert [d.caption.partition(",")[0] for d in drawn] == ["Plant upset_pump", "Plant bench"]
    for k, each in enumerate(drawn):
        for column, axes in enumerate(each.figure.axes[:2]):
            assert axes.get_title() == f"{('pi', 'mpc')[column]}, n = 2"
            asked, found = axes.lines[0].get_ydata()[0], axes.lines[1].get_ydata()[0]
            assert found - asked == pytest.approx(0.01 * (2 * k + column + 1) + 0.0005)
    alone = replace(config, studies={"setpoint_steps": replace(config.studies["setpoint_steps"], plants=("bench",))})
    assert next(d.name for d in studies.draw(alone, trials, studies.summarise(alone, trials))) == "setpoint_steps"


def test_a_figure_stands_in_the_scenario_that_its_title_begins_with(tmp_path: Path) -> None:
    """Rows of a share in two scenarios, one of whose names begins with the other's."""
    rows = [share_entry("steps", "one", law, k) for k, law in enumerate(("pi", "midpoint"), 3)]
    rows.append(share_entry("steps_2", "one", "pi", 5.0))
    shown = []
    for name in ("steps", "steps_2"):
        charts.save(charts.new_figure(2.0, 2.0)[0], tmp_path / "figures", name)
        shown.append({"file": f"figures/{name}.svg", "title": f"{name}: drawn", "caption": f"of {name}"})
    rest = {"beside_paper": [], "totals": [], "paired": [], "paired_totals": [], "agents": {}, "calibration": None}
    numbers: Any = {"loops": 12, "replicates": 3, "seed": 9, "details": [], "figures": shown, "rows": rows, **rest}
    (tmp_path / "summary.json").write_text(json.dumps(statistics.content(numbers)))
    out = page.of_benchmark(tmp_path)
    assert re.findall(r"\d+", out.subtitle) == ["12", "3", "9"]
    sections = dict(out.sections)
    for name in ("steps", "steps_2"):
        assert [content["caption"] for kind, content in sections[name] if kind == "figure"] == [f"of {name}"]
    [(_, words)] = sections["Definitions"]
    assert [term for term, _ in words["pairs"]] == list(comparison.DEFINITIONS)


CONTROLLERS = ("dqn", "pi", "mpc")
ISE = {
    ("setpoint_steps", "0.8"): (0.039, 0.046, 0.035),
    ("setpoint_steps", "0.65"): (0.032, 0.039, 0.092),
    ("setpoint_steps", "0.5"): (0.051, 0.111, 0.117),
    ("temperature_switch", "37"): (0.045, 0.033, 0.032),
    ("temperature_switch", "30"): (0.031, 0.025, 0.042),
}
ITAE = {
    ("setpoint_steps", "0.8"): (12.21, 12.38, 10.44),
    ("setpoint_steps", "0.65"): (11.90, 10.50, 9.38),
    ("setpoint_steps", "0.5"): (7.43, 11.49, 12.98),
    ("temperature_switch", "37"): (12.42, 9.65, 11.60),
    ("temperature_switch", "30"): (11.84, 9.12, 11.54),
}


def ours(factor: float, **more: object) -> list[Row]:
    """Rows of a run whose every value is the paper's times `factor`."""
    return [
        Row.of({
            "signal": "density", "controller": c, "plant": "nominal_noise", "scenario": scenario, "window": window,
            "ise_mean": factor * ISE[scenario, window][k], "ise_sd": 0.0, "ise_ci95": [np.nan, np.nan], "n": 3,
            "itae_mean": factor * ITAE[scenario, window][k], "itae_sd": 0.0, "itae_ci95": [np.nan, np.nan],
        } | more)
        for scenario, window in ISE
        for k, c in enumerate(CONTROLLERS)
    ]  # fmt: skip


def test_every_published_value_is_the_papers():
    found = {(p.scenario, p.window, p.controller): (p.ise, p.itae) for p in TABLE_2}
    assert found == {(*cell, c): (ISE[cell][k], ITAE[cell][k]) for cell in ISE for k, c in enumerate(CONTROLLERS)}
    setpoints = {"0.8": 0.8, "0.65": 0.65, "0.5": 0.5, "37": 0.5, "30": 0.5}
    assert all(p.setpoint == setpoints[p.window] for p in TABLE_2)
    assert SETTLING_MIN == 10.0


def test_published_stands_left_and_ours_right_and_the_lowest_of_the_three_is_marked_on_either_side():
    """Here an oracle, which the paper does not have, is lower; in the first window the paper's own mpc, here pi."""
    rows = ours(2.0) + ours(2.0, controller="oracle", ise_mean=0.001)[::3]
    rows[1] = Row.of({**rows[1].values, "ise_mean": 0.002})
    table = page.table_2(rows, statistics.ISE)
    assert table.columns == (
        "window", "dqn, published", "pi, published", "mpc, published", "dqn, here", "pi, here", "mpc, here",
        "oracle, here", "lowest published", "lowest of the three here",
    )  # fmt: skip
    assert [str(cell) for cell in table.rows[1]] == [
        "OD 0.65", "0.032", "0.039", "0.092", "0.064", "0.078", "0.184", "0.001", "dqn", "dqn",
    ]  # fmt: skip
    marked = [[k for k, cell in enumerate(row) if isinstance(cell, Emphasis)] for row in table.rows[:2]]
    assert (marked, table.rows[0][-2:]) == ([[3, 5], [1, 4]], ("mpc", "pi"))
    itae = page.table_2(ours(2.0), statistics.ITAE)
    assert [str(cell) for cell in itae.rows[3]] == [
        "37 °C", "12.42", "9.65", "11.6", "24.8", "19.3", "23.2", "pi", "pi",
    ]  # fmt: skip
