"""What a report says first: what was run, what came out, and whether that is good, from a run's own numbers."""

from pathlib import Path

import pytest

from experiments import report
from experiments.cli import files
from experiments.reporting.verdict import verdict

TRAINED = {
    "seeds": [4, 5], "regret_pct": [0.2, 0.4], "steady_abs_error": [0.001, 0.002], "env_steps": 20000,
    "train_seconds": 31.4, "myopic_regret_pct": 0.01, "myopic_steady_abs_error": 0.001,
}  # fmt: skip
MODEL = {"env": {"mu": 0.02, "tau": 0.5}}
WINDOW = {"setpoint": 0.5, "steady_abs_error": 0.004}
DEPLOYED = {
    "outcome": "completed", "minutes": 90.0, "volume_ml": 65.0, "windows": [WINDOW, {**WINDOW, "setpoint": 0.8}],
    "reactors": {"M0": {"interlock": 2}, "M1": {"interlock": 1}},
}  # fmt: skip
LOOP = {"controller": {"kind": "pi"}, "backend": {"kind": "chibio"}}


def test_a_training_is_judged_by_its_worst_agent() -> None:
    said = verdict(TRAINED, MODEL)
    assert said.claim == "Training: 2 agents learned mu 0.02 1/min, tau 0.5 for 20000 steps in 31 s."
    assert said.items[:2] == [
        "regret of the worst agent 0.4 %: what the policy costs beyond the exact optimum",
        "error at rest at its worst setpoint of the worst agent 0.002 OD",
    ]
    assert said.remark == "Good: the regret is within the limit of 0.5 %, the error within that of 0.003 OD."


@pytest.mark.parametrize(
    ("found", "remark"),
    [
        ({"regret_pct": [0.2, 0.6]}, "the regret is beyond the limit of 0.5 %, the error within that of 0.003 OD."),
        ({"steady_abs_error": [0.004, 0.0]}, "the regret is within the limit of 0.5 %, the error beyond that of"),
    ],
)
def test_one_agent_beyond_a_limit_is_not_good(found: dict[str, list[float]], remark: str) -> None:
    said = verdict(TRAINED | found, MODEL)
    assert said.remark.startswith(f"Not good yet: {remark}")


def test_errors_of_other_tasks_are_not_called_od() -> None:
    said = verdict(TRAINED, {"env": {"kind": "coculture"}})
    assert said.items[1].endswith("0.002 of the share")
    assert said.remark == ""


def test_a_deployment_is_good_if_every_window_ends_at_its_setpoint() -> None:
    said = verdict(DEPLOYED, LOOP)
    assert said.claim == "Deployment: pi held M0, M1 on the Chi.Bio for 1.5 h; completed."
    units, own = (verdict(DEPLOYED, LOOP | {"backend": {"kind": kind}}) for kind in ("pioreactor", "mine"))
    assert "on Pioreactors for" in units.claim
    assert "on the reactors of mine for" in own.claim
    assert said.items == [
        "largest error at rest 0.004 OD, the mean over the last 10 min of a window",
        "fresh medium 65 mL",
        "interlock spoke in 3 samples",
    ]
    assert said.remark == "Good: 2 of 2 windows ended within 5 % of their setpoint."
    away = {**WINDOW, "steady_abs_error": 0.026}  # 5 % of 0.5 is 0.025
    missing = {**WINDOW, "steady_abs_error": None}
    for windows, held in (([WINDOW, away], "1 of 2"), ([WINDOW, missing], "1 of 2")):
        said = verdict(DEPLOYED | {"windows": windows}, LOOP)
        assert said.remark == f"Not good: {held} windows ended within 5 % of their setpoint."


def test_a_deployment_of_two_species_says_its_error_and_what_it_learned():
    """Three windows of unlike errors, in one of which no share was asked for."""
    windows = [{**WINDOW, "ratio_abs_error_mean": error} for error in (0.02, None, 0.05)]
    learned = [
        {"minute": 61.4, "reactor": "M1", "number": 2, "flies": True, "why": "it is better"},
        {"minute": 130.0, "reactor": "M0", "number": 13, "flies": False, "why": "it is not"},
    ]
    said = verdict(DEPLOYED | {"windows": windows, "learned": learned}, LOOP)
    assert said.items[3:] == [
        "mean error of the share 0.035, as estimated",
        "learned during the run, from minute 61: M1, policy 002 flies, it is better",
        "learned during the run, from minute 130: M0, policy 013 does not fly, it is not",
    ]
    short = [{**WINDOW, "steady_abs_error": None}]
    said = verdict(DEPLOYED | {"windows": short}, LOOP)
    assert said.items == ["fresh medium 65 mL", "interlock spoke in 3 samples"]
    assert said.remark == "No window was long enough to say how well its setpoint was held."


def test_one_agent_is_told_by_its_seed():
    said = verdict(TRAINED | {"seeds": [9], "regret_pct": [0.3], "steady_abs_error": [0.002]}, MODEL)
    assert said.claim == "Training: one agent, seed 9, learned mu 0.02 1/min, tau 0.5 for 20000 steps in 31 s."
    assert said.items == [
        "regret 0.3 %: what the policy costs beyond the exact optimum",
        "error at rest at its worst setpoint 0.002 OD",
        "the one-line law that looks one period ahead: regret 0.01 %, error 0.001 OD",
    ]


def test_a_certificate_says_what_fails_and_what_helps():
    """Requirements of safety come first."""
    kinds = ("performance", "safety", "performance", "safety", "safety", "performance")
    checks = [{"name": f"no. {k}", "holds": k == 1, "kind": kind} for k, kind in enumerate(kinds)]
    summary = {"cannot_hold": [], "observation": ["e", "s"], "passed": False, "checks": checks}
    said = verdict(summary, {})
    assert said.items == [
        "6 requirements were judged, listed below", "fails: no. 3", "fails: no. 4", "fails: no. 0", "and 2 more fail",
    ]  # fmt: skip
    short, good = (verdict(summary | {"checks": some}, {}).remark for some in (checks[:3], checks[1:2]))
    assert [remark.split(" ")[0] for remark in (said.remark, short, good)] == ["Not", "Safe:", "Good:"]
    assert all("policy=shipped, " in remark for remark in (said.remark, short))


def test_a_regret_that_rounding_makes_negative_is_none():
    said = verdict(TRAINED | {"myopic_regret_pct": -7.8e-6}, MODEL)
    assert "the one-line law that looks one period ahead: regret 0 %, error 0.001 OD" in said.items


def test_a_calibration_without_a_pair_names_the_rows_that_it_used():
    """Rows 40 to 99, of which the 100th is the first that was not used."""
    alone = {"value": 0.021, "ci95": [0.019, 0.024], "rows": [40, 100]}
    said = verdict(
        {
            "verdict": {"word": "not usable", "why": "the pump never ran", "then": "record doses"},
            "mu": None, "mu_alone": alone, "net_growth": None, "notes": ["a", "b"], "pmse_pct": None,
        },
        {"data": "runs/here/one.csv"},
    )  # fmt: skip
    assert said.claim == "Calibration of one.csv: not usable: the pump never ran; record doses."
    assert said.items == ["mu alone 0.021 1/min, 95 % interval 0.019 to 0.024, rows 40 to 99"]
    assert said.remark == "a; b"


@pytest.mark.parametrize("summary", [{}, {"windows": 3}, {"train_seconds": 1.0}, {"pmse_pct": None}])
def test_what_is_not_whole_is_not_judged(summary: dict[str, object]) -> None:
    assert verdict(summary, {}) is None


def test_the_page_begins_with_it_and_names_units_and_no_place_of_this_machine(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "deploy" / "one"
    folder.mkdir(parents=True)
    place = str(tmp_path / "runs" / "train" / "two" / "policy.npz")
    files.write_json(folder / "summary.json", DEPLOYED | {"figure": place})
    (folder / "config.yaml").write_text(
        f"policy: {place}\nother: /srv/far/away/policy.npz\nbase_url: http://192.168.7.2:5000/x\n"
        "controller:\n  kind: pi\nbackend:\n  kind: chibio\n"
    )
    text = report.write(folder).read_text(encoding="utf-8")
    body = text[text.index("<h2>") :]
    assert body.index("Deployment: pi held") < body.index("<table")
    assert str(tmp_path) not in text
    assert "policy: runs/train/two/policy.npz" in text
    assert "other: …/away/policy.npz" in text
    assert "http://192.168.7.2:5000/x" in text
    for words in ("<th>volume, mL</th>", "<th>setpoint, OD</th>", "<th>steady_abs_error, OD</th>"):
        assert words in text


def test_each_window_is_judged_by_its_own_setpoint_and_the_largest_error_is_named() -> None:
    """0.03 OD is 6 % of 0.5 and less than 4 % of 0.8; medium and interlock are those of all reactors."""
    windows = [WINDOW, {"setpoint": 0.8, "steady_abs_error": 0.03}, {"setpoint": 0.6, "steady_abs_error": 0.01}]
    said = verdict(DEPLOYED | {"windows": windows}, LOOP)
    assert said.items[0] == "largest error at rest 0.03 OD, the mean over the last 10 min of a window"
    assert said.remark == "Good: 3 of 3 windows ended within 5 % of their setpoint."
    windows[1] = {"setpoint": 0.5, "steady_abs_error": 0.03}
    assert verdict(DEPLOYED | {"windows": windows}, LOOP).remark.startswith("Not good: 2 of 3 windows")


def test_of_several_agents_the_worst_in_each_is_named_whichever_it_is() -> None:
    """The first has the larger regret, the second the larger error; units are those of the task."""
    found = TRAINED | {"regret_pct": [0.45, 0.3], "steady_abs_error": [0.001, 0.0025]}
    said = verdict(found | {"myopic_regret_pct": 7.25, "myopic_steady_abs_error": 0.0175}, MODEL)
    assert said.items == [
        "regret of the worst agent 0.45 %: what the policy costs beyond the exact optimum",
        "error at rest at its worst setpoint of the worst agent 0.0025 OD",
        "the one-line law that looks one period ahead: regret 7.25 %, error 0.0175 OD",
    ]
    relative = verdict(found, {"env": {"kind": "relative"}})
    assert relative.claim.startswith("Training: 2 agents learned the task env=relative for 20000 steps")
    assert relative.items[1].endswith("0.0025 periods of full pump")


def test_a_calibration_says_what_it_used_and_what_speaks_against_it() -> None:
    pair = {"mu": {"value": 0.03, "ci95": [0.027, 0.039]}, "tau": {"value": 0.35, "ci95": [0.315, 0.455]}}
    numbers = {"pmse_pct": 6.5, "n_used": 341, "n_rejected": 20, "doubling_min": 23.1}
    said = verdict(
        pair | numbers | {"verdict": {"word": "usable", "why": "both are known", "then": ""}, "warnings": ["a", "b"]},
        {},
    )
    assert said.claim == "Calibration of the shipped recording: usable: both are known."
    assert said.items[2] == "PMSE 6.5 % of the squared OD; 341 readings used, 20 rejected"
    assert said.remark == "Against it: a; b."
    alone = {"value": 0.021, "ci95": [0.019, 0.024], "rows": [40, 100]}
    grown = {"value": 0.005, "ci95": [-0.001, 0.012], "rows": [7, 30]}
    none = {"mu": None, "mu_alone": alone, "net_growth": grown, "notes": ["c"], "pmse_pct": None}
    said = verdict(none | {"verdict": {"word": "w", "why": "x", "then": ""}}, {"data": "one.csv"})
    assert said.items == [
        "mu alone 0.021 1/min, 95 % interval 0.019 to 0.024, rows 40 to 99",
        "net growth 0.005 1/min, 95 % interval -0.001 to 0.012, rows 7 to 29",
    ]
