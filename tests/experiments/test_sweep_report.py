"""The comparison page of a sweep, from numbers made up here: statistics by hand, jobs without a result by name."""

import csv
import json
import re
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from experiments import report
from experiments.cli import frame, sweep
from experiments.reporting import sweep_page, sweep_results
from experiments.reporting.page import Page
from experiments.reporting.tables import Emphasis


def job(folder: Path, overrides: list[str], state: str = "finished", error: str = "", **summary: Any) -> None:
    """A job's folder as a run leaves it."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra/overrides.yaml").write_text("".join(f"- {line}\n" for line in overrides))
    objective = summary.pop("objective", None)
    (folder / "job.json").write_text(json.dumps({"state": state, "config": "", "objective": objective, "error": error}))
    if state == "finished":
        (folder / "summary.json").write_text(json.dumps(summary))
        (folder / "config.yaml").write_text("env: {kind: density}\n")


def training(folder: Path, agent: str, seed: int, regret: list[float]) -> None:
    seeds = list(range(seed, seed + len(regret)))
    words = [f"agent={agent}", f"++seed={seed}", f"++n_agents={len(regret)}"]
    job(folder, words, objective=max(regret), seeds=seeds, regret_pct=regret, steady_abs_error=regret)
    learned(folder, seeds, regret)


def learned(folder: Path, seeds: list[int], regret: list[float]) -> None:
    """The curves of a training."""
    rows = [
        f"{step},{s},eval/regret_pct,{r * 100 / step}"
        for step in (100, 200)
        for s, r in zip(seeds, regret, strict=True)
    ]
    (folder / "progress.csv").write_text("\n".join(["step,seed,tag,value", *rows, ""]))


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """Two agents over two jobs of two seeds each, a job that failed, and one that never began."""
    arguments = ["agent=tuned,paper", "seed=0,2,4", "n_agents=2"]
    (tmp_path / "sweep.json").write_text(json.dumps({"command": "train", "arguments": arguments}))
    training(tmp_path / "0", "tuned", 0, [1.0, 2.0])
    training(tmp_path / "1", "tuned", 2, [3.0, 10.0])
    job(tmp_path / "2", ["agent=tuned", "++seed=4", "++n_agents=2"], "failed", "the disk is full")
    training(tmp_path / "3", "paper", 0, [20.0, 30.0])
    training(tmp_path / "4", "paper", 2, [40.0, 50.0])
    return tmp_path


def table(folder: Path, name: str) -> list[dict[str, str]]:
    with open(folder / "tables" / f"{name}.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_seeds_are_pooled_and_the_best_configuration_comes_first(trained: Path) -> None:
    """Of 1, 2, 3, 10: median 2.5, interquartile mean (2 + 3) / 2, worst 10."""
    text = report.compare(trained).read_text(encoding="utf-8")
    rows = table(trained, "configurations_regret_pct")
    assert [row["agent"] for row in rows] == ["tuned", "paper"]
    assert [(row["n"], row["median"], row["IQM"], row["worst"]) for row in rows] == [
        ("4", "2.5", "2.5", "10"), ("4", "35", "35", "50"),
    ]  # fmt: skip
    ends = [[float(end) for end in row["95 % of IQM"].split(" to ")] for row in rows]
    assert [low < middle < high for (low, high), middle in zip(ends, (2.5, 35.0), strict=True)] == [True, True]
    assert "Of 2 configurations, agent tuned is best" in text
    assert "4 of 6 jobs finished" in text
    assert "python -m experiments.train -m agent=tuned seed=0,2 n_agents=2" in text
    missing = [
        tuple(row[key] for key in ("job", "state", "error", "overrides")) for row in table(trained, "missing_jobs")
    ]
    assert missing == [
        ("2", "failed", "the disk is full", "agent=tuned seed=4 n_agents=2"),
        ("5", "missing", "–", "agent=paper seed=4 n_agents=2"),
    ]
    assert f"python -m experiments.train -m resume={trained}" in text
    assert (trained / "figures/learning_regret_pct.svg").is_file()
    assert "<script" not in text


def test_a_seed_that_two_jobs_trained_has_a_curve_of_each(tmp_path: Path) -> None:
    for k, regret in enumerate((4.0, 9.0)):
        (tmp_path / str(k)).mkdir()
        learned(tmp_path / str(k), [5], [regret])
    jobs = [sweep_results.Result(tmp_path / str(k), {}, "finished") for k in range(2)]
    np.testing.assert_array_equal(sweep_results.curve(jobs, "eval/regret_pct")[1], [[4.0, 9.0], [2.0, 4.5]])


def test_seeds_that_were_evaluated_at_other_steps_leave_a_gap_and_keep_their_column(tmp_path: Path) -> None:
    """Seed 7 at steps 100 and 300, seed 3 at 200 and 300; another tag and a torn line are none of them."""
    for k, (seed, values) in enumerate(((7, {100: 4.0, 300: 2.0}), (3, {200: 9.0, 300: 8.0}))):
        (tmp_path / str(k)).mkdir()
        lines = [f"{at},{seed},eval/regret_pct,{value}" for at, value in values.items()]
        lines += [f"100,{seed},train/loss,5.0", f"400,{seed},eval/reg"]
        (tmp_path / str(k) / "progress.csv").write_text("\n".join(["step,seed,tag,value", *lines]))
    jobs = [sweep_results.Result(tmp_path / str(k), {}, "finished") for k in range(3)]
    steps, values = sweep_results.curve(jobs, "eval/regret_pct")
    np.testing.assert_array_equal(steps, [100, 200, 300])
    np.testing.assert_array_equal(values, [[4.0, np.nan], [np.nan, 9.0], [2.0, 8.0]])


def test_the_first_of_the_ranking_stands_out_with_its_place_and_what_has_no_number_comes_last() -> None:
    """Errors at rest differ in their order; one configuration has none, and one value has no interval."""
    found = {"b": [4.0, 1.0, 1.0, 3.0, 1.0], "a": [5.0], "c": []}
    jobs = [
        sweep_results.Result(Path(name), {"agent": name, "seed": str(k)}, "finished", objective=value)
        for name, values in (("c", found["c"]), ("a", found["a"]), ("b", found["b"]))
        for k, value in enumerate(values or [None])
    ]
    ranked, _ = sweep_results.configurations(jobs)
    out = Page("", "")
    out.section("")
    sweep_page._tables(out, ranked, lambda name: f"<{name}>", "note")
    each, _ = out.tables
    assert (each.title, each.columns) == (
        "Configurations, best first: <objective>", ("#", "agent", "n", "median", "IQM", "95 % of IQM", "worst"),
    )  # fmt: skip
    assert [(*row[:5], row[6]) for row in each.rows] == [
        ("#1", "b", "5", "1", "1.67", "4"), ("#2", "a", "1", "5", "5", "5"), ("#3", "c", "–", "–", "–", "–"),
    ]  # fmt: skip
    assert [row[5] for row in each.rows[1:]] == ["–", "–"]
    assert [[isinstance(cell, Emphasis) for cell in row] for row in each.rows] == [[True] * 7, [False] * 7, [False] * 7]


def test_figures_have_the_best_eight_and_the_values_of_their_own_measure(tmp_path, monkeypatch):
    """Ten configurations, of which the third has no medium and the last two are in the table alone."""
    measured = [{"ise": np.array([k, k + 0.5]), "volume_ml": np.array([9.0 - k])} for k in range(10)]
    del measured[2]["volume_ml"]
    ranked = [sweep_results.Configuration({"agent": f"{k}"}, [], each) for k, each in enumerate(measured)]
    picture = tmp_path / "values.png"
    picture.with_suffix(".svg").write_text("<svg")
    monkeypatch.setattr(sweep_page, "values", values := Mock())
    monkeypatch.setattr(sweep_page.charts, "save", lambda figure, folder, name: picture)
    out = Page("", "")
    sweep_page._figures(out, tmp_path, ranked, lambda name: f"<{name}>")
    drawn = [({key: v.tolist() for key, v in each.items()}, name) for each, name in (c.args for c in values.mock_calls)]
    assert drawn == [
        ({f"agent {k}": [k, k + 0.5] for k in range(8)}, "<ise>"),
        ({f"agent {k}": [9.0 - k] for k in range(8) if k != 2}, "<volume_ml>"),
    ]
    [(_, shown)] = out.sections
    assert [content["title"].partition(": ")[2] for _, content in shown] == ["<ise>", "<volume_ml>"]
    assert ["best 8 of 10" in content["caption"] for _, content in shown] == [True, True]


def test_a_sweep_of_another_task_has_its_unit_on_the_page(tmp_path: Path) -> None:
    """The task of the jobs that finished; the first one failed and says nothing of it."""
    job(tmp_path / "0", ["agent=a"], "failed", "no disk")
    for k, agent in ((1, "b"), (2, "c")):
        job(tmp_path / str(k), [f"agent={agent}"], seeds=[0], regret_pct=[1.0 * k], steady_abs_error=[0.1])
        (tmp_path / str(k) / "config.yaml").write_text("env: {kind: coculture}\n")
    text = report.compare(tmp_path).read_text(encoding="utf-8")
    assert "steady error at the worst setpoint, of the share" in text
    assert "2 of 3 jobs finished" in text


def test_a_closed_loop_is_judged_by_its_worst_window(tmp_path: Path) -> None:
    """Two windows of M0 and one of M1, each of whose costs differ; costs are those of a reactor's whole schedule."""
    for k, (law, errors) in enumerate({"pi": [0.01, 0.03], "mpc": [0.02, 0.02]}.items()):
        windows = [
            {"reactor": name, "ise": ise, "itae": itae, "steady_abs_error": e}
            for name, ise, itae, e in (("M0", 1.0, 2.0, errors[0]), ("M0", 3.0, 5.0, errors[1]), ("M1", 0.5, 6.0, 0.01))
        ]
        reactors = {"M0": {"volume_ml": 60.0 + k}, "M1": {"volume_ml": 50.0}}
        job(tmp_path / str(k), [f"controller={law}"], windows=windows, reactors=reactors)
    report.compare(tmp_path)
    rows = table(tmp_path, "configurations")
    told = ("controller", *(f"{name}: worst" for name in ("steady_abs_error", "ise", "itae")), "volume_ml: n")
    assert [tuple(row[key] for key in told) for row in rows] == [
        ("mpc", "0.02", "4", "7", "2"), ("pi", "0.03", "4", "7", "2"),
    ]  # fmt: skip
    assert [(row["ise: median"], row["itae: median"], row["volume_ml: worst"]) for row in rows] == [
        ("2.25", "6.5", "61"), ("2.25", "6.5", "60"),
    ]  # fmt: skip


def test_of_twelve_jobs_the_one_that_returned_nothing_is_best_and_the_others_follow_by_number(tmp_path: Path) -> None:
    """Job 10 returned 0, the others 1; the last two never ran."""
    arguments = [f"env.mu={','.join(f'0.0{10 + k}' for k in range(14))}"]
    (tmp_path / "sweep.json").write_text(json.dumps({"command": "train", "arguments": arguments}))
    for k in range(12):
        job(tmp_path / str(k), [f"++env.mu=0.0{10 + k}"], objective=0.0 if k == 10 else 1.0, loss=1.0)
    text = report.compare(tmp_path).read_text(encoding="utf-8")
    assert "Of 12 configurations, mu 0.02 is best" in text
    rows = table(tmp_path, "configurations_objective")
    assert [row["env.mu"] for row in rows] == ["0.02", *(f"{0.01 + 0.001 * k:.4g}" for k in range(12) if k != 10)]
    assert [row["job"] for row in table(tmp_path, "missing_jobs")] == ["12", "13"]


def test_of_a_search_the_values_of_its_jobs_are_those_of_the_command_line(tmp_path: Path) -> None:
    """The preset says n_agents=4, the command 2; what the preset alone says stands beside it."""
    words = ["+hparams_search=tuned", "agent.total_steps=300", "++agent.huber=0.02", "hydra.sweep.subdir=0"]
    for k, more in enumerate(([], ["n_agents=2"], ["++n_agents=3"])):
        job(tmp_path / str(k), [*words, *more], objective=1.0, loss=1.0)
    found = [report._result(each).overrides for each in sweep.survey(tmp_path)]
    assert [each["n_agents"] for each in found] == ["4", "2", "3"]
    for each in found:
        assert each | {"n_agents": ""} == {"n_agents": "", "agent.total_steps": "300", "agent.huber": "0.02"}


def test_the_interval_is_one_of_95_per_cent() -> None:
    """Three draws of 0, 1, 1 are all 0 in 1 of 27 cases: 3.7 %, more than 2.5 and less than 5.

    The middle three of five draws of 0, 1, 1, 1, 1 are 0 if four are, in 21 of 3125 cases, and hold at least two zeros
    if three are, in 160: 0.7 and 5.8 %, about 2.5 as well.
    """
    five = np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    for values, end in ((np.array([0.0, 1.0, 1.0]), 0.0), (five, 1.0 / 3.0)):
        low, high = sweep_results.statistics(values).interval
        assert (low, high) == pytest.approx((end, 1.0))
        low, high = sweep_results.statistics(1.0 - values).interval
        assert (low, high) == pytest.approx((0.0, 1.0 - end))


def compared(folder: Path, **regrets: list[float]) -> str:
    """The page of a configuration per agent with these regrets of its seeds, which returned no objective."""
    for k, (agent, regret) in enumerate(regrets.items()):
        seeds = list(range(len(regret)))
        job(folder / str(k), [f"agent={agent}"], seeds=seeds, regret_pct=regret, steady_abs_error=regret)
        learned(folder / str(k), seeds, regret)
    return report.compare(folder).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("second", "apart"), [([5.0, 6.0, 7.0], True), ([2.5, 3.5, 4.5], False), ([0.5, 2.0, 9.0], False), ([3.5], True)]
)
def test_a_winner_whose_interval_meets_that_of_the_next_is_said_to_be_none(second, apart, tmp_path):
    """The interval of 1, 2 and 3 is from 1 to 3, which the next one's begins below or above; one seed has none."""
    text = compared(tmp_path, a=[1.0, 2.0, 3.0], b=second)
    assert "Of 2 configurations, agent a is best. Worst regret against the optimum, %: 3 (" in text
    assert f"; second-best configuration: {max(second):g}" in text
    assert ("no significant difference" not in text) == apart


@pytest.mark.parametrize(("worst", "said"), [(0.4, "met"), (1.0, "met"), (1.3, "not met")])
def test_the_merit_of_the_best_is_judged_against_the_limits_of_the_task(worst: float, said: str) -> None:
    ranked = [sweep_results.Configuration({}, [], {"objective": np.array([0.2, value])}) for value in (worst, 7.0)]
    for command, judged in (("train", [said]), ("deploy", [])):
        text = sweep_page._headline(ranked, [], partial(sweep_results.label, task="density", command=command))
        assert re.findall("the task's limit: ((?:not )?met)", text) == judged


@pytest.mark.parametrize(
    ("measure", "task", "command", "said"),
    [
        ("steady_abs_error", "density", "train", ", OD"), ("steady_abs_error", "coculture", "train", ", of the share"),
        ("steady_abs_error", "relative", "train", ", periods of full pump"),
        ("objective", "density", "train", "each divided by its limit)"),
        ("objective", "density", "deploy", "of the command"), ("my_number", "density", "mine", "my_number"),
        ("itae", "density", "deploy", "ITAE over all windows, OD min²"),
    ],
)  # fmt: skip
def test_a_measure_is_called_by_its_unit(measure: str, task: str, command: str, said: str) -> None:
    assert sweep_results.label(measure, task, command).endswith(said)


def test_what_differs_names_a_configuration_and_what_all_share_is_said_once() -> None:
    """Seeds differ within a configuration; a list of numbers is one value."""
    shared = {"fsync": "false", "setpoints": "[0.4,0.5]"}
    found = ((0.02, "pi", 1, 3.0), (0.02, "pi", 2, 5.0), (0.03, "pi", 1, 4.0), (0.02, "mpc", 1, 6.0))
    jobs = [
        sweep_results.Result(
            Path(str(k)),
            {"env.mu": str(mu), "controller": law, "plant.seed": str(seed), **shared},
            "finished",
            "",
            cost,
        )
        for k, (mu, law, seed, cost) in enumerate(found)
    ]
    ranked, common = sweep_results.configurations(jobs)
    assert [(one.name, one.measured["objective"].tolist()) for one in ranked] == [
        ("mu 0.03, controller pi", [4.0]), ("mu 0.02, controller pi", [3.0, 5.0]), ("mu 0.02, controller mpc", [6.0]),
    ]  # fmt: skip
    assert common == shared
    assert sweep_page.repeats("deploy", ranked[1]) == (
        "python -m experiments.deploy -m env.mu=0.02 controller=pi plant.seed=1,2 fsync=false 'setpoints=[0.4,0.5]'"
    )
    assert sweep_page.repeats("deploy", ranked[0]).startswith("python -m experiments.deploy env.mu=0.03 controller=pi")


def test_a_folder_without_a_sweep_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(frame.UserError, match=r"no job of a sweep in this folder; give a folder written by train -m"):
        report.compare(tmp_path)
