"""The file of a certificate, the command that writes it, and the device that asks for it."""

import json
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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
from experiments.certification.config import CertifyConfig, Limits
from experiments.certification.judge import Certificate, Check, certify
from experiments.certification.question import CertificationError, question
from experiments.certification.verdict import attacked
from experiments.cli import files
from experiments.cli.frame import UserError
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.control.policies import SHIPPED, Wanted, admit, find_policy
from experiments.laws.density import estimator as filters
from experiments.laws.density import learned
from experiments.laws.density.estimator import EstimatorConfig
from experiments.laws.density.learned import LearnedConfig, settings
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.simulated import SimulatedConfig
from tests.experiments import laws
from tests.experiments.test_exits import ENVIRONMENT
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.numeric

ASKED = CertifyConfig(env=EnvConfig(), setpoints=(0.4, 0.8), trajectories=0)
SCENARIO = Scenario((0.45, 0.65), (30.0, 30.0), (37.0, 37.0))


def written(path: Path, given: policy.Policy, of: policy.Policy | None = None, **changes: Any) -> Path:
    """A policy file with the certificate of a policy (its own by itself), some of it changed."""
    of = given if of is None else of
    policy.save(path, given)
    found = certify(of, ASKED)
    files.write_json(certificate.beside(path), {**certificate.content(of, settings(of), ASKED, found), **changes})
    return path


def unpacked(path: Path, folder: Path, **changes: Any) -> assemble.Setup:
    config = DeployConfig(**{"backend": ChiBioConfig(), "scenario": SCENARIO, "policy": str(path), **changes})
    folder.mkdir(exist_ok=True)
    return assemble.unpack(config, folder)


def nudged(given: policy.Policy) -> policy.Policy:
    """The same with one weight a unit in the last place higher."""
    weights = [w.copy() for w in given.weights]
    weights[1][0, 0] = np.nextafter(weights[1][0, 0], np.float32(np.inf))
    return replace(given, weights=tuple(weights))


def test_a_certified_policy_runs_on_a_device_and_its_run_keeps_both(tmp_path: Path) -> None:
    source = written(tmp_path / "policy.npz", laws.law())
    unpacked(source, tmp_path / "run")
    kept = tmp_path / "run" / "certificate.json"
    assert kept.read_bytes() == (tmp_path / "certificate.json").read_bytes()
    assert json.loads(kept.read_text())["of"] == fingerprints(policy.load(tmp_path / "run" / "policy.npz"))


def test_another_name_has_another_certificate(tmp_path: Path) -> None:
    written(tmp_path / "seed0003.npz", laws.law())
    assert (tmp_path / "seed0003.certificate.json").is_file()
    unpacked(tmp_path / "seed0003.npz", tmp_path / "run")


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "changed by one bit": (
        {"given": nudged(laws.law()), "of": laws.law()},
        r"certificate.json is of another: its weights \(put it back, or",
    ),
    "failed": (
        {"given": laws.law(gain=-laws.GAIN)},
        r"its certificate fails 15 of its requirements, the first: nominal: strips without",
    ),
    "said to have passed": (
        {"given": laws.low_corner(), "passed": True, "checks": []},
        r"proven anew for this bench and scenario, it fails: nominal: strips in which a low culture may be washed out: "
        r"1, .*\(setpoint 0.45\)",
    ),
    "elsewhere": (
        {"given": laws.law(), "setpoints": [0.5, 0.8]},
        r"certified for setpoints 0.5 to 0.8, .* asks for 0.45",
    ),
    "elsewhere on both sides": (
        {"given": laws.law(), "setpoints": [0.5, 0.6]},
        r"certified for setpoints 0.5 to 0.6, the scenario asks for 0.45, 0.65",
    ),
    "damaged": ({"given": laws.law(), "setpoints": None}, r"certificate.json is damaged \(TypeError"),
    "of another format": ({"given": laws.law(), "format": 0}, r"is damaged \(of format 0, this version reads 2"),
    "of the first format": ({"given": laws.law(), "format": 1}, r"is damaged \(of format 1, this version reads 2"),
}


@pytest.mark.parametrize(("made", "why"), REFUSED.values(), ids=list(REFUSED))
def test_a_device_refuses_what_is_not_proven_and_says_how_to_prove_it(
    tmp_path: Path, made: dict[str, Any], why: str
) -> None:
    source = written(tmp_path / "policy.npz", **made)
    with pytest.raises(UserError, match=rf"policy refused: .*{why}") as caught:
        unpacked(source, tmp_path / "run")
    said = str(caught.value)
    assert "\n" not in said
    assert ("train for this one" if "proven anew" in why else f"python -m experiments.certify policy={source}") in said
    assert said.endswith("force_policy=true runs it all the same")


def test_a_policy_without_certificate_is_refused_on_a_device_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = tmp_path / "policy.npz"
    policy.save(source, laws.law())
    with pytest.raises(
        UserError, match=r"it has no certificate \(python -m experiments.certify policy=.*policy\.npz\)"
    ):
        unpacked(source, tmp_path / "run")
    for backend in (SimulatedConfig(), EmulatorConfig()):
        unpacked(source, tmp_path / "run", backend=backend)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    unpacked(source, tmp_path / "run", force_policy=True)
    unpacked(source, tmp_path / "run", resume="RUN")
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warned) == 2
    assert all("it has no certificate" in line for line in warned)


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


@pytest.mark.parametrize(("own", "other"), PARTS.values(), ids=list(PARTS))
def test_a_device_names_the_part_of_a_policy_that_is_another(
    tmp_path: Path, own: policy.Policy, other: policy.Policy, request: pytest.FixtureRequest
) -> None:
    part = request.node.callspec.id
    source = written(tmp_path / "policy.npz", other, of=own)
    with pytest.raises(
        UserError, match=rf"policy refused: its certificate \S+ is of another: its {part} \(put it back"
    ):
        unpacked(source, tmp_path / "run")


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
    "gate": ({"gate_sigma": 20.0}, r"estimator\.gate_sigma = 20\.0, certified 5\.0"),
    "whole number": ({"gate_max": 20}, r"estimator\.gate_max = 20, certified 6"),
    "switch": ({"told": False}, r"estimator\.told = False, certified True"),
    "four": (
        {"pulse_cv": 0.0, "growth_cv": 0.0, "gate_od": 0.0, "noise_memory": 0.0},
        r"estimator\.gate_od = 0\.0, certified 0\.025; estimator\.growth_cv = 0\.0, certified 0\.05; "
        r"estimator\.noise_memory = 0\.0, certified 40\.0; .*",
    ),
}
changed = pytest.mark.parametrize(("changes", "named"), CHANGED.values(), ids=list(CHANGED))


@changed
def test_a_setting_of_the_estimator_on_the_command_line_is_another_policy(
    relative: Path, tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    """And what was not certified gets no bounds: surprises alone supervise it where it is forced."""
    given = [f"+controller.estimator.{key}={value}" for key, value in changes.items()]
    config = deploy.main.config([f"policy={relative}", "controller=dqn", "backend=chibio", *given])
    config = replace(config, scenario=SCENARIO)
    assert isinstance(config.controller, LearnedConfig)
    with pytest.raises(UserError, match=rf"policy refused: .* is of another: {named} \(put it back, or python -m"):
        assemble.unpack(config, tmp_path)
    forced = assemble.unpack(replace(config, force_policy=True), tmp_path)
    assert forced.bounds is None
    sound = assemble.unpack(replace(config, controller=LearnedConfig()), tmp_path)
    assert sound.bounds is not None
    assert sound.bounds.full_pump == pytest.approx(0.02 * 1.0 / (20.0 / 60.0))


@pytest.mark.parametrize(
    "failure",
    [{"passed": False}, {"checks": [{"name": "entry", "value": 3.0, "limit": 1.0, "where": "", "holds": False}]}],
    ids=["said", "by a requirement"],
)
@pytest.mark.parametrize("backend", [ChiBioConfig(), SimulatedConfig()], ids=["forced", "simulated"])
def test_bounds_of_a_certificate_that_failed_let_nobody_act(
    relative: Path, tmp_path: Path, failure: dict[str, Any], backend: Any
) -> None:
    """Where its policy flies all the same, surprises alone supervise it."""
    content = json.loads(certificate.beside(relative).read_text())
    assert content["passed"]
    assert content["bounds"]
    source = beside(relative, policy.load(relative), tmp_path)
    assert unpacked(source, tmp_path / "sound", backend=backend, force_policy=True).bounds is not None
    certificate.beside(source).write_text(json.dumps({**content, **failure}))
    assert unpacked(source, tmp_path / "run", backend=backend, force_policy=True).bounds is None


@changed
def test_a_setting_of_the_estimator_in_the_policy_file_is_another_policy(
    relative: Path, tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    """The network is the same."""
    given = policy.load(relative)
    other = replace(given, metadata={**given.metadata, "estimator": changes})
    assert fingerprints(other) == fingerprints(given)
    with pytest.raises(UserError, match=rf"policy refused: .* is of another: {named} \(put it back, or python -m"):
        unpacked(beside(relative, other, tmp_path), tmp_path / "run")


def test_settings_that_are_given_as_they_are_change_nothing(relative: Path, tmp_path: Path) -> None:
    """In file and on the command line; the command line replaces the file."""
    given, own = policy.load(relative), asdict(EstimatorConfig())
    source = beside(relative, replace(given, metadata={**given.metadata, "estimator": own}), tmp_path)
    assert unpacked(source, tmp_path / "run", controller=LearnedConfig(estimator={"gate_sigma": 5.0})).bounds
    other = replace(given, metadata={**given.metadata, "estimator": {**own, "gate_sigma": 20.0}})
    policy.save(source, other)
    assert unpacked(source, tmp_path / "run", controller=LearnedConfig(estimator={"gate_sigma": 5.0})).bounds


@pytest.mark.parametrize(
    ("module", "name", "value", "said"),
    [
        (filters, "LOUD", 30.0, r"filter\.loud = 30\.0, certified 21\.0"),
        (filters, "QUIET", 0.0, r"filter\.quiet = 0\.0, certified 0\.15"),
        (filters, "GAIN_RANGE", (0.2, 9.0), r"filter\.gain_range = \[0\.2, 9\.0\], certified \[0\.2, 3\.0\]"),
        (learned, "WATCHED", 1.0, r"fallback\.watched_sd = 1\.0, certified 2\.0"),
    ],
)
def test_a_program_with_another_supervisor_is_another_policy(
    relative: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, name: str, value: Any, said: str
) -> None:
    unpacked(relative, tmp_path / "run")
    monkeypatch.setattr(module, name, value)
    with pytest.raises(UserError, match=rf"is of another: {said} \(put"):
        unpacked(relative, tmp_path / "run")


def test_the_second_filter_is_part_of_what_is_certified(
    relative: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file's own settings are the old ones, so the first filter is the certified one."""
    given = policy.load(relative)
    own = replace(given, metadata={**given.metadata, "estimator": asdict(EstimatorConfig())})
    source = beside(relative, own, tmp_path)
    monkeypatch.setattr(learned, "EstimatorConfig", partial(EstimatorConfig, gate_sigma=6.0))
    with pytest.raises(UserError, match=r"is of another: fallback\.estimator\.gate_sigma = 6\.0, certified 5\.0 \(put"):
        unpacked(source, tmp_path / "run")


def test_a_policy_of_the_od_has_no_settings_beside_it() -> None:
    assert settings(laws.law()) == {}
    assert set(settings(laws.share_law())) == {
        *(f"{prefix}estimator.{key}" for prefix in ("", "fallback.") for key in asdict(EstimatorConfig())),
        *(f"fallback.{key}" for key in ("law", "watched_sd")),
        *(f"filter.{key.lower()}" for key in learned.FIXED),
    }


def test_a_policy_of_error_and_growth_share_is_proven_anew_for_another_bench(
    relative: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Full pump takes 0.05 * 5 / (20/60) = 0.75 off ln x instead of 0.06, which is no reason by itself.

    Asked are that B alone, errors, spread doses, slow errors and watched errors at the run's two setpoints, and the two
    of any setpoint.
    A Chi.Bio samples every 60 s: a whole run of one is in 12 mL, 0.02 / (12/60) = 0.1.
    """
    given, bench = policy.load(relative), Bench(period_s=300.0, max_rate=0.05)
    model = EnvConfig(tau=bench.tau, control_min=5.0, max_pump_rate=0.05)
    admit(given, relative, Wanted("name", bench, model, {}, SCENARIO.setpoints, 10.0, True, False), resumed=False)
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
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_a_policy_of_the_od_that_holds_another_volume_worse_is_refused_on_that_bench(tmp_path: Path) -> None:
    """In 12 mL a culture at rest needs mu tau / u_max = 0.3 of the pump; this one gives 0.5 at the setpoint."""
    source = written(tmp_path / "policy.npz", laws.law())
    unpacked(source, tmp_path / "run")
    with pytest.raises(
        UserError, match=r"policy refused: proven anew for this bench and scenario, it fails: noise and "
    ):
        unpacked(source, tmp_path / "run", bench=Bench(volume_ml=12.0))
    unpacked(source, tmp_path / "run", bench=Bench(volume_ml=24.0))


def test_a_quick_certificate_is_refused_by_name(tmp_path: Path) -> None:
    """Of a policy of the OD, which has no case less then, it is as good as any."""
    policy.save(tmp_path / "policy.npz", laws.share_law())
    words = [f"policy={tmp_path}", "quick=true", "trajectories=0", "setpoints=[0.4,0.8]"]
    config = command.main.config([*words, f"to={tmp_path / 'certificate.json'}"])
    (tmp_path / "run").mkdir()
    command.body(config, tmp_path / "run")
    assert certificate.load(tmp_path / "certificate.json").passed
    with pytest.raises(
        UserError, match=r"policy refused: its certificate is a quick one, without errors of the gain \("
    ):
        unpacked(tmp_path / "policy.npz", tmp_path / "run")
    quick = unpacked(tmp_path / "policy.npz", tmp_path / "forced", force_policy=True)
    assert quick.bounds is None
    policy.save(tmp_path / "policy.npz", laws.law())
    (tmp_path / "again").mkdir()
    command.body(config, tmp_path / "again")
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
    assert "nominal: half-width over that of the law, OD" in page
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["passed"] is True
    assert [case["case"] for case in summary["cases"]] == ["nominal", "noise", "uncertain", "noise and uncertain"]


def test_a_policy_that_fails_ends_the_command_with_one_line_and_its_certificate_says_so(tmp_path: Path) -> None:
    policy.save(tmp_path / "policy.npz", laws.high_corner())
    call = [sys.executable, "-m", "experiments.certify", f"policy={tmp_path}", f"hydra.run.dir={tmp_path / 'run'}"]
    done = subprocess.run(call, capture_output=True, text=True, env=ENVIRONMENT, timeout=PATIENCE_S, check=False)
    assert done.returncode == 1
    said = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(said) == 1
    assert (
        "not certified, 10 of 18 requirements fail, the first: nominal: strips without a band: 21, allowed 0" in said[0]
    )
    (helps,) = [line for line in (done.stdout + done.stderr).splitlines() if "what helps: " in line]
    assert "policy=shipped, which is certified" in helps
    assert not certificate.load(tmp_path / "certificate.json").passed


def test_a_policy_that_is_none_or_says_no_model_ends_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no such file; give the policy\.npz"):
        command.body(CertifyConfig(policy=str(tmp_path / "none.npz")), tmp_path)
    with pytest.raises(UserError, match="^policy is empty: give policy=latest, shipped, a run folder or a policy"):
        command.body(CertifyConfig(policy=""), tmp_path)
    given = laws.law()
    policy.save(tmp_path / "policy.npz", replace(given, metadata={**given.metadata, "model": {}}))
    with pytest.raises(UserError, match=r"policy\.npz: it does not say which model .*; give env\.mu=MU env\.tau=TAU"):
        command.body(CertifyConfig(policy=str(tmp_path)), tmp_path)


def test_another_model_is_one_override_away() -> None:
    assert command.main.config([]).env is None
    assert command.main.config(["env=sim"]).env == EnvConfig()
    given = command.main.config(["env.mu=0.02", "limits.entry=1.2"])
    assert given.env == EnvConfig(mu=0.02)
    assert given.limits.entry == 1.2


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


def test_a_quick_look_at_a_policy_leaves_the_certificate_beside_it(tmp_path: Path) -> None:
    policy.save(tmp_path / "mine.npz", laws.law())
    (tmp_path / "mine.certificate.json").write_text("of an hour")
    words = [f"policy={tmp_path / 'mine.npz'}", "quick=true", "trajectories=0", "setpoints=[0.4,0.8]"]
    (tmp_path / "run").mkdir()
    command.body(command.main.config(words), tmp_path / "run")
    assert certificate.load(tmp_path / "run" / "certificate.json").config.quick
    assert (tmp_path / "mine.certificate.json").read_text() == "of an hour"


def test_the_shipped_policy_has_its_certificate() -> None:
    """Proven again, and attacked: by few in every case, by as many as it takes to reach the ends of bands in six."""
    shipped = find_policy("shipped")
    given = policy.load(shipped)
    stored = certificate.load(certificate.beside(shipped))
    assert stored.of == {**fingerprints(given), **settings(given)}
    assert stored.passed
    assert not stored.config.quick
    found = certify(given, replace(stored.config, trajectories=0))
    assert found.passed
    assert [attacked(given, found.question.loop, proof, 1000)[0] for proof in found.proofs] == [0] * len(found.proofs)
    assert certify(given, replace(stored.config, quick=True)).passed
    assert stored.config.trajectories == CertifyConfig().trajectories == 20_000
    assert stored.bounds is not None
    assert stored.bounds.proven == (0.05, 0.97)
    assert (stored.bounds.error, stored.bounds.od, stored.bounds.growth_share) == (0.1, 0.04, 0.5)  # what is watched


@pytest.mark.parametrize("name", ["shipped", str(SHIPPED)], ids=["by name", "by path"])
def test_what_ships_is_certified_without_a_file_of_the_program_being_written(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    def program() -> dict[str, tuple[bytes, int]]:
        return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in SHIPPED.parent.iterdir()}

    before, to = program(), tmp_path / "elsewhere" / "mine.json"
    to.parent.mkdir()
    quick = [f"policy={name}", "quick=true", "trajectories=0"]
    for folder, given in (("first", []), ("second", [f"to={to}"])):
        (tmp_path / folder).mkdir()
        with caplog.at_level("INFO"):
            command.body(command.main.config([*quick, *given]), tmp_path / folder)
        assert program() == before
        assert certificate.load(tmp_path / folder / "certificate.json").config.quick
        assert to.is_file() is bool(given)
    assert (
        caplog.text.count("in the run folder alone: a quick one stands nowhere else; to=FILE writes it elsewhere") == 1
    )
    assert to.read_bytes() == (tmp_path / "second" / "certificate.json").read_bytes()


def test_a_certificate_goes_where_it_is_sent_and_not_beside_the_policy(tmp_path: Path) -> None:
    policy.save(tmp_path / "policy.npz", laws.law())
    command.body(command.main.config([f"policy={tmp_path}", "trajectories=0", f"to={tmp_path / 'to.json'}"]), tmp_path)
    (tmp_path / "certificate.json").unlink()  # the run folder's own, which is the same folder here
    assert certificate.load(tmp_path / "to.json").passed


def test_the_shipped_policy_runs_on_a_device(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    unpacked(Path("shipped"), tmp_path)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_a_file_of_the_first_format_is_the_same_policy_and_so_is_its_copy(tmp_path: Path) -> None:
    given = laws.law()
    written(tmp_path / "policy.npz", given)
    with np.load(tmp_path / "policy.npz") as content:
        arrays = {name: content[name] for name in content.files if not name.startswith("observation")}
    arrays["pump_rates"] = arrays.pop("actions")
    arrays["metadata"] = np.array(json.dumps({**given.metadata, "format": 1}))
    np.savez(tmp_path / "policy.npz", **arrays)
    unpacked(tmp_path / "policy.npz", tmp_path / "run")
    assert fingerprints(policy.load(tmp_path / "run" / "policy.npz")) == fingerprints(given)


def test_a_calibrated_pump_stays_calibrated_on_another_bench() -> None:
    """tau 0.3 was found where the bench says 20 mL: the pump gives 10 % more; with 12 mL it is 0.3 * 12 / 20."""
    asked = replace(ASKED, env=EnvConfig(tau=0.3))
    for ml, tau in ((20.0, 0.3), (12.0, 0.18)):
        bench = Bench(volume_ml=ml)
        found = certificate.on_bench(laws.law(), asked, bench, EnvConfig(tau=bench.tau)).env
        assert found is not None
        assert found.tau == pytest.approx(tau)


def test_a_policy_of_every_pump_is_proven_anew_for_the_one_it_will_run_with(relative: Path) -> None:
    """Calibrated to tau .25 on a bench of 12 mL, whose nominal one is .2."""
    bench, model = Bench(volume_ml=12.0), EnvConfig(tau=0.25)
    asked = certificate.on_bench(policy.load(relative), ASKED, bench, model)
    assert (asked.bench, asked.env, asked.full_pumps) == (bench, model, ())


def test_a_certificate_that_asks_for_less_than_usual_is_refused_and_says_what(relative: Path, tmp_path: Path) -> None:
    """It passes by its own limits; every value that is laxer is named, those that are stricter are not."""
    given = policy.load(relative)
    lax = replace(ASKED, error=0.0, noise=0.02, growth_shares=(0.3, 0.5), strip=0.004)
    lax = replace(lax, limits=replace(lax.limits, excess_share=10.0, late=0.0, reached=0.5))
    found = certify(given, lax)
    path = tmp_path / "own" / "policy.npz"
    path.parent.mkdir()
    policy.save(path, given)
    files.write_json(certificate.beside(path), certificate.content(given, settings(given), lax, found))
    with pytest.raises(UserError) as caught:
        unpacked(path, tmp_path / "run")
    said = str(caught.value)
    for part in (
        "error = 0.0, by itself 0.1", "limits.excess_share = 10.0, by itself 0.015625", "limits.reached = 0.5, by",
        "growth_shares = [0.3, 0.5], by itself [0.05, 0.97]",
    ):  # fmt: skip
        assert part in said
    assert not any(name in said for name in ("noise", "strip", "late"))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"growth_shares": (0.3, 0.97)}, ["growth_shares = [0.3, 0.97], by itself [0.05, 0.97]"]),
        ({"growth_shares": (0.05, 0.5)}, ["growth_shares = [0.05, 0.5], by itself [0.05, 0.97]"]),
        ({"growth_shares": (0.3, 0.98)}, ["growth_shares = [0.3, 0.98], by itself [0.05, 0.97]"]),
        ({"growth_shares": (0.04, 0.98)}, []),
        ({"start_od": (0.1, 1.5)}, ["start_od = [0.1, 1.5], by itself [0.05, 1.5]"]),
        ({"start_od": (0.05, 1.2)}, ["start_od = [0.05, 1.2], by itself [0.05, 1.5]"]),
        ({"start_od": (0.01, 2.0)}, []),
        ({"strip": 0.006, "error_od": 0.004}, ["error_od = 0.004, by itself 0.005", "strip = 0.006, by itself 0.005"]),
        ({"strip": 0.004, "error_od": 0.006}, []),
        ({"uncertainty": 0.2, "noise": 0.02}, ["uncertainty = 0.2, by itself 0.3"]),
        ({"uncertainty": 0.4, "noise": 0.01}, ["noise = 0.01, by itself 0.0108"]),
        ({"error_share": 0.04, "error_gain": 0.3}, ["error_share = 0.04, by itself 0.05"]),
        ({"error_share": 0.06, "error_gain": 0.1}, ["error_gain = 0.1, by itself 0.2"]),
        ({"limits": Limits(low_dose=2.0, excess=0.01)}, ["limits.low_dose = 2.0, by itself 1.0"]),
        ({"limits": Limits(reached=0.96, reached_nominal=0.8)}, ["limits.reached_nominal = 0.8, by itself 0.9"]),
        ({"limits": Limits(entry=1.2, late=0)}, ["limits.entry = 1.2, by itself 1.15"]),
    ],
)
def test_whatever_is_narrower_or_laxer_on_one_side_alone_is_named(changes: dict[str, Any], named: list[str]) -> None:
    assert replace(CertifyConfig(), **changes).laxer() == named


@pytest.mark.parametrize("share", [False, True], ids=["OD", "relative"])
def test_what_is_written_down_of_a_band_holds_what_was_proven(share: bool) -> None:
    """To six places, both ends outwards, and no further."""
    given = laws.share_law() if share else laws.law()
    found = certify(given, replace(ASKED, quick=True))
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


def test_what_is_told_of_a_certificate_is_what_fails_and_what_comes_closest() -> None:
    checks = (
        Check("polygons", 0.0, 0.0),
        Check("nominal: entry", 0.4, 1.0),
        Check("noise: entry", 0.9, 1.0, "setpoint 0.4"),
        Check("uncertain: entry", 0.7, 1.0),
        Check("nominal: half-width", 0.5, 0.1),
        Check("noise: half-width", float("nan"), 2.0),
        Check("uncertain: half-width", 0.3, 2.0),
    )
    told = Certificate(None, (), checks, (), np.zeros(0), [], None, False).told()  # type: ignore[arg-type]
    assert told == [
        "pass  polygons: 0, allowed 0",
        "pass  noise: entry: 0.9, allowed 1 (setpoint 0.4); and 2 more",
        "FAIL  nominal: half-width: 0.5, allowed 0.1",
        "FAIL  noise: half-width: nan, allowed 2",
        "pass  uncertain: half-width: 0.3, allowed 2",
    ]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"od": -1.0}, "allowed numbers of 0 and more"),
        ({"growth_share": float("nan")}, "allowed numbers of 0 and more"),
        ({"proven": [0.9, 0.05]}, "ranges from low to high"),
    ],
)
def test_bounds_that_cannot_be_are_damage(relative: Path, tmp_path: Path, changes: dict[str, Any], why: str) -> None:
    content = json.loads(certificate.beside(relative).read_text())
    path = tmp_path / "own" / "policy.npz"
    path.parent.mkdir()
    policy.save(path, policy.load(relative))
    certificate.beside(path).write_text(json.dumps({**content, "bounds": {**content["bounds"], **changes}}))
    with pytest.raises(UserError, match=f"is damaged .*{why}"):
        unpacked(path, tmp_path / "run")


@pytest.mark.parametrize("to", ["policy.npz", ".", "nowhere/certificate.json"])
def test_a_certificate_goes_into_a_json_file_of_a_folder_that_is_there(tmp_path: Path, to: str) -> None:
    policy.save(tmp_path / "policy.npz", laws.law())
    before = (tmp_path / "policy.npz").read_bytes()
    with pytest.raises(UserError, match=r"to = .*: allowed a file NAME\.json in a folder that is there"):
        command.body(CertifyConfig(policy=str(tmp_path), to=str(tmp_path / to)), tmp_path)
    assert (tmp_path / "policy.npz").read_bytes() == before


@pytest.mark.parametrize("backend", [ChiBioConfig(), SimulatedConfig()])
@pytest.mark.parametrize(("key", "value"), [("gate", 7), ("gate_sigma", -7.0)])
def test_a_setting_of_an_estimator_that_cannot_be_is_one_line(
    relative: Path, tmp_path: Path, backend: Any, key: str, value: float
) -> None:
    with pytest.raises(UserError, match=rf"controller\.estimator\.{key}"):
        unpacked(relative, tmp_path / "run", backend=backend, controller=LearnedConfig(estimator={key: value}))


def test_a_policy_of_a_share_is_told_what_is_proven() -> None:
    with pytest.raises(UserError, match=r"it sees \(logit_share, .*\); what is proven is how a density is held"):
        command.body(CertifyConfig(policy=str(find_policy("shipped").with_name("coculture.npz"))), Path())


def test_too_few_trajectories_are_asked_for_no_end_of_a_band() -> None:
    found = certify(laws.share_law(), replace(ASKED, trajectories=2000, quick=True))
    assert not [check for check in found.checks if "no attack reaches" in check.name]
    assert [check.value for check in found.checks if "left the band" in check.name] == [0.0]


def test_a_row_of_the_page_is_of_the_strips_that_a_pump_can_hold() -> None:
    """Of five strips from 0.3 to 0.8 the first and the fourth cannot be held, where every number is the largest."""
    strips, held = np.linspace(0.3, 0.8, 6), np.array([False, True, True, False, True])

    def where_held(*values: float) -> np.ndarray:
        found = np.array([0.0, 9.0, 9.0, 0.0, 9.0])
        found[~held], found[held] = 99.0, values
        return found

    proof = SimpleNamespace(
        case=SimpleNamespace(name="a case"), holdable=held, half_width=where_held(0.02, 0.05, 0.03),
        law_half_width=where_held(0.01, 0.02, 0.04), excess=where_held(0.01, 0.03, -0.01),
        later=where_held(1.0, 2.0, 3.0), band=SimpleNamespace(periods=where_held(7.0, 5.0, 6.0)),
    )  # fmt: skip
    loop = SimpleNamespace(low=strips[:-1], high=strips[1:], in_od=lambda case, width: 10.0 * width)
    assert command._row(loop, proof) == {
        "case": "a case", "half-width, least": 0.02, "half-width, largest": 0.05, "law, largest": 0.04,
        "over the law, largest": 0.03, "half-width in OD, middle strip": 0.5, "periods after the law, largest": 3.0,
        "periods, largest": 7.0,
    }  # fmt: skip
    none = where_held(0.02, 0.05, 0.03)
    none[~held] = 0.0
    proof.half_width = none
    assert command._row(loop, proof)["half-width, least"] == 0.02


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
    asked: list[CertifyConfig] = []

    def enough(given: policy.Policy, config: CertifyConfig) -> Certificate:
        asked.append(config)
        raise CertificationError("far enough")

    monkeypatch.setattr(command, "certify", enough)
    policy.save(tmp_path / "policy.npz", laws.law())
    (tmp_path / "calibrated.yaml").write_text("mu: 0.02\ntau: 0.4\n")
    for given in ({}, {"env_file": str(tmp_path / "calibrated.yaml")}, {"env": EnvConfig(mu=0.025)}):
        with pytest.raises(UserError, match="far enough"):
            command.body(CertifyConfig(policy=str(tmp_path), **given), tmp_path)  # type: ignore[arg-type]
    models = [(config.env.mu, config.env.tau) for config in asked if config.env is not None]
    assert models == [(0.03, 1 / 3), (0.02, 0.4), (0.025, 1 / 3)]
    assert [config.env_file for config in asked] == [None] * 3


def test_a_certificate_that_finds_no_room_elsewhere_is_said_and_stays_in_the_run_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write, to = files.write_json, tmp_path / "to.json"

    def full(path: Path, *given: Any, **named: Any) -> None:
        if path == to:
            raise OSError(28, "No space left on device")
        write(path, *given, **named)

    monkeypatch.setattr(files, "write_json", full)
    monkeypatch.setattr(command, "_summary", lambda source, content, found: {"passed": content["passed"]})
    for name in (
        "certification.figure.figure",
        "reporting.charts.save",
        "reporting.page.save",
        "reporting.page.of_runs",
    ):
        monkeypatch.setattr(f"experiments.{name}", lambda *given: "drawn")
    told: list[tuple[Any, ...]] = []

    def tell(*given: Any) -> None:
        told.append(given)

    events = SimpleNamespace(picture=tell, text=tell, close=lambda: None)
    monkeypatch.setattr("experiments.reporting.tensorboard.Events", lambda folder: events)
    found: Any = SimpleNamespace(told=lambda: ["pass  one", "FAIL  two"], quick=False)
    with caplog.at_level("WARNING"):
        unwritten = command._write(tmp_path, tmp_path / "policy.npz", {"passed": False}, to, found)
    assert unwritten == f"{to}: not written (No space left on device); {tmp_path}/certificate.json is the same"
    assert caplog.messages == [unwritten]
    assert json.loads((tmp_path / "certificate.json").read_text()) == {"passed": False}
    assert json.loads((tmp_path / "summary.json").read_text()) == {"passed": False}
    assert told == [("figures/certificate", "drawn", 0), ("run/summary", "- pass  one\n- FAIL  two")]


def test_the_summary_of_a_certificate_has_a_row_for_every_case_that_can_be_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command, "_row", lambda loop, proof: proof.case)
    proofs = [SimpleNamespace(case=k, holdable=np.array(held)) for k, held in enumerate(([1, 1], [0, 0], [0, 1]))]
    content = {name: name.upper() for name in ("passed", "of", "observation", "setpoints", "bounds", "checks")}
    drop = {"first": -0.01, "second": 0.96, "from": 1, "to": 0}
    content |= {"observation": ["od", "setpoint"], "not_monotone": [drop]}
    content |= {"cannot_hold": ["x"], "strips": [0.0], "cases": ["of the certificate"]}
    found: Any = SimpleNamespace(proofs=proofs, question=SimpleNamespace(loop=None))
    summary = command._summary(Path("a/policy.npz"), content, found)
    assert summary.pop("cases") == [0, 2]
    assert summary.pop("policy") == "a/policy.npz"
    (named,) = summary.pop("a_higher_reading_gets_a_smaller_dose")
    assert named == {"od": -0.01, "setpoint": 0.96, "from action": 1, "to action": 0}
    left_out = ("strips", "cases", "not_monotone")
    assert summary == {name: value for name, value in content.items() if name not in left_out}
