"""The file of a certificate, the command that writes it, and the device that asks for it."""

import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dqn import policy
from dqn.policy import fingerprint
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments import certify as command
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import CertifyConfig
from experiments.certification.judge import certify
from experiments.cli import files
from experiments.cli.frame import UserError
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.control.policies import find_policy
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.simulated import SimulatedConfig
from tests.experiments import laws
from tests.experiments.test_exits import ENVIRONMENT

ASKED = CertifyConfig(env=EnvConfig(), setpoints=(0.4, 0.8), trajectories=0)
SCENARIO = Scenario((0.45, 0.65), (30.0, 30.0), (37.0, 37.0))


def written(path: Path, given: policy.Policy, of: policy.Policy | None = None, **changes: Any) -> Path:
    """A policy file with the certificate of a policy (its own by itself), some of it changed."""
    of = given if of is None else of
    policy.save(path, given)
    content = certificate.content(of, ASKED, certify(of, ASKED))
    files.write_json(certificate.beside(path), {**content, **changes})
    return path


def unpacked(path: Path, folder: Path, **changes: Any) -> None:
    config = DeployConfig(**{"backend": ChiBioConfig(), "scenario": SCENARIO, "policy": str(path), **changes})
    folder.mkdir(exist_ok=True)
    assemble.unpack(config, folder)


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
    assert json.loads(kept.read_text())["fingerprint"] == fingerprint(policy.load(tmp_path / "run" / "policy.npz"))


def test_another_name_has_another_certificate(tmp_path: Path) -> None:
    written(tmp_path / "seed0003.npz", laws.law())
    assert (tmp_path / "seed0003.certificate.json").is_file()
    unpacked(tmp_path / "seed0003.npz", tmp_path / "run")


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "changed by one bit": ({"given": nudged(laws.law()), "of": laws.law()}, "is of another policy: one of them was"),
    "failed": (
        {"given": laws.law(gain=-laws.GAIN)},
        r"its certificate fails 15 requirements, the first: nominal: strips without",
    ),
    "said to have passed": (
        {"given": laws.low_corner(), "passed": True},
        r"proven anew, it fails: nominal: strips in which a low culture may be washed out: 1, .*\(setpoint 0.45\)",
    ),
    "elsewhere": (
        {"given": laws.law(), "setpoints": [0.5, 0.8]},
        r"certified for setpoints 0.5 to 0.8, .* asks for 0.45",
    ),
    "damaged": ({"given": laws.law(), "setpoints": None}, r"certificate.json is damaged \(TypeError"),
    "of another format": ({"given": laws.law(), "format": 0}, r"is damaged \(format 0, allowed 1"),
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
    assert f"python -m experiments.certify policy={source}" in said
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


def test_the_fingerprint_is_of_what_decides_and_nothing_else() -> None:
    given = laws.law()
    own = fingerprint(given)
    assert fingerprint(laws.law()) == own
    assert fingerprint(replace(given, metadata={**given.metadata, "regret_pct": 3.0})) == own
    assert fingerprint(nudged(given)) != own
    assert fingerprint(replace(given, metadata={**given.metadata, "control_min": 2.0})) != own
    assert fingerprint(replace(given, biases=(given.biases[0].astype(np.float64), *given.biases[1:]))) != own


def test_the_command_leaves_a_certificate_a_figure_and_a_page(tmp_path: Path) -> None:
    policy.save(tmp_path / "policy.npz", laws.law())
    config = command.main.config([f"policy={tmp_path}", "trajectories=1000"])
    folder = tmp_path / "run"
    folder.mkdir()
    command.body(config, folder)
    stored = certificate.load(tmp_path / "certificate.json")
    assert stored.passed
    assert (stored.fingerprint, stored.setpoints) == (fingerprint(laws.law()), (0.4, 0.8))
    assert stored.config.env is not None
    assert (stored.config.env.mu, stored.config.env.tau) == (0.03, 1 / 3)
    assert (folder / "figures" / "certificate.svg").is_file()
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "nominal: half-width over that of the law, OD" in page
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["passed"] is True
    assert [case["case"] for case in summary["cases"]] == ["nominal", "noise", "uncertain", "noise and uncertain"]


def test_a_policy_that_fails_ends_the_command_with_one_line_and_its_certificate_says_so(tmp_path: Path) -> None:
    policy.save(tmp_path / "policy.npz", laws.high_corner())
    call = [sys.executable, "-m", "experiments.certify", f"policy={tmp_path}", f"hydra.run.dir={tmp_path / 'run'}"]
    done = subprocess.run(call, capture_output=True, text=True, env=ENVIRONMENT, timeout=100, check=False)
    assert done.returncode == 1
    said = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(said) == 1
    assert (
        "not certified, 10 of 18 requirements fail, the first: nominal: strips without a band: 21, allowed 0" in said[0]
    )
    assert not certificate.load(tmp_path / "certificate.json").passed


def test_a_policy_that_is_none_or_says_no_model_ends_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no such file; give the policy\.npz"):
        command.body(CertifyConfig(policy=str(tmp_path / "none.npz")), tmp_path)
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
         [1.0, np.nan, 0.5, 0.05], [0.1, 0.8, 0.5, 0.05]]
    )  # fmt: skip
    np.testing.assert_array_equal(bounds.hold(*cases.T), [True, False, False, False, False, True])
    assert EstimateBounds.of(json.loads(json.dumps(asdict(bounds)))) == bounds


def test_the_shipped_policy_has_its_certificate() -> None:
    shipped = find_policy("shipped")
    given = policy.load(shipped)
    stored = certificate.load(certificate.beside(shipped))
    assert stored.fingerprint == fingerprint(given)
    assert stored.passed
    assert certify(given, replace(stored.config, trajectories=1000)).passed
    assert stored.bounds is not None
    assert stored.bounds.proven == (0.05, 0.97)
    assert (stored.bounds.error, stored.bounds.od, stored.bounds.growth_share) == (0.1, 0.04, 0.5)  # what is watched


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
    assert fingerprint(policy.load(tmp_path / "run" / "policy.npz")) == fingerprint(given)
