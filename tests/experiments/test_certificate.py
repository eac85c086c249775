"""The file of a certificate, the command that writes it, and the device that asks for it."""

import json
import re
import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from dqn import policy
from dqn.policy import fingerprints
from envs.bench import Bench
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments import certify as command
from experiments import deploy
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import LIMITS, CertifyConfig
from experiments.certification.figure import figure
from experiments.certification.judge import PERFORMANCE, SAFETY, Certificate, Requirement, certify, recheck, worst
from experiments.certification.question import CertificationError, question
from experiments.certification.verdict import attacked
from experiments.cli import files
from experiments.cli.frame import UserError
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.control.policies import SHIPPED, WantedPolicy, admit, find_policy, policy_check
from experiments.laws.density import estimator as filters
from experiments.laws.density import learned
from experiments.laws.density.estimator import EstimatorConfig
from experiments.laws.density.learned import LearnedConfig, settings
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.simulated import SimulatedConfig
from tests.experiments import laws
from tests.experiments.proofs import ASKED, proven, written

pytestmark = pytest.mark.numeric

SCENARIO = Scenario((0.45, 0.65), (30.0, 30.0), (37.0, 37.0))


def nudged(given: policy.Policy) -> policy.Policy:
    """The same with one weight a unit in the last place higher."""
    weights = [w.copy() for w in given.weights]
    weights[1][0, 0] = np.nextafter(weights[1][0, 0], np.float32(np.inf))
    return replace(given, weights=tuple(weights))


@pytest.mark.parametrize(("file", "proof"), [("policy", "certificate"), ("seed0003", "seed0003.certificate")])
def test_a_certified_policy_runs_on_a_device_and_its_run_keeps_both(tmp_path, file, proof, caplog):
    unpacked(written(tmp_path / f"{file}.npz", laws.law()), tmp_path / "run")
    kept = tmp_path / "run" / "certificate.json"
    assert kept.read_bytes() == (tmp_path / f"{proof}.json").read_bytes()
    assert json.loads(kept.read_text())["of"] == fingerprints(policy.load(tmp_path / "run" / "policy.npz"))
    unpacked(Path("shipped"), tmp_path / "run")
    assert not warnings(caplog)


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


def refused(path: Path, folder: Path, **changes: Any) -> str:
    """The line with which a device refuses a policy."""
    with pytest.raises(UserError, match=r"^policy refused: .*; .*force_policy=true$") as caught:
        unpacked(path, folder, **changes)
    return str(caught.value)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "changed by one bit": (
        {"given": nudged(laws.law()), "of": laws.law()}, r"certificate.json is for another policy: its weights",
    ),
    "not safe": ({"given": laws.law(gain=-laws.GAIN)}, r"strips without a band: 80, allowed 0 .*setpoint 0\.4 to 0\.8"),
    "said to be safe": (
        {"given": laws.low_corner(), "safe": True, "passed": True, "checks": []},
        r"a proof for this bench .* washed out: 1, .*\(setpoint 0.45\)",
    ),
    "elsewhere on both sides": ({"given": laws.law(), "setpoints": [0.5, 0.6]}, r"0.5 to 0.6, .* has 0.45, 0.65 "),
    "damaged": ({"given": laws.law(), "setpoints": None}, r"certificate.json is damaged \(TypeError"),
    "of an unknown kind": (
        {"given": laws.law(), "checks": [asdict(Requirement("a", 2.0, 1.0, kind="taste")) | {"holds": False}]},
        "kind taste",
    ),
    "of an older format": ({"given": laws.law(), "format": certificate.FORMAT - 1}, r"this version reads format "),
    "of a newer format": ({"given": laws.law(), "format": certificate.FORMAT + 1}, r"this version reads format "),
}  # fmt: skip


@pytest.mark.parametrize(("made", "why"), REFUSED.values(), ids=list(REFUSED))
def test_a_device_refuses_what_is_not_proven_and_says_how_to_prove_it(tmp_path, made, why):
    source = written(tmp_path / "policy.npz", **made)
    said = refused(source, tmp_path / "run")
    assert re.search(why, said)
    assert "\n" not in said
    assert "a proof for this bench" in said or f"python -m experiments.certify policy={source}" in said


def concluded(given: policy.Policy, path: Path) -> certificate.Opinion:
    """What a device concludes at the setpoints of `SCENARIO`."""
    return certificate.judged(given, settings(given), path, SCENARIO.setpoints, Bench(), EnvConfig(), "mine")


@pytest.mark.parametrize("factor", [0.4, 0.69, 0.72, 1.28, 1.32, 4.0])
def test_a_device_refuses_a_policy_that_is_proven_for_another_pump(factor: float, tmp_path: Path) -> None:
    """At a vial of 14 mL, whose tau is .7 of that of 20 mL with the same pump; +-30 % is what is proven."""
    given, bench = laws.law(), Bench(volume_ml=14.0)
    path = written(tmp_path / "policy.npz", given)
    run = EnvConfig(tau=0.7 * EnvConfig().tau * factor)
    found = certificate.judged(given, settings(given), path, SCENARIO.setpoints, bench, run, "mine")
    other = [reason for reason in found.refused if f"this run has tau = {run.tau:.3g}" in reason]
    assert bool(other) == (not 0.7 <= factor <= 1.3)


@pytest.mark.parametrize("mu", [0.0195, 0.0205, 0.022, 0.0385, 0.04])
def test_a_device_refuses_a_policy_that_is_proven_for_another_culture_than_its_trainings(mu, tmp_path):
    path = written(tmp_path / "policy.npz", laws.law(), config=replace(ASKED, env=EnvConfig(mu=mu)))
    other = [reason for reason in concluded(laws.law(), path).refused if f"mu = {mu}" in reason]
    assert bool(other) == (not 0.021 <= mu <= 0.039)


@pytest.mark.parametrize("mu", [0.0043, 0.02, 0.022, 0.0385, 0.04])
def test_a_device_refuses_a_policy_that_is_proven_for_another_culture_than_that_of_the_run(mu, tmp_path):
    path, run = written(tmp_path / "policy.npz", laws.law()), EnvConfig(mu=mu)
    asked = laws.law(), settings(laws.law()), path, SCENARIO.setpoints, Bench(), run, "mine"
    other = [reason for reason in certificate.judged(*asked).refused if f"env_file has {mu}" in reason]
    assert bool(other) == (not 0.021 <= mu <= 0.039)


def test_a_device_tells_the_cases_that_are_not_proven_since_the_pump_cannot_hold_them(tmp_path):
    """At +-42 % growth needs (1.42)^2 of its nominal rate, more than the twice that the pump gives."""
    found = proven(laws.law(), replace(ASKED, uncertainty=0.42))
    given = written(tmp_path / "policy.npz", laws.law(), cannot_hold=found.cannot_hold())
    assert any(found.cannot_hold()[0] in note for note in concluded(laws.law(), given).short)


@pytest.mark.parametrize("share", [False, True], ids=["OD", "relative"])
def test_a_device_refuses_for_each_requirement_of_safety_and_tells_each_of_performance(share, tmp_path, monkeypatch):
    """Each requirement alone is written down as failed. Its number and limit are told, whatever follows."""
    given = laws.share_law() if share else laws.law()
    attacked_too = replace(ASKED, trajectories=600, quick=True, growth_shares=(0.3, 0.33))
    whole = (*proven(given).checks, *proven(given, attacked_too).checks[-3 if share else -1 :])
    listed = [{**asdict(check), "holds": True} for check in whole]
    source = written(tmp_path / "policy.npz", given, checks=listed, cases=[])
    content = json.loads(certificate.beside(source).read_text())
    assert content["safe"]
    assert content["passed"]
    monkeypatch.setattr(certificate, "recheck", lambda *given: [])
    titles = [check.title for check in whole]
    for k in {titles.index(title) for title in titles} | {len(titles) - 1 - titles[::-1].index(t) for t in titles}:
        check = content["checks"][k]
        failed = {**check, "value": 7.125, "limit": 6.5, "holds": False}
        safe = check["kind"] == PERFORMANCE
        checks = [*content["checks"][:k], failed, *content["checks"][k + 1 :]]
        changed = {"safe": safe, "passed": False, "checks": checks}
        for wrong in ({}, {"safe": True, "passed": True}):  # what the file claims counts only against the policy
            files.write_json(certificate.beside(source), {**content, **changed, **wrong})
            stored = certificate.load(certificate.beside(source))
            assert (stored.safe, stored.passed) == (safe, False)
        found = concluded(given, source)
        assert bool(found.refused) is not safe, check["name"]
        assert bool(found.short) is safe
        assert f"{check['name']}: 7.125, allowed 6.5" in "".join(found.refused + found.short)
    kinds = {check.title: check.kind for check in whole}
    assert {title.split(",")[0] for title, kind in kinds.items() if kind == PERFORMANCE} == {
        "half of the largest dose below the setpoint", "half-width over that of the one-line controller",
        *(("entry after the one-line controller's", "share of the band that no attack reaches") if share
          else ("entry time over the pump's own",)),
    }  # fmt: skip
    assert set(kinds.values()) == {SAFETY, PERFORMANCE}


def test_what_only_lacks_performance_runs_on_a_device_with_its_numbers_told(tmp_path, caplog):
    """In 12 mL a culture at rest needs mu tau / u_max = 0.3 of the pump; this policy gives 0.5 at the setpoint.

    In 28 mL and growing by 0.0432 1/min it needs more than the pump has.
    """
    source = written(tmp_path / "policy.npz", laws.law())
    wanted = WantedPolicy(str(source), Bench(), EnvConfig(), {}, SCENARIO.setpoints, at_stake=True, forced=False)
    check = policy_check(wanted)
    assert (check.ok, "performance" in check.detail, "proven safe" in check.detail) == (True, False, True)
    assert "proven safe" not in policy_check(replace(wanted, at_stake=False)).detail
    unpacked(source, tmp_path / "run")
    assert not caplog.messages
    bench = Bench(volume_ml=12.0)
    unpacked(source, tmp_path / "run", bench=bench)
    (warned,) = caplog.messages
    found = recheck(laws.law(), certificate.on_bench(laws.law(), ASKED, bench, EnvConfig()), SCENARIO.setpoints)
    assert found
    assert all(check.kind == PERFORMANCE for check in found)
    assert all(str(check) in warned for check in worst(found))
    check = policy_check(replace(wanted, bench=bench, model=EnvConfig(tau=bench.tau)))
    assert check.ok
    assert all(str(one) in check.detail for one in worst(found))
    weak, grown = Bench(volume_ml=28.0), replace(ASKED, env=EnvConfig(mu=0.0432))
    given = replace(laws.law(), metadata={**laws.law().metadata, "model": {**laws.MODEL, "mu": 0.0432}})
    written(source, given, config=grown)
    said = refused(source, tmp_path / "run", bench=weak)
    assert "a proof for this bench" in said
    assert "the pump cannot hold: 2" in said
    check = policy_check(replace(wanted, bench=weak))
    assert (check.ok, check.required) == (False, True)


def test_the_worst_of_each_requirement_is_told() -> None:
    """Farthest beyond its limit, relative to it; what could not be proven is worst."""
    wide, wider, none = Requirement("a: w", 3.0, 2.0), Requirement("b: w", 1.6, 1.0), Requirement("c: w", np.nan, 9.0)
    late = Requirement("a: late", 1.0, 0.5)
    assert worst([wide, late, wider]) == [wider, late]
    assert worst([wide, none, wider]) == [none]


def unpacked(path: Path, folder: Path, **changes: Any) -> assemble.Setup:
    config = DeployConfig(**{"backend": ChiBioConfig(), "scenario": SCENARIO, "policy": str(path), **changes})
    folder.mkdir(exist_ok=True)
    return assemble.unpack(config, folder)


def test_a_policy_without_certificate_is_refused_on_a_device_alone(tmp_path, caplog):
    source = tmp_path / "policy.npz"
    policy.save(source, laws.law())
    assert f": python -m experiments.certify policy={source}; " in refused(source, tmp_path / "run")
    for backend in (SimulatedConfig(), EmulatorConfig()):
        unpacked(source, tmp_path / "run", backend=backend)
    assert not warnings(caplog)
    unpacked(source, tmp_path / "run", force_policy=True)
    unpacked(source, tmp_path / "run", resume="RUN")
    assert ["it has no certificate" in line for line in warnings(caplog)] == [True, True]


def test_the_fingerprints_are_of_what_decides_and_nothing_else() -> None:
    given = laws.law()
    own = fingerprints(given)
    assert set(own) == {"observation or model", "weights", "map of the inputs", "actions", "limits"}
    assert fingerprints(laws.law()) == own
    assert fingerprints(replace(given, metadata={**given.metadata, "regret_pct": 3.0})) == own
    for name, (_, other) in PARTS.items():
        found = fingerprints(other)
        assert [part for part in own if found[part] != own[part]] == [name]
    assert fingerprints(replace(given, biases=(given.biases[0].astype(np.float64), *given.biases[1:]))) != own


def bent(name: str, change: float, given: policy.Policy) -> policy.Policy:
    """The same with one number of an array that is no layer changed."""
    array = np.array(getattr(given, name))
    array.flat[-1] += change
    return replace(given, **{name: array})


PARTS: dict[str, tuple[policy.Policy, policy.Policy]] = {
    "weights": (laws.law(), nudged(laws.law())),
    "map of the inputs": (laws.law(), bent("input_offset", 1e-3, laws.law())),
    "actions": (laws.law(), bent("actions", -1e-6, laws.law())),
    "limits": (laws.law(), replace(laws.law(), high=np.array([np.inf, 0.8], np.float32))),
    "observation or model": (
        laws.law(), replace(laws.law(), metadata={**laws.law().metadata, "model": {**laws.MODEL, "mu": 0.031}}),
    ),
}  # fmt: skip
"""Part of a policy -> a policy, and one of which that part alone is another."""


@pytest.fixture(scope="module")
def relative(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The law of (error, growth share) as a policy file, with its certificate."""
    return written(tmp_path_factory.mktemp("relative") / "policy.npz", laws.share_law())


def beside(relative: Path, given: policy.Policy, folder: Path) -> Path:
    """A policy file with the certificate that another one has."""
    policy.save(folder / "policy.npz", given)
    shutil.copy(certificate.beside(relative), certificate.beside(folder / "policy.npz"))
    return folder / "policy.npz"


CHANGED: dict[str, tuple[dict[str, Any], str]] = {
    "gate": ({"gate_sigma": 20.0}, "estimator.gate_sigma = 20.0, certified 5.0 (restore it"),
    "whole number": ({"gate_max": 20}, "estimator.gate_max = 20, certified 6 (restore it"),
    "switch": ({"told": False}, "estimator.told = False, certified True (restore it"),
    "two": (
        {"growth_cv": 0.0, "gate_od": 0.0},
        "estimator.gate_od = 0.0, certified 0.025; estimator.growth_cv = 0.0, certified 0.05 (restore it",
    ),
}


@pytest.mark.parametrize(("changes", "named"), CHANGED.values(), ids=list(CHANGED))
def test_a_setting_of_the_estimator_is_another_policy(relative, tmp_path, changes, named):
    """On the command line or in the policy file, whose network is the same.

    What was not certified gets no bounds: surprises alone supervise it where it is forced.
    """
    given = [f"+controller.estimator.{key}={value}" for key, value in changes.items()]
    config = deploy.main.config([f"policy={relative}", "controller=dqn", "backend=chibio", *given])
    assert isinstance(config.controller, LearnedConfig)
    assert named in refused(relative, tmp_path / "run", controller=config.controller)
    other = replace(policy.load(relative), metadata={**policy.load(relative).metadata, "estimator": changes})
    assert named in refused(beside(relative, other, tmp_path), tmp_path / "run")
    assert unpacked(relative, tmp_path / "run", controller=config.controller, force_policy=True).bounds is None
    sound = unpacked(relative, tmp_path / "run").bounds
    assert sound is not None
    assert sound.full_pump == pytest.approx(0.02 * 1.0 / (20.0 / 60.0))


@pytest.mark.parametrize("backend", [ChiBioConfig(), SimulatedConfig()], ids=["forced", "simulated"])
def test_bounds_of_a_certificate_that_is_not_safe_let_nobody_act(relative: Path, tmp_path: Path, backend: Any) -> None:
    """Where its policy flies all the same, surprises alone supervise it. Performance takes no bounds away."""
    content = json.loads(certificate.beside(relative).read_text())
    source = beside(relative, policy.load(relative), tmp_path)
    failed = [{**asdict(Requirement("a: b", 3.0, 1.0, kind=kind)), "holds": False} for kind in (SAFETY, PERFORMANCE)]
    for failure, bounded in (
        ({}, True), ({"safe": False}, False), ({"checks": failed[:1]}, False), ({"checks": failed[1:]}, True),
        ({"passed": False}, True),
    ):  # fmt: skip
        certificate.beside(source).write_text(json.dumps({**content, **failure}))
        found = unpacked(source, tmp_path / "run", backend=backend, force_policy=True)
        assert (found.bounds is not None) is bounded, failure


@pytest.mark.parametrize("gate", [5.0, 20.0])
def test_settings_of_the_file_give_way_to_the_same_ones_on_the_command_line(relative, tmp_path, gate):
    given = policy.load(relative)
    own = {**given.metadata, "estimator": {**asdict(EstimatorConfig()), "gate_sigma": gate}}
    source = beside(relative, replace(given, metadata=own), tmp_path)
    assert unpacked(source, tmp_path / "run", controller=LearnedConfig(estimator={"gate_sigma": 5.0})).bounds


@pytest.mark.parametrize(
    ("module", "name", "value", "said"),
    [
        (filters, "FIXED", filters.Fixed(loud=30.0), "filter.loud = 30.0, certified 21.0"),
        (filters, "FIXED", filters.Fixed(quiet=0.0), "filter.quiet = 0.0, certified 0.15"),
        (filters, "FIXED", filters.Fixed(gain_range=(0.2, 9.0)),
         "filter.gain_range = [0.2, 9.0], certified [0.2, 3.0]"),
        (learned, "WATCHED", 1.0, "fallback.watched_sd = 1.0, certified 2.0"),
        (learned, "EstimatorConfig", partial(EstimatorConfig, gate_sigma=6.0),
         "fallback.estimator.gate_sigma = 6.0, certified 5.0"),
    ],
)  # fmt: skip
def test_another_supervisor_is_another_policy(relative, tmp_path, monkeypatch, module, name, value, said):
    """The file's own settings are the old ones, so the first filter is the certified one."""
    given = policy.load(relative)
    own = replace(given, metadata={**given.metadata, "estimator": asdict(EstimatorConfig())})
    source = beside(relative, own, tmp_path)
    unpacked(source, tmp_path / "run")
    monkeypatch.setattr(module, name, value)
    assert f"is for another policy: {said} (restore" in refused(source, tmp_path / "run")


def test_a_policy_of_the_od_has_no_settings_beside_it() -> None:
    assert settings(laws.law()) == {}
    assert set(settings(laws.share_law())) == {
        *(f"{prefix}estimator.{key}" for prefix in ("", "fallback.") for key in asdict(EstimatorConfig())),
        *(f"fallback.{key}" for key in ("law", "watched_sd", "louder")),
        *(f"filter.{key}" for key in filters.fixed()),
    }


def test_a_policy_of_error_and_growth_share_is_proven_anew_for_another_bench(relative, tmp_path, caplog):
    """Full pump takes 0.05 * 5 / (20/60) = 0.75 off ln x instead of 0.06, which is no reason by itself.

    Asked are that B alone, errors, spread doses, slow errors and watched errors at the run's two setpoints, and the two
    of any setpoint.
    A Chi.Bio samples every 60 s: a whole run of one is in 12 mL, 0.02 / (12/60) = 0.1.
    """
    given, bench = policy.load(relative), Bench(period_s=300.0, max_rate=0.05)
    model = EnvConfig(tau=bench.tau, control_min=5.0, max_pump_rate=0.05)
    admit(given, relative, WantedPolicy("name", bench, model, {}, SCENARIO.setpoints, True, False), resumed=False)
    bounds = certificate.bounds(given, settings(given), relative, model)
    assert bounds is not None
    assert bounds.full_pump == pytest.approx(0.75)
    asked = certificate.on_bench(given, ASKED, bench, model)
    cases = question(given, asked, SCENARIO.setpoints).cases
    assert [case.bounds.full_pump for case in cases] == pytest.approx([0.75] * 10)
    assert [case.setpoint for case in cases if case.bounds.gain] == [0.45, 0.45, 0.65, 0.65]
    setup = unpacked(relative, tmp_path / "run", bench=Bench(volume_ml=12.0))
    assert setup.bounds is not None
    assert setup.bounds.full_pump == pytest.approx(0.1)
    assert not warnings(caplog)


def certified(given: policy.Policy, folder: Path, *words: str) -> CertifyConfig:
    """The command on a policy in a folder, without its figure and page."""
    policy.save(folder / "policy.npz", given)
    (folder / "run").mkdir(exist_ok=True)
    config = command.main.config([f"policy={folder}", "trajectories=0", *words])
    command.body(config, folder / "run")
    return config


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn: neither figure nor page."""
    monkeypatch.setattr("experiments.certification.figure.figure", lambda found: None)
    monkeypatch.setattr("experiments.reporting.charts.save", lambda *given: [])
    monkeypatch.setattr("experiments.reporting.page.save", lambda *given: "page")
    monkeypatch.setattr("experiments.reporting.page.of_runs", lambda *given: None)
    silent = SimpleNamespace(picture=lambda *given: None, text=lambda *given: None, close=lambda: None)
    monkeypatch.setattr("experiments.reporting.tensorboard.Events", lambda folder: silent)


def test_a_quick_certificate_is_refused_by_name(undrawn: None, tmp_path: Path) -> None:
    """Of a policy of the OD, which has no case less then, it is as good as any."""
    words = "quick=true", "setpoints=[0.4,0.8]", f"to={tmp_path / 'certificate.json'}"
    certified(laws.share_law(), tmp_path, *words)
    assert certificate.load(tmp_path / "certificate.json").passed
    assert "its certificate was made with quick=true" in refused(tmp_path / "policy.npz", tmp_path / "run")
    assert unpacked(tmp_path / "policy.npz", tmp_path / "forced", force_policy=True).bounds is None
    certified(laws.law(), tmp_path, *words)
    unpacked(tmp_path / "policy.npz", tmp_path / "run")


def test_the_command_leaves_a_certificate_a_figure_and_a_page(tmp_path: Path) -> None:
    policy.save(tmp_path / "policy.npz", laws.law())
    config = command.main.config([f"policy={tmp_path}", "trajectories=1000"])
    folder = tmp_path / "run"
    folder.mkdir()
    command.body(config, folder)
    stored = certificate.load(tmp_path / "certificate.json")
    assert stored.passed
    assert (stored.of, stored.setpoints) == (fingerprints(laws.law()), (0.4, 0.8))
    assert stored.config.env is not None
    assert (stored.config.env.mu, stored.config.env.tau) == (0.03, 1 / 3)
    assert (folder / "figures" / "certificate.svg").is_file()
    for case in json.loads((tmp_path / "certificate.json").read_text())["cases"]:
        assert all(
            proven and low < 0.0 < high for proven, (low, high) in zip(case["proven"], case["band"], strict=True)
        )
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "nominal: half-width over that of the one-line controller, OD" in page
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert (summary["safe"], summary["passed"]) == (True, True)
    assert [case["case"] for case in summary["cases"]] == ["nominal", "noise", "uncertain", "noise and uncertain"]


def test_a_pump_so_weak_that_not_even_the_one_line_law_has_a_band_has_a_figure() -> None:
    found = proven(replace(laws.law(), actions=0.1 * laws.RATES))
    assert not found.safe
    assert figure(found).axes


def test_a_policy_that_is_not_safe_ends_the_command_with_one_line_and_its_certificate_says_so(undrawn, tmp_path):
    with pytest.raises(UserError) as caught:
        certified(laws.high_corner(), tmp_path)
    unsafe = [c for c in proven(laws.high_corner()).checks if c.kind == SAFETY and not c.holds]
    assert f" {len(unsafe)} of " in str(caught.value)
    assert str(caught.value).endswith(str(unsafe[0]))
    stored = certificate.load(tmp_path / "certificate.json")
    assert (stored.safe, stored.passed) == (False, False)


def test_a_policy_that_only_lacks_performance_is_certified_with_a_warning_that_says_what(
    undrawn, tmp_path, caplog, monkeypatch
):
    for module in ("certificate", "question"):
        monkeypatch.setattr(f"experiments.certification.{module}.LIMITS", replace(LIMITS, entry=1.0, excess=1e-4))
    certified(laws.law(), tmp_path)
    stored = certificate.load(tmp_path / "certificate.json")
    assert (stored.safe, stored.passed) == (True, False)
    (warned,) = warnings(caplog)
    assert stored.failed
    assert all(str(check) in warned for check in worst(stored.failed))


def test_what_cannot_be_certified_ends_in_one_line(tmp_path: Path) -> None:
    given = laws.law()
    policy.save(tmp_path / "policy.npz", replace(given, metadata={**given.metadata, "model": {}}))
    share = find_policy("shipped").with_name("coculture.npz")
    for asked, words in (
        (tmp_path / "none.npz", r"no such file; give the policy\.npz"), ("", "^policy is empty"),
        (tmp_path, r"policy\.npz: its file has no model .*; set env\.mu=MU env\.tau=TAU"),
        (share, r"it sees \(logit_share, .*\); only density policies can be certified"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=words):
            command.body(CertifyConfig(policy=str(asked)), tmp_path)


def test_bounds_of_an_estimator_depend_on_the_od_and_return_from_a_file() -> None:
    """ln(1 + 0.005/0.1) / 0.06 = 0.813; at OD 1 it is 0.083, below the constant bound."""
    bounds = EstimateBounds(0.06, 0.1, 0.005, 0.05, 0.0, (0.05, 0.97), (0.2, 1.0))
    np.testing.assert_allclose(bounds.error_bound(np.array([0.1, 1.0, 0.0])), [0.8132, 0.1, np.inf], atol=1e-4)
    cases = np.array(
        [[1.0, 0.1, 0.5, 0.05], [1.0, 0.11, 0.5, 0.05], [1.0, 0.1, 0.5, 0.051], [1.0, 0.1, 0.98, 0.05],
         [1.0, np.nan, 0.5, 0.05], [0.1, 0.8, 0.5, 0.05], [1.0, 0.1, 0.04, 0.05], [1.0, 0.1, 0.05, 0.05],
         [1.0, 0.1, 0.97, 0.05], [0.1, 0.82, 0.5, 0.05], [1.0, 0.1, np.nan, 0.05], [1.0, 0.1, 0.5, np.nan]]
    )  # fmt: skip
    within = [True, False, False, False, False, True, False, True, True, False, False, False]
    np.testing.assert_array_equal(bounds.hold(*cases.T), within)
    assert EstimateBounds.of(json.loads(json.dumps(asdict(bounds)))) == bounds


@pytest.mark.parametrize("full_pumps", [(0.03,), pytest.param(None, marks=pytest.mark.slow)], ids=["one", "all"])
def test_the_shipped_policy_has_its_certificate(full_pumps: tuple[float, ...] | None) -> None:
    """Proven again, for one further B or for all, and attacked by few in every case."""
    shipped = find_policy("shipped")
    given = policy.load(shipped)
    stored = certificate.load(certificate.beside(shipped))
    assert stored.of == {**fingerprints(given), **settings(given)}
    assert stored.safe
    assert stored.passed
    assert not stored.config.quick
    found = certify(given, replace(stored.config, trajectories=0, full_pumps=full_pumps or stored.config.full_pumps))
    assert found.passed
    assert [attacked(given, found.question.loop, proof, 184)[0] for proof in found.proofs] == [0] * len(found.proofs)
    assert stored.config.trajectories == CertifyConfig().trajectories == 20_000
    assert stored.bounds is not None
    assert stored.bounds.proven == (0.05, 0.97)
    assert (stored.bounds.error, stored.bounds.od, stored.bounds.growth_share) == (0.1, 0.04, 0.5)  # what is watched


def test_a_certificate_goes_beside_its_policy_or_where_it_is_sent_and_never_into_the_program(tmp_path: Path) -> None:
    """A quick one stays in the run folder."""
    source, to, shipped = tmp_path / "mine.npz", str(tmp_path / "to.json"), find_policy("shipped")
    policy.save(source, laws.law())
    for config, of, where in (
        (CertifyConfig(), source, certificate.beside(source)), (CertifyConfig(quick=True), source, None),
        (CertifyConfig(to=to), source, Path(to)), (CertifyConfig(to=to, quick=True), source, Path(to)),
        (CertifyConfig(), shipped, None), (CertifyConfig(), Path(str(SHIPPED)), None),
        (CertifyConfig(to=to), shipped, Path(to)),
    ):  # fmt: skip
        assert command._place(config, of) == where
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for bad in ("mine.npz", ".", "nowhere/certificate.json"):
        with pytest.raises(UserError, match=r"to = .*: allowed a file NAME\.json in an existing folder"):
            command.body(CertifyConfig(policy=str(source), to=str(tmp_path / bad)), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_certificate_that_finds_no_room_elsewhere_is_said_and_stays_in_the_run_folder(undrawn, tmp_path, monkeypatch):
    write, to = files.write_json, tmp_path / "to.json"

    def full(path: Path, *given: Any, **named: Any) -> None:
        if path == to:
            raise OSError(28, "No space left on device")
        write(path, *given, **named)

    monkeypatch.setattr(files, "write_json", full)
    with pytest.raises(UserError, match=r"to\.json: not written \(No space left on device\); .*run/certificate\.json"):
        certified(laws.law(), tmp_path, f"to={to}")
    assert certificate.load(tmp_path / "run" / "certificate.json").passed
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["passed"] is True
    assert not certificate.beside(tmp_path / "policy.npz").exists()


def test_what_is_told_of_a_certificate_is_what_fails_and_what_comes_closest() -> None:
    checks = (
        Requirement("polygons", 0.0, 0.0), Requirement("nominal: entry", 0.4, 1.0),
        Requirement("noise: entry", 0.9, 1.0, "setpoint 0.4"), Requirement("uncertain: entry", 0.7, 1.0),
        Requirement("nominal: half-width", 0.5, 0.1, kind=PERFORMANCE),
        Requirement("noise: half-width", float("nan"), 2.0), Requirement("uncertain: half-width", 0.3, 2.0),
    )  # fmt: skip
    found = Certificate(None, (), checks, (), np.zeros(0), [], None, False)  # type: ignore[arg-type]
    told = [line.split("  ") for line in found.lines()]
    assert [word for word, _ in told] == ["pass", "pass", "short", "FAIL", "pass"]
    assert [line for _, line in told[2:]] == [str(check) for check in checks[4:]]
    assert told[1][1] == f"{checks[2]}; and 2 more"
    assert (found.safe, found.passed) == (False, False)
    assert ([c.value for c in found.failed(PERFORMANCE)], len(found.failed(SAFETY))) == ([0.5], 1)


def test_a_calibrated_pump_stays_calibrated_on_another_bench() -> None:
    """tau 0.3 was found where the bench says 20 mL: the pump gives 10 % more; with 12 mL it is 0.3 * 12 / 20.

    A policy of every pump is proven anew for the one that it will run with, whatever the nominal one of the bench is.
    """
    bench, model = Bench(volume_ml=12.0), EnvConfig(tau=0.25)
    relative = certificate.on_bench(laws.share_law(), ASKED, bench, model)
    assert (relative.bench, relative.env, relative.full_pumps) == (bench, model, ())
    asked = replace(ASKED, env=EnvConfig(tau=0.3))
    for ml, tau in ((20.0, 0.3), (12.0, 0.18)):
        bench = Bench(volume_ml=ml)
        found = certificate.on_bench(laws.law(), asked, bench, EnvConfig(tau=bench.tau)).env
        assert found is not None
        assert found.tau == pytest.approx(tau)


ATTACKED_BY_LESS = {
    "start_od": [(0.1, 1.5), (0.05, 1.2)], "growth_shares": [(0.3, 0.98), (0.04, 0.5)],
    "uncertainty": [0.2], "noise": [0.01], "error": [0.0], "error_od": [0.004],
    "error_share": [0.04], "error_gain": [0.1],
}  # fmt: skip
"""Settings by which less is asked of safety."""
MORE = replace(
    CertifyConfig(), start_od=(0.01, 2.0), growth_shares=(0.04, 0.98), uncertainty=0.4, noise=0.02,
    error=0.2, error_od=0.006, error_share=0.06, error_gain=0.3,
)  # fmt: skip


def test_whatever_is_asked_less_of_is_named_alone_and_what_is_asked_more_of_is_not() -> None:
    assert CertifyConfig().laxer() == MORE.laxer() == []
    for name, values in ATTACKED_BY_LESS.items():
        for value in values:
            (named,) = replace(MORE, **{name: value}).laxer()
            shown = list(value) if isinstance(value, tuple) else value
            assert named.startswith(f"{name} = {shown}, ")


def test_a_certificate_that_asks_for_less_or_has_other_limits_is_refused(tmp_path: Path) -> None:
    less = written(tmp_path / "less.npz", laws.law(), config=replace(ASKED, noise=0.0))
    assert "noise = 0.0, " in concluded(laws.law(), less).refused[0]
    for key, limit in asdict(LIMITS).items():
        other = written(tmp_path / "other.npz", laws.law(), limits=asdict(LIMITS) | {key: 1.01 * limit})
        assert "other limits" in concluded(laws.law(), other).refused[0]
        assert certificate.bounds(laws.law(), settings(laws.law()), other, EnvConfig()) is None


@pytest.mark.parametrize("share", [False, True], ids=["OD", "relative"])
def test_what_is_written_down_of_a_band_holds_what_was_proven(share: bool) -> None:
    """To six places, both ends outwards, and no further."""
    given = laws.share_law() if share else laws.law()
    found = proven(given, replace(ASKED, quick=True))
    content = certificate.content(given, settings(given), ASKED, found)
    proofs = {proof.case.name: proof for proof in found.proofs}
    assert len(content["cases"]) > 3
    for case in content["cases"]:
        proof, (low, high) = proofs[case["name"]], case["band"].T
        for outer, inner in ((-low, -proof.band.low), (high, proof.band.high), (case["half_width"], proof.half_width)):
            assert (outer >= inner).all()
            np.testing.assert_allclose(outer, inner, atol=1.001e-6)
        assert (np.abs(low * 1e6 - np.rint(low * 1e6)) < 1e-6).all()
        np.testing.assert_array_equal(case["entry_periods"], proof.band.periods)
        np.testing.assert_allclose(case["entry_over_physics"], proof.entry, atol=1e-4)
        np.testing.assert_allclose(case["law_half_width"], proof.law_half_width, atol=1e-6)
        assert case["holdable"].all()
    assert content["strips"] == ([0.05, 0.97, 184] if share else [0.4, 0.8, 80])
    assert content["setpoints"] == [0.4, 0.8]
    for level, depth in zip(found.levels, found.doses, strict=True):
        written_down = content["dose_below"][str(level)]
        assert (written_down >= depth).all()
        np.testing.assert_allclose(written_down, depth, atol=1.001e-3)


@pytest.mark.parametrize("changes", [{"od": -1.0}, {"growth_share": float("nan")}, {"proven": [0.9, 0.05]}])
def test_bounds_that_cannot_be_are_damage(relative: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    source = beside(relative, policy.load(relative), tmp_path)
    content = json.loads(certificate.beside(source).read_text())
    certificate.beside(source).write_text(json.dumps({**content, "bounds": {**content["bounds"], **changes}}))
    with pytest.raises(UserError, match="is damaged .*allowed|is damaged .*ranges from low to high"):
        unpacked(source, tmp_path / "run")


@pytest.mark.parametrize("backend", [ChiBioConfig(), SimulatedConfig()])
@pytest.mark.parametrize(("key", "value"), [("gate", 7), ("gate_sigma", -7.0)])
def test_a_setting_of_an_estimator_that_cannot_be_is_one_line(relative, tmp_path, backend, key, value):
    with pytest.raises(UserError, match=rf"controller\.estimator\.{key}"):
        unpacked(relative, tmp_path / "run", backend=backend, controller=LearnedConfig(estimator={key: value}))


def test_too_few_trajectories_are_asked_for_no_end_of_a_band() -> None:
    found = certify(laws.share_law(), replace(ASKED, trajectories=2000, quick=True))
    assert not [check for check in found.checks if "no attack reaches" in check.name]
    assert [check.value for check in found.checks if "left the band" in check.name] == [0.0]


def test_a_row_of_the_page_is_of_the_strips_that_a_pump_can_hold() -> None:
    """Of five strips from 0.3 to 0.8 the first and the fourth cannot be held; there every number is an extreme."""
    strips, held = np.linspace(0.3, 0.8, 6), np.array([False, True, True, False, True])

    def where_held(*values: float) -> np.ndarray:
        found = np.array([99.0, 0.0, 0.0, 0.0, 0.0])
        found[held] = values
        return found

    proof = SimpleNamespace(
        case=SimpleNamespace(name="a case"), holdable=held, half_width=where_held(0.02, 0.05, 0.03),
        law_half_width=where_held(0.01, 0.02, 0.04), excess=where_held(0.01, 0.03, -0.01),
        later=where_held(1.0, 2.0, 3.0), band=SimpleNamespace(periods=where_held(7.0, 5.0, 6.0)),
    )  # fmt: skip
    loop = SimpleNamespace(low=strips[:-1], high=strips[1:], in_od=lambda case, width: 10.0 * width)
    assert command._row(loop, proof) == {
        "case": "a case", "half-width, least": 0.02, "half-width, largest": 0.05,
        "one-line controller, largest": 0.04,
        "beyond the one-line controller, largest": 0.03, "half-width in OD, middle strip": 0.5,
        "periods after the one-line controller, largest": 3.0, "periods, largest": 7.0,
    }  # fmt: skip


def test_a_drop_that_is_written_down_says_where_it_is_and_from_which_dose_to_which() -> None:
    """Beyond x + r = 2.2 of a policy that gives the second largest dose in place of the largest there."""
    asked = replace(ASKED, setpoints=(0.79, 0.8))
    found = certify(laws.swapped_level(), asked)
    listed = certificate.content(laws.swapped_level(), {}, asked, found)["not_monotone"]
    assert listed
    for drop in listed:
        assert (drop["from"], drop["to"]) == (16, 15)
        assert 0.79 <= drop["second"] <= 0.8 < 1.4 < drop["first"]


def test_a_policy_is_proven_on_the_model_that_was_calibrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Mock(side_effect=CertificationError("far enough"))
    monkeypatch.setattr(command, "certify", asked)
    policy.save(tmp_path / "policy.npz", laws.law())
    (tmp_path / "calibrated.yaml").write_text("mu: 0.02\ntau: 0.4\n")
    for given in ({}, {"env_file": str(tmp_path / "calibrated.yaml")}, {"env": EnvConfig(mu=0.025)}):
        with pytest.raises(UserError, match="far enough"):
            command.body(CertifyConfig(policy=str(tmp_path), **given), tmp_path)
    configs = [call.args[1] for call in asked.call_args_list]
    found = [(config.env.mu, config.env.tau, config.env_file) for config in configs]
    assert found == [(0.03, 1 / 3, None), (0.02, 0.4, None), (0.025, 1 / 3, None)]


def test_the_summary_of_a_certificate_has_a_row_for_every_case_that_can_be_held(monkeypatch):
    monkeypatch.setattr(command, "_row", lambda loop, proof: proof.case)
    proofs = [SimpleNamespace(case=k, holdable=np.array(held)) for k, held in enumerate(([1, 1], [0, 0], [0, 1]))]
    kept = dict.fromkeys(("safe", "passed", "of", "setpoints", "bounds", "checks", "cannot_hold"), "kept")
    drop = {"first": -0.01, "second": 0.96, "from": 1, "to": 0}
    content = kept | {"observation": ["od", "setpoint"], "not_monotone": [drop], "strips": [0.0], "cases": ["other"]}
    found: Any = SimpleNamespace(proofs=proofs, question=SimpleNamespace(loop=None))
    named = {"od": -0.01, "setpoint": 0.96, "from action": 1, "to action": 0}
    assert command._summary(Path("a/policy.npz"), content, found) == kept | {
        "policy": "a/policy.npz", "cases": [0, 2], "a_higher_reading_gets_a_smaller_dose": [named],
        "observation": ["od", "setpoint"],
    }  # fmt: skip
