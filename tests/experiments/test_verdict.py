"""What a report says first: what was run, what came out, and whether that is good, from a run's own numbers."""

from pathlib import Path

import pytest

from experiments import report
from experiments.cli import files
from experiments.reporting.verdict import verdict

TRAINED = {
    "seeds": [4, 7], "policy_seed": 7, "regret_pct": [0.2, 0.4], "steady_abs_error": [0.001, 0.002], "env_steps": 20000,
    "train_seconds": 31.4, "myopic_regret_pct": 0.01, "myopic_steady_abs_error": 0.001,
}  # fmt: skip
MODEL = {"env": {"mu": 0.02, "tau": 0.5}}
WINDOW = {"setpoint": 0.5, "steady_abs_error": 0.004}
DEPLOYED = {
    "outcome": "completed", "minutes": 90.0, "volume_ml": 65.0, "windows": [WINDOW, {**WINDOW, "setpoint": 0.8}],
    "reactors": {"M0": {"interlock": 2}, "M1": {"interlock": 1}},
}  # fmt: skip
LOOP = {"controller": {"kind": "pi"}, "backend": {"kind": "chibio"}}


def holds(text: str, *values: str) -> bool:
    return all(value in text for value in values)


def test_of_several_agents_the_exported_one_is_judged_and_the_worst_is_named() -> None:
    """The second was exported, the first has the larger regret; units are those of the task."""
    found = TRAINED | {"regret_pct": [0.65, 0.3], "steady_abs_error": [0.001, 0.0025]}
    said = verdict(found | {"myopic_regret_pct": 7.25, "myopic_steady_abs_error": 0.0175}, MODEL)
    assert holds(said.claim, "2 agents", "mu 0.02 1/min", "tau 0.5", "20000 steps", "31 s")
    regret, error, myopic = said.items
    assert holds(regret, "regret 0.3 %", "seed 7", "worst agent 0.65 %")
    assert holds(error, "0.0025 OD")
    assert holds(myopic, "7.25 %", "0.0175 OD")
    assert said.remark.startswith("Good: ")
    assert holds(said.remark, "0.5 %", "0.003 OD")
    for worse, words in (
        ({"regret_pct": [0.2, 0.6]}, ("Not good yet", "0.5 %")),
        ({"steady_abs_error": [0.0, 0.004]}, ("Nearly optimal", "0.003 OD")),
    ):
        remark = verdict(TRAINED | worse, MODEL).remark
        assert holds(remark, *words)
    for env, unit in (("relative", "0.0025 periods of full pump"), ("coculture", "0.0025 of the share")):
        other = verdict(found, {"env": {"kind": env}})
        assert other.items[1].endswith(unit)
        assert "env=" in other.claim
    assert other.remark == ""


def test_one_agent_is_told_by_its_seed_and_a_regret_that_rounding_makes_negative_is_none() -> None:
    one = {"seeds": [9], "policy_seed": 9, "regret_pct": [0.3], "steady_abs_error": [0.002]}
    one |= {"myopic_regret_pct": -7.8e-6}
    said = verdict(TRAINED | one, MODEL)
    assert holds(said.claim, "seed 9")
    assert [item for item in said.items if "worst agent" in item] == []
    assert all(map(holds, said.items, ("0.3 %", "0.002 OD", "regret 0 %")))


def test_a_deployment_is_good_if_every_window_ends_at_its_setpoint() -> None:
    said = verdict(DEPLOYED, LOOP)
    assert holds(said.claim, "pi held M0, M1 on the Chi.Bio for 1.5 h", "completed")
    units, own = (verdict(DEPLOYED, LOOP | {"backend": {"kind": kind}}) for kind in ("pioreactor", "mine"))
    assert "on Pioreactors for" in units.claim
    assert "on the reactors of mine for" in own.claim
    assert all(map(holds, said.items, ("0.004 OD", "65 mL", "3 samples")))
    assert said.remark == "Good: 2 of 2 windows ended within 5 % of their setpoint."
    largest = [WINDOW, {"setpoint": 0.8, "steady_abs_error": 0.03}, {"setpoint": 0.6, "steady_abs_error": 0.01}]
    said = verdict(DEPLOYED | {"windows": largest}, LOOP)  # 0.03 OD is 6 % of 0.5 and less than 4 % of 0.8
    assert holds(said.items[0], "0.03 OD")
    assert said.remark == "Good: 3 of 3 windows ended within 5 % of their setpoint."
    away = {**WINDOW, "steady_abs_error": 0.026}  # 5 % of 0.5 is 0.025
    missing = {**WINDOW, "steady_abs_error": None}
    for windows, held in (([WINDOW, away], "1 of 2"), ([WINDOW, missing], "1 of 2")):
        said = verdict(DEPLOYED | {"windows": windows}, LOOP)
        assert said.remark == f"Not good: {held} windows ended within 5 % of their setpoint."


def test_a_deployment_of_two_species_says_its_error():
    """Three windows of unlike errors, in one of which no share was asked for."""
    windows = [{**WINDOW, "ratio_setpoint": 0.5, "ratio_abs_error_mean": error} for error in (0.02, None, 0.05)]
    said = verdict(DEPLOYED | {"windows": windows}, LOOP)
    assert said.items[3:] == ["mean error of the estimated share 0.035"]
    short = [{**WINDOW, "steady_abs_error": None}]
    said = verdict(DEPLOYED | {"windows": short}, LOOP)
    assert said.items == ["fresh medium 65 mL", "interlock alarms in 3 samples"]
    assert said.remark == "No window was long enough to judge how well its setpoint was held."


def test_a_certificate_says_what_fails_and_what_helps():
    """Requirements of safety come first."""
    kinds = ("performance", "safety", "performance", "safety", "safety", "performance")
    checks = [{"name": f"no. {k}", "holds": k == 1, "kind": kind} for k, kind in enumerate(kinds)]
    summary = {"cannot_hold": [], "observation": ["e", "s"], "passed": False, "checks": checks}
    said = verdict(summary, {})
    assert said.items == [
        "6 requirements were checked, listed below", "failed: no. 3", "failed: no. 4", "failed: no. 0", "2 more failed",
    ]  # fmt: skip
    short, good = (verdict(summary | {"checks": some}, {}).remark for some in (checks[:3], checks[1:2]))
    assert [remark.split(" ")[0] for remark in (said.remark, short, good)] == ["Not", "Safe:", "Good:"]
    assert all("policy=shipped, " in remark for remark in (said.remark, short))


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


def test_a_calibration_says_what_it_used_and_what_speaks_against_it() -> None:
    pair = {"mu": {"value": 0.03, "ci95": [0.027, 0.039]}, "tau": {"value": 0.35, "ci95": [0.315, 0.455]}}
    numbers = {"pmse_pct": 6.5, "n_used": 341, "n_rejected": 20, "doubling_min": 23.1}
    said = verdict(
        pair | numbers | {"verdict": {"word": "usable", "why": "both are known", "then": ""}, "warnings": ["a", "b"]},
        {},
    )
    assert said.claim == "Calibration of the shipped recording: usable: both are known."
    mu, tau, rest = said.items[:3]
    assert holds(mu, "mu 0.03 1/min", "0.027 to 0.039", "23.1 min")
    assert holds(tau, "tau 0.35", "0.315 to 0.455")
    assert holds(rest, "6.5 %", "341 readings used", "20 rejected")
    assert holds(said.remark, "a; b")
    alone = {"value": 0.021, "ci95": [0.019, 0.024], "rows": [40, 100]}
    grown = {"value": 0.005, "ci95": [-0.001, 0.012], "rows": [7, 30]}
    none = {"mu": None, "mu_alone": alone, "net_growth": grown, "notes": ["c", "d"], "pmse_pct": None}
    because = {"verdict": {"word": "not usable", "why": "the pump never ran", "then": "record doses"}}
    said = verdict(none | because, {"data": "runs/here/one.csv"})
    assert holds(said.claim, " one.csv: not usable", "the pump never ran", "record doses")
    mu, net = said.items
    assert holds(mu, "mu alone 0.021 1/min", "0.019 to 0.024", "rows 40 to 99")  # 100 is the first that was not used
    assert holds(net, "0.005 1/min", "-0.001 to 0.012", "rows 7 to 29")
    assert said.remark == "c; d"
    assert verdict(none | because | {"net_growth": None}, {}).items == [mu]
