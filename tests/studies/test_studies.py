"""The studies, small: each row and cell is of its own runs, and tables are those of numbers made by hand."""

import csv
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dqn.config import DQNConfig
from experiments.cli import frame
from tests.studies import learners, second_vials
from tests.studies.ablate import AblateConfig, Row, ablate, main, summarise
from tests.studies.intervals import IntervalsConfig, intervals, one, row
from tests.studies.learners import Job, LearnersConfig
from tests.studies.second_vials import Conditions, nominal
from tests.studies.supervision import SupervisionConfig, supervision
from tests.studies.two_species import (
    CELLS,
    COMPOSITION,
    RIVALS,
    STEPS,
    WARM_UP_MIN,
    TwoSpeciesConfig,
    better,
    compared,
    daily,
    difference,
    flown,
    two_species,
)

pytestmark = pytest.mark.numeric

SHORT = ["agent.total_steps=60", "agent.learn_start=30", "agent.epsilon_steps=30", "agent.batch_size=16",
         "eval_every=60", "n_agents=2"]  # fmt: skip


def _plain(agent: DQNConfig) -> str:
    """As JSON, in which a list and a tuple are the same."""
    return json.dumps(asdict(agent))


def _rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "ablation.csv", newline="") as f:
        return list(csv.DictReader(f))


@pytest.mark.slow
def test_a_study_leaves_table_summary_and_figure_and_resumes(tmp_path: Path) -> None:
    config = main.config([*SHORT, "only=[tuned,mine]", "+ablations.mine={action_gap: 0.0, batch_size: 8}"])
    ablate(config, tmp_path)
    rows = _rows(tmp_path)
    assert [(r["ablation"], r["seed"]) for r in rows] == [("tuned", "0"), ("tuned", "1"), ("mine", "0"), ("mine", "1")]
    assert rows[0]["regret_pct"] != rows[2]["regret_pct"]
    summary = json.loads((tmp_path / "summary.json").read_text())
    regret = [float(r["regret_pct"]) for r in rows if r["ablation"] == "mine"]
    assert summary["ablations"]["mine"]["regret_pct"]["worst"] == pytest.approx(max(regret))
    assert summary["ablations"]["mine"]["regret_pct"]["median"] == pytest.approx(float(np.median(regret)))
    assert len((tmp_path / "table.md").read_text().splitlines()) == 4
    assert (tmp_path / "figures" / "ablation.png").stat().st_size > 5000

    kept = [line for line in (tmp_path / "ablation.csv").read_text().splitlines() if not line.startswith("mine")]
    (tmp_path / "ablation.csv").write_text("\n".join(kept) + "\n")
    ablate(replace(config, resume=str(tmp_path)), tmp_path)
    assert [r["regret_pct"] for r in _rows(tmp_path)] == [r["regret_pct"] for r in rows]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("only=[nothing]", "only = nothing: allowed tuned"),
        ("+ablations.mine={doubled: true}", r"ablations\.mine\.doubled"),
        ("+ablations.mine={gamma: 2.0}", r"ablations\.mine: agent\.gamma = 2\.0"),
        ("+ablations={bad/name: {}}", r"ablations\.bad/name"),
    ],
)
def test_mistakes_are_one_line(override: str, message: str) -> None:
    with pytest.raises((frame.UserError, ValueError), match=message) as caught:
        main.config([override])
    assert "\n" not in str(caught.value)


def test_every_shipped_variant_differs_from_the_agent_it_starts_from() -> None:
    config = main.config()
    for name, values in config.ablations.items():
        assert (_plain(config.training(name).agent) != _plain(config.agent)) == bool(values), name
    paper = frame.load(frame.compose("ablate", ["agent=paper"]), AblateConfig(ablations={"paper": {}}))
    assert _plain(config.training("paper").agent) == _plain(paper.agent)


def test_summary_by_hand() -> None:
    rows = [Row("a", k, float(k), 0.001 * k, 1.0, 0.0, 5.0) for k in range(5)]
    entry = summarise(rows)["a"]
    assert entry["seeds"] == 5
    assert entry["regret_pct"] == {"median": 2.0, "iqm": 2.0, "worst": 4.0}
    assert entry["steady_abs_error"]["worst"] == pytest.approx(0.004)


@pytest.mark.slow
def test_a_table_for_each_simulator_with_a_row_for_each_kind(tmp_path: Path) -> None:
    config = IntervalsConfig(2, 2, ("threshold", "proportional"), (2.0, 3.0), (0.05,), workers=1)
    intervals(config, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    for name in ("own", "second"):
        cells = [
            [c.strip() for c in line.split("|")[1:-1]] for line in (tmp_path / f"{name}.md").read_text().splitlines()
        ]
        kinds = [["threshold", "2"], ["threshold", "3"], ["proportional", "2"], ["proportional", "3"]]
        assert [line[:2] for line in cells[2:]] == kinds
        assert {line[2] for line in cells[2:]} == {"5 %"}
        assert [line[3].partition(" of ")[2] for line in cells[2:]] == ["2"] * 4
        assert cells[4][3:7] == cells[5][3:7] == ["0 of 2", "–", "–", "–"]
    own, second = summary["found"][:4], summary["found"][4:]
    assert own[1]["median_bias_pct"] != second[1]["median_bias_pct"]  # no draw is shared
    assert own[1] == one("threshold", 3.0, 0.05, 2, 1, "own")
    for each in (own[1], second[1]):
        assert abs(each["median_bias_pct"]["mu"]) < 3 * each["relative_half_width_pct"]["mu"]


def test_a_row_names_mu_before_tau() -> None:
    numbers = {
        "recordings": 8, "refused": 3, "wrong_pct": 12.5, "coverage_pct": {"mu": 80.0, "tau": 100.0},
        "median_bias_pct": {"mu": -1.26, "tau": 0.5}, "relative_half_width_pct": {"mu": 4.0, "tau": 5.04},
    }  # fmt: skip
    said = ("device's PI", "24", "10 %", "5 of 8", "80.0 / 100.0", "-1.3 / +0.5", "4.0 / 5.0", "12.5")
    assert row(("pi", 24.0, 0.1), numbers) == said


@pytest.fixture
def two_tasks(monkeypatch: pytest.MonkeyPatch) -> LearnersConfig:
    """A law of regret 4 in the first task and of .25 in the second."""
    regret = {"sim": "4", "coculture_preview": "0.25"}
    monkeypatch.setattr(
        learners, "laws", lambda task: [[learners.TASKS[task], "law", "–", regret[task], "–", "0.1", "–"]]
    )
    return LearnersConfig(("sim", "coculture_preview"), ("ppo",), (2000,), ("ppo",), 9000, ("hindsight",), 3)


def test_short_trainings_come_first_and_each_has_all_seeds(two_tasks: LearnersConfig) -> None:
    asked = learners.jobs(two_tasks)
    kinds = list(dict.fromkeys((job.task, job.learner, job.steps) for job in asked))
    assert kinds == [
        ("sim", "ours", 2000), ("sim", "ppo", 2000), ("coculture_preview", "ours", 2000),
        ("coculture_preview", "ppo", 2000), ("sim", "ours", 0), ("coculture_preview", "ours", 0),
        ("coculture_preview", "without hindsight", 0), ("sim", "ppo", 9000), ("coculture_preview", "ppo", 9000),
    ]  # fmt: skip
    assert len(asked) == 3 * len(kinds) == len({job.name for job in asked})


def test_rows_are_medians_in_order_of_regret_and_one_that_lacks_a_seed_is_left_out(two_tasks: LearnersConfig) -> None:
    def found(task: str, learner: str, steps: int, *regrets: float) -> dict[Job, dict[str, float]]:
        each = {"steady": 0.02, "cpu_s": 7.0, "steps": float(steps or 2000)}
        return {Job(task, learner, steps, k): {"regret_pct": r} | each for k, r in enumerate(regrets)}

    known = found("sim", "ours", 2000, 0.5, 90.0, 0.1) | found("sim", "ours", 0, 0.5, 90.0, 0.1)  # the same training
    known |= found("sim", "ppo", 2000, 30.0, 10.0, 20.0) | found("coculture_preview", "ppo", 2000, 1.0, 2.0)
    known |= found("coculture_preview", "without hindsight", 0, 8.0, 9.0, 7.0)
    rows = learners.table(two_tasks, known)
    assert [row[:5] for row in rows] == [
        ["Bioreactor-v0", "this program's DQN", "2000", "0.5", "90"],
        ["Bioreactor-v0", "law", "–", "4", "–"],
        ["Bioreactor-v0", "SB3 PPO", "2000", "20", "30"],
        ["CoculturePreview-v0", "law", "–", "0.25", "–"],
        ["CoculturePreview-v0", "this program's DQN without hindsight", "2000", "8", "9"],
    ]
    assert rows[2][5:] == ["0.02", "7"]


def test_regrets_stand_beside_each_other_by_task_and_the_hardest_task_orders_them() -> None:
    """Our agent's own steps are 10,000 for the density and 20,000 with a preview; the law has no seeds."""
    ours, sim, preview = learners.OURS, "Bioreactor-v0", "CoculturePreview-v0"
    rows = [
        [sim, "law", "–", "0", "–", "0.1", "–"],
        [sim, ours, "10000", "0.5", "0.9", "0.1", "7"],
        [sim, "PPO", "10000", "30", "40", "0.1", "7"],
        [preview, f"{ours} without hindsight", "20000", "8", "9", "0.1", "7"],
        [preview, "PPO", "10000", "20", "21", "0.1", "7"],
        [preview, ours, "10000", "4", "5", "0.1", "7"],
        [preview, ours, "20000", "3", "4", "0.1", "7"],
    ]
    head, found = learners.by_task(rows)
    assert head == ["policy", "steps", sim, preview]
    assert found == [
        [ours, "its own", "0.5 (0.9)", "3 (4)"],
        [ours, "10000", "0.5 (0.9)", "4 (5)"],
        [f"{ours} without hindsight", "its own", "–", "8 (9)"],
        ["PPO", "10000", "30 (40)", "20 (21)"],
        ["law", "–", "0", "–"],
    ]


@pytest.mark.slow
def test_a_blinded_filter_rests_elsewhere_unless_it_is_watched(tmp_path: Path) -> None:
    supervision(SupervisionConfig(vials=4, hours=1.5, plants=("nominal_noise",)), tmp_path)
    found = json.loads((tmp_path / "summary.json").read_text())
    sound, watched, unwatched, law = (float(row[1]) for row in found["blinded"])
    assert watched < 1.2 * sound < 0.005
    assert min(unwatched, law) > 0.03
    assert float(found["blinded"][1][2]) > 95.0
    assert 0.0 <= found["false_alarms_a_day"]["alarms"] <= found["false_alarms_a_day"]["decisions"] < 40.0
    assert [row[0] for row in found["costs"]] == ["nominal_noise, steps", "nominal_noise, switch"]


def test_each_row_and_cell_is_of_its_own_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of a known error: .01 for the first law, .02 for the second ..., twice that where E. coli grows faster.

    In the first table the estimate is off by .04 with samples, .02 without a calibration, else by .01; the band holds
    the truth in every minute of a program with steps, and in a quarter of another one. The first hour counts for none.
    """

    def flown(conditions: Conditions, law: str, program: str, hours: float, seed: int, samples: int = 0) -> Any:
        minutes, zero = round(60.0 * hours), np.zeros((round(60.0 * hours), conditions.n))
        off = 0.01 * (1 + RIVALS.index(law)) * np.where(np.asarray(conditions.scale_e) == 1.2, 2.0, 1.0)
        off = np.where(np.arange(minutes)[:, None] < WARM_UP_MIN, 0.9, zero + off)
        error = 0.04 if samples else 0.01 if conditions.calibrated else 0.02
        inside = zero + (np.arange(minutes)[:, None] % 4 == 0) * 1.0 if program == "hold" else zero + 1.0
        told.append((law, program, hours, seed, samples))
        return SimpleNamespace(share=off, setpoint=zero, estimate=off + error, low=off, high=off + 2.0 * inside - 1.0)

    told: list[tuple[str, str, float, int, int]] = []
    study = "tests.studies.two_species"
    monkeypatch.setattr(f"{study}.CELLS", {key: CELLS[key] for key in ("nominal", "mu_e x 1.2")})
    monkeypatch.setattr(f"{study}.STEPS", ("quick",))
    monkeypatch.setattr(f"{study}.flown", flown)
    monkeypatch.setattr(f"{study}.Workers", ThreadPoolExecutor)  # in this process
    two_species(TwoSpeciesConfig(vials=3, days=2, hours=9.0, workers=1, seed=4), tmp_path)
    days = [(COMPOSITION, program, 48.0, 4, samples) for program, samples in
            (("hold", 0), ("ratio_steps", 0), ("hold", 0), ("ratio_steps", 0), ("hold", 2))]  # fmt: skip
    assert told == days + [(law, "quick", 9.0, 4, 0) for _ in range(2) for law in RIVALS]
    lines = [(tmp_path / f"{name}.md").read_text().splitlines() for name in ("week", "laws")]
    week, laws = ([[cell.strip() for cell in line.split("|")[1:-1]] for line in table] for table in lines)
    hold, steps = (["25 %, {}"] * 2, ["100 %, {}"] * 2)
    rows = (("calibrated, hold", hold, ".010"), ("calibrated, ratio_steps", steps, ".010"),
            ("not calibrated, hold", hold, ".020"), ("not calibrated, ratio_steps", steps, ".020"),
            ("not calibrated, hold, 2 samples a day", hold, ".040"))  # fmt: skip
    assert week[2:] == [[name, *(cell.format(f"0{error}") for cell in cells)] for name, cells, error in rows]
    assert [line[:2] for line in laws[2:]] == [["quick", "nominal"], ["quick", "mu_e x 1.2"]]
    found = json.loads((tmp_path / "summary.json").read_text())["errors"]
    for k, each in enumerate(found):
        assert each == {law: [pytest.approx(0.01 * (1 + n) * (1 + k))] * 3 for n, law in enumerate(RIVALS)}
    assert len(STEPS) * len(CELLS) == 24


def test_a_law_flies_on_the_other_simulator_from_its_first_minute_on_with_the_samples_of_each_day(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Any] = []
    run = second_vials.run
    monkeypatch.setattr(second_vials, "run", lambda *a, **k: (given.append(k["samples"]), run(*a, **k))[1])
    trace = flown(nominal(2), "dqn_preview", "quick", 0.5, 1)
    assert trace.share.shape == (30, 2)
    assert np.isfinite(trace.estimate).all()
    monkeypatch.setattr(second_vials, "run", lambda *a, **k: given.append(k["samples"]))
    flown(nominal(2), "pi", "hold", 48.0, 1, samples=2)
    assert given == [[], [6.0, 18.0, 30.0, 42.0]]


def test_better_is_an_interval_that_excludes_none() -> None:
    found = {law: [0.05, 0.06, 0.07, 0.05] for law in RIVALS}
    found["pi"] = [0.06, 0.08, 0.08, 0.06]
    found["receding"] = [0.04, 0.05, 0.06, 0.03]
    found["dqn_preview"] = [0.01, 0.06, 0.09, 0.05]
    mean, half = difference(found, "receding")
    assert mean == pytest.approx(-0.0125)
    assert half == pytest.approx(1.96 * 0.005 / 2.0)  # sd of -.01, -.01, -.01, -.02
    assert [law for law in RIVALS if better(found, law)] == ["receding"]
    assert compared(found)[0] == "0.0575"
    assert compared(found)[1] == "0.0450 (-0.0125 ± 0.0049)"
    assert daily({"coverage_pct": [95.4, 90.0], "error": [0.01, 0.0204]}) == ["95 %, 0.010", "90 %, 0.020"]
