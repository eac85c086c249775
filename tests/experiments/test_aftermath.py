"""The page of a deployment says what was predicted, what happened, and whether to calibrate again."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dqn import policy as policies
from envs.identification.agreement import Agreement, Compared
from envs.identification.drift import Drift
from envs.identification.model import Parameter
from envs.identification.screening import Series
from experiments import deploy, report
from experiments.cli import frame
from experiments.control import run
from experiments.record.aftermath import _acted, _facts, _segments, _sure, believed, decisions
from tests.experiments.test_deploy import inverse_policy

pytestmark = pytest.mark.xdist_group("aftermath")  # its tests share runs, made once


def deployed(folder: Path, *overrides: str) -> Path:
    """A run as `python -m experiments.deploy` leaves it."""
    config = deploy.main.config(["fsync=false", *overrides])
    folder.mkdir()
    frame.save_config(config, folder)
    run.deploy(config, folder)
    return folder


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """Six hours of two vials that grow faster by 6 % every hour, under a controller that estimates as it goes."""
    return deployed(
        tmp_path_factory.mktemp("aftermath") / "run", "controller=adaptive_inverse", "backend.reactors=[M0,M1]",
        "scenario.minutes=[120,120,120]", "plant.growth.ramp_per_h=0.06",
    )  # fmt: skip


@pytest.fixture
def copy(drifting, tmp_path):
    shutil.copytree(drifting, tmp_path / "run")
    return tmp_path / "run"


def sections(folder: Path) -> str:
    """The page's text without markup."""
    page = report.write(folder).read_text(encoding="utf-8")
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", re.sub(r'src="[^"]*"', "", page)))


@pytest.mark.slow
def test_a_drifting_run_says_since_when_the_model_does_not_hold(copy):
    text = sections(copy)
    assert "Predicted and measured" in text
    assert "growth 0.03 1/min, tau 0.3333 (nominal)" in text
    of = r"This run needs no calibration, but its culture differs from the model: "
    assert len(re.findall(of + ".*?the predicted net growth is off by 10 % or more since hour", text)) == 2
    assert "ecalibrate" not in text  # nobody fitted the nominal model
    # in the first two hours growth is off by 6 % in the mean, in the next two by 18 %
    hours = re.findall(r"10 % or more since hour ([\d.]+)|wrong since hour ([\d.]+)", text)
    assert [float(since or on) for since, on in hours] == pytest.approx([2.0] * 4, abs=0.2)
    assert "The interlock had alarms in 0 of" in text
    assert "A supervisor acted on 0 rows." in text
    for name in ("M0", "M1"):
        assert (copy / "report" / f"{name}.svg").is_file()
        with open(copy / "tables" / f"after_{name}.csv", newline="") as f:
            rows = list(csv.reader(f))
        net = [float(row[3].split(" (")[0]) for row in rows[1:]]
        intervals = [re.fullmatch(r"(\S+) \((\S+) to (\S+)\)", cell) for row in rows[1:] for cell in row[1:]]
        known = [[float(number) for number in found.groups()] for found in intervals if found]
        assert len(known) >= 6
        assert all(low < value < high for value, low, high in known)
        # by hand: 6 % an hour of 0.03 1/min, in the middle of each two hours
        np.testing.assert_allclose(net, [0.03 * 0.06 * h for h in (1.0, 3.0, 5.0)], atol=0.0015)
    assert sections(copy) == text  # a second report finds the same run


@pytest.mark.slow
def test_only_who_decides_with_a_fitted_model_is_told_to_calibrate_again(copy, tmp_path):
    fitted = tmp_path / "calibrated.yaml"
    fitted.write_text("mu: 0.03\ntau: 0.3333\n")
    config = (copy / "config.yaml").read_text()
    with_file = config.replace("env_file: null", f"env_file: {fitted}")
    (copy / "config.yaml").write_text(with_file)
    assert sections(copy).count("Recalibrate: ") == 2
    policies.save(copy / "policy.npz", inverse_policy())  # which was trained on no model of its own
    (copy / "config.yaml").write_text(with_file.replace("kind: inverse", "kind: dqn"))
    assert "ecalibrate" not in sections(copy)
    own = inverse_policy()
    policies.save(copy / "policy.npz", replace(own, metadata={**own.metadata, "model": {"mu": 0.03, "tau": 0.3333}}))
    assert sections(copy).count("Recalibrate: ") == 2


@pytest.mark.slow
def test_a_recording_that_cannot_be_compared_says_why(copy, tmp_path):
    path = copy / "recordings" / "M1.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:5]) + "\n")
    text = sections(copy)
    assert text.count("Not compared: ") == 1
    assert text.count("its culture differs from the model: ") == 1
    short = deployed(tmp_path / "short", "controller=pi", "scenario.minutes=[8,8,8]")
    assert "Too short for a comparison: " in sections(short)


@pytest.mark.slow
def test_the_model_is_the_runs(copy, tmp_path):
    config = (copy / "config.yaml").read_text()
    assert believed(copy).source == "nominal"
    fitted = tmp_path / "calibrated.yaml"
    fitted.write_text("mu: 0.02\ntau: 0.4\n")
    (copy / "config.yaml").write_text(config.replace("env_file: null", f"env_file: {fitted}"))
    assert (believed(copy).mu, believed(copy).tau, believed(copy).source) == (0.02, 0.4, f"env_file {fitted}")
    fitted.unlink()
    assert believed(copy).mu == 0.03
    assert "can no longer be read" in believed(copy).source
    own = inverse_policy()
    policies.save(copy / "policy.npz", replace(own, metadata={**own.metadata, "model": {"mu": 0.025, "tau": 0.3}}))
    assert believed(copy).mu == 0.03  # another controller's run has nothing from it
    (copy / "config.yaml").write_text(config.replace("kind: inverse", "kind: dqn"))
    assert (believed(copy).mu, believed(copy).source) == (0.025, "the policy's training model")
    policies.save(copy / "policy.npz", own)
    assert believed(copy).source == "nominal"
    (copy / "policy.npz").write_bytes(b"torn")
    assert believed(copy).source == "nominal"


def test_other_runs_have_no_such_section(tmp_path):
    (tmp_path / "summary.json").write_text('{"mu": 0.03}')
    assert "Predicted and measured" not in sections(tmp_path)


@pytest.mark.slow
def test_a_folder_of_runs_names_the_deployment(drifting, tmp_path):
    (tmp_path / "1_calibrate").mkdir()
    (tmp_path / "1_calibrate" / "summary.json").write_text('{"mu": 0.03}')
    shutil.copytree(drifting, tmp_path / "3_deploy")
    text = sections(tmp_path)
    assert "Deploy: predicted and measured" in text
    assert "Calibrate: predicted" not in text
    assert (tmp_path / "tables" / "3_deploy_after_M0.csv").is_file()


@pytest.mark.slow
def test_each_reactor_is_compared_with_the_model_of_its_own_volume(tmp_path):
    """Vials of 14 and 9 mL that grow and are fed as planned; tau = V / 60."""
    vials = "backend.reactors=[M0,M1]", "bench.volume_ml=14", "bench.volumes_ml.M1=9", "scenario.minutes=[80,80,80]"
    text = sections(deployed(tmp_path / "run", "controller=inverse", *vials))
    assert "tau 0.2333, 0.15 of M1 (nominal)" in text
    assert text.count("needs no calibration: the model was right to the end of the run.") == 2
    gains = re.findall(r"last estimate ([\d.]+) \(([\d.]+) to ([\d.]+)\), model 1\b", text)
    assert len(gains) == 2
    for gain, low, high in gains:
        assert float(gain) == pytest.approx(1.0, abs=0.12)
        assert float(low) < 1.0 < float(high)


def parameter(value: float) -> Parameter:
    """Whose interval is longer to one side."""
    return Parameter(value, 0.9 * value, 1.3 * value)


def along(name: str, found: tuple[float | None, ...], expected: float, line: Drift | None = None) -> Compared:
    """Three segments, of 1.5, 2 and 2.5 h."""
    edges = ((0.0, 90.0, 210.0), (90.0, 210.0, 360.0))
    parts = tuple(None if value is None else parameter(value) for value in found)
    return Compared(name, *edges, parts, expected, expected or 0.03, 2, line)


def agreed(growth: Compared) -> Agreement:
    series = Series(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.intp))
    rest = along("gain", (1.1, None, 0.95), 1.0), along("net growth", (0.002, 0.001, None), 0.0)
    return Agreement(series, growth, *rest, np.zeros(1), 0.0123, 0.0045, 360.0)


def test_every_estimate_stands_beside_its_own_hours_and_under_its_own_heading():
    """Hours, of minutes; the growth is known in the last two segments alone."""
    table = _segments(agreed(along("growth", (None, 0.03, 0.02), 0.028)), "name", "M1")
    assert table.columns == (
        "hours", "growth rate, 1/min", "pump gain, 1 = the model's", "net growth beyond the model's, 1/min",
    )  # fmt: skip
    assert table.rows == (
        ("0.0 to 1.5", "–", "1.1 (0.99 to 1.43)", "0.002 (0.0018 to 0.0026)"),
        ("1.5 to 3.5", "0.03 (0.027 to 0.039)", "–", "0.001 (0.0009 to 0.0013)"),
        ("3.5 to 6.0", "0.02 (0.018 to 0.026)", "0.95 (0.855 to 1.23)", "–"),
    )
    assert table.title.startswith("M1: ")


def test_facts_of_a_run_are_the_last_estimates_since_when_they_left_the_model_s_and_how_they_drift():
    """Growth is off by 10 % or more in the last two segments, that is since hour 1.5; a line through all falls."""
    drift = Drift(0.05, 0.04, -20.0, Parameter(-0.002, -0.003, -0.001), 3)
    told = _facts(agreed(along("growth", (0.028, 0.05, 0.04), 0.028, drift)))
    assert [re.findall(r"-?\d[\d.]*", line) for line in told] == [
        ["0.04", "0.036", "0.052", "0.028", "1.5", "-20"], ["0.95", "0.855", "1.23", "1"],
        ["0.001", "0.0009", "0.0013", "0", "10"], ["0.0123", "0.0045"],
    ]  # fmt: skip
    level = replace(drift, slope_per_h=Parameter(-0.001, -0.003, 0.001))
    assert "a line" not in _facts(agreed(along("growth", (0.028, 0.05, 0.04), 0.028, level)))[0]
    assert _facts(agreed(along("growth", (None, None, None), 0.028)))[0] == "growth: not identifiable"


def test_what_interlock_and_supervisor_did_is_counted_each_by_itself():
    """Five decisions by the supervisor, two of them because of surprises; of four known errors three are within."""
    minute = np.arange(30.0)
    acted, alarm = (minute >= 10) & (minute < 15), abs(minute - 12.5) < 1
    why = {"minute": minute, "supervised": 1.0 * acted, "alarm": 1.0 * alarm}
    reasons = {
        "stale": {"rows": 3, "first_min": 31.5, "last_min": 40.0},
        "budget": {"rows": 6, "first_min": 5.0, "last_min": 8.0},
    }
    summary = {"interlock": 8, "rows": 300, "reasons": reasons}
    numbers = ["8", "300", "3", "31.5", "40", "6", "5", "8", "5", "10", "14", "2"]
    assert [number.rstrip(".") for number in re.findall(r"\d[\d.]*", _acted(summary, why))] == numbers
    day = {**summary, "reasons": {"falls": {"rows": 5, "first_min": 41.0, "last_min": 1345.0}}}
    assert ": falls in 5 rows, hour 0.7 to 22.4." in _acted(day, why)
    errors = {"error": [0.0, 0.19, 0.21, -0.1, 0.0], "error_sd": [0.1] * 5, "true_error": [0.0] * 4 + [np.nan]}
    shares = {"growth_share": [0.5] * 2, "growth_share_sd": [0.1] * 2, "true_growth_share": [0.6, 0.9]}
    for given, name, told in ((errors, "error e", ["75", "4"]), (shares, "growth share s", ["50", "2"])):
        (line,) = _sure({key: np.array(values) for key, values in given.items()})
        assert (line.partition(":")[0], re.findall(r"\d+", line)) == (name, told)


def test_decisions_of_a_reactor_are_its_own_and_what_one_of_them_lacks_is_not_known(tmp_path):
    """M1 had an estimate from its second decision on; a line that says nothing of a decision is none."""
    told = [
        ("M0", 1.0, {"mu": 0.01}),
        ("M1", 2.5, {"supervised": True}),
        ("M1", 3.5, {"mu": 0.03, "supervised": False}),
    ]
    rows = [{"n": 1, "kind": "sample", "reactor": "M1"}]
    rows += [
        {"n": k, "kind": "decision", "reactor": name, "row": {"time_min": minute}, "why": why}
        for k, (name, minute, why) in enumerate(told)
    ]
    (tmp_path / "journal.jsonl").write_text("".join(json.dumps(row, separators=(",", ":")) + "\n" for row in rows))
    found = decisions(tmp_path, "M1")
    assert set(found) == {"minute", "mu", "supervised"}
    for key, values in (("minute", [2.5, 3.5]), ("mu", [np.nan, 0.03]), ("supervised", [1.0, 0.0])):
        np.testing.assert_array_equal(found[key], values)
    assert set(decisions(tmp_path, "M0")) == {"minute", "mu"}
    assert {key: values.size for key, values in decisions(tmp_path, "M7").items()} == {"minute": 0}
