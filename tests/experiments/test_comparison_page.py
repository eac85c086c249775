"""What stands on the page of a comparison, from numbers made up: each beside its own law, plant and unit."""

from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from experiments.benchmark import _schema
from experiments.cli import frame
from experiments.comparison import figures, page, studies
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.trials import Cell, DensityTrial, Trial, cells
from experiments.reporting.page import Page

FLOOR_RED = "#b00020"


def load(*overrides: str) -> BenchmarkConfig:
    cfg = frame.compose("benchmark", overrides)
    return frame.load(cfg, _schema(cfg))


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
    named = "studies.setpoint_steps.plants=[upset_pump,bench]", "studies.setpoint_steps.controllers=[mpc,pi,dqn]"
    config = load("+experiment=setpoint_steps", *named, "replicates=2")
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
        assert entry["effort_ul_s"] == pytest.approx(of[entry["plant"], entry["controller"]])
    assert [(e["plant"], e["controller"]) for e in summary["totals"]] == [
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


def entry(plant: str, law: str, floor: float) -> dict[str, Any]:
    """As `statistics.totals` has it, of an ISE of 0.05 and an ITAE of 20."""
    found: dict[str, Any] = {"scenario": "day", "plant": plant, "controller": law, "n": 4}
    for metric, mean, noise in (("ise", 0.05, floor), ("itae", 20.0, 1000.0 * floor)):
        found |= {f"{metric}_mean": mean, f"{metric}_sd": 0.1 * mean, f"{metric}_ci95": [0.9 * mean, 1.1 * mean]}
        found |= {f"floor_{metric}": noise, f"clean_{metric}": mean, f"{metric}_median": mean}
    return found | {"clean_steady_abs_error": 0.01, "effort_ul_s": 1.0, "media_ml": 1.0, "held": 0.0}


FLOORS = {"nominal_noise": 0.004, "bench": 0.006, "upset_pump": 0.009, "tired_pump": 0.013}


@pytest.mark.parametrize("laws", [("oracle", "dqn", "pi", "mpc", "hold", "inverse"), ("pi", "mpc", "dqn", "oracle")])
def test_the_noise_floor_is_in_the_unit_and_the_row_of_its_plant(laws: tuple[str, ...]) -> None:
    """In 10^-3 OD^2 min, as everything else in the table of the ISE; a red line at the height of the plant's name."""
    totals = [entry(plant, law, floor) for plant, floor in FLOORS.items() for law in laws]
    out = Page("", "")
    out.section("")
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


def test_differences_are_drawn_by_metric_in_per_cent_of_the_other_s_mean() -> None:
    """Hollow where the interval holds 0; its ends are in per cent as well."""
    entries: list[dict[str, Any]] = []
    for metric, percent in (("ise", {"pi": 25.0, "mpc": -10.0}), ("itae", {"pi": 50.0, "mpc": 5.0})):
        for law, value in percent.items():
            at = {"plant": "bench", "controller": law, "metric": metric, "percent": value, "difference": value / 1000.0}
            unsure = "no difference shown" if value == 5.0 else "higher" if value > 0.0 else "lower"
            entries.append({**at, "ci95": [value / 1000.0 - 0.008, value / 1000.0 + 0.002], "verdict": unsure})
    for axes, found in zip(figures.differences(entries, "dqn").axes, ((25.0, -10.0), (50.0, 5.0)), strict=True):
        dots = [line for line in axes.get_lines() if _dot(line)]
        assert [float(np.asarray(line.get_xdata())[0]) for line in dots] == pytest.approx(found)
        hollow = [to_hex(line.get_markerfacecolor()) == "#ffffff" for line in dots]
        assert hollow == [value == 5.0 for value in found]
        bars = [np.asarray(line.get_xdata(), dtype=float) for line in axes.get_lines() if len(line.get_xdata()) == 2]
        for value in found:
            assert any(np.allclose(bar, [value - 8.0, value + 2.0]) for bar in bars)


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
            at = {"controller": law, "plant": "bench", "scenario": "setpoint_steps", "window": window, "n": 4}
            row: dict[str, Any] = dict(at)
            for metric, values in (("ise", ise), ("itae", itae)):
                mean = values[window][k]
                row |= {f"{metric}_mean": mean, f"{metric}_sd": 0.001, f"{metric}_ci95": [mean, mean]}
                known = (law, window, metric) in sure
                said = {
                    "verdict": "lower" if known else "no difference shown",
                    "ci95": [-0.02, -0.01 if known else 1.0],
                }
                if law != "dqn":
                    paired.append({**at, "against": "dqn", "metric": metric, "difference": beyond[window], **said})
            rows.append(row)
    keys = ("controller", "plant", "scenario", "window")
    summary = {"rows": rows, "paired": paired, "beside_paper": [{k: r[k] for k in keys} for r in rows]}
    out = Page("", "")
    out.section("")
    page._beside_paper(out, summary)
    (said,) = [content for _, blocks in out.sections for kind, content in blocks if kind == "verdict"]
    assert said["claim"].startswith("Of 6 cells here, the learned policy (dqn) loses 3, 2 of them with a 95 %")
    assert len(said["items"]) == 4
    assert said["items"][0].startswith("OD 0.8, ISE: dqn 0.05 loses to mpc 0.03; mpc minus dqn: -0.015, 95 % -0.02 to")
    each = [item.split(" minus dqn: ")[1].split(",")[0] for item in said["items"]]
    assert each == ["-0.015", "-0.015", "-0.012", "-0.018"]
    assert [item.endswith("which holds 0.") for item in said["items"]] == [False, False, False, True]
