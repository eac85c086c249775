"""Which policy a run finds, and which ones it lets near a culture."""

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dqn import policy
from envs.bench import Bench
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments import demo
from experiments.certification.judge import KINDS, PERFORMANCE, SAFETY, worst
from experiments.cli.frame import UserError
from experiments.coculture import policies as share_policies
from experiments.coculture.policies import KEPT as COMPOSITION_POLICY
from experiments.coculture.policies import composition_policy
from experiments.control import assemble, policies
from experiments.control.config import DeployConfig
from experiments.control.messages import OtherPeriod, PumpsTooMuch
from experiments.control.policies import find_policy, load_policy
from experiments.laws import registry
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.emulator.process import EmulatorProcess
from hardware.simulated import SimulatedConfig
from tests.experiments import laws
from tests.experiments.proofs import proven, written

TRAINED = {"updates": 36_000, "regret_pct": 0.1, "model": {"setpoints": [0.2, 0.6, 1.0]}}
DOUBTFUL = {
    "untrained": ({"updates": 0}, r"before the first update \(train for more steps than agent.learn_start\)"),
    "poor": ({"regret_pct": 127_981.0}, r"its regret is 127981 %, more than 10 %"),
    "elsewhere": (
        {"model": {"setpoints": [0.55, 0.7]}},
        r"trained for setpoints 0.55 to 0.7, but the scenario has 0.5, 0.8 \(train with env.setpoints",
    ),
}
doubtful = pytest.mark.parametrize(("metadata", "message"), DOUBTFUL.values(), ids=list(DOUBTFUL))


def deployed(tmp_path: Path, metadata: dict[str, Any], **changes: Any) -> DeployConfig:
    """The config of a run at 0.8, 0.65 and 0.5 with a certified policy of this training."""
    given = laws.law()
    written(tmp_path / "given.npz", replace(given, metadata={**given.metadata, **TRAINED, **metadata}))
    scenario = Scenario((0.8, 0.65, 0.5), (30.0,) * 3, (37.0,) * 3)
    return DeployConfig(**{"scenario": scenario, "policy": str(tmp_path / "given.npz"), **changes})


@doubtful
@pytest.mark.parametrize("backend", [SimulatedConfig(), EmulatorConfig(), ChiBioConfig()], ids=lambda b: b.kind)
def test_what_a_training_lacks_is_warned_of_where_the_policy_is_proven_to_be_safe(
    tmp_path: Path, metadata: dict[str, Any], message: str, backend: Any, caplog: pytest.LogCaptureFixture
) -> None:
    changes = {"backend": backend}
    assert assemble.unpack(deployed(tmp_path, metadata, **changes), tmp_path).policy is not None
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warned) == 1
    assert re.search(message, warned[0])


@pytest.mark.parametrize(
    ("changes", "refused"),
    [({}, True), ({"force_policy": True}, False), ({"resume": "RUN"}, False)],  # its culture is in the vial already
    ids=["new", "forced", "resumed"],
)
def test_a_policy_that_is_not_safe_is_kept_from_a_culture_with_all_that_it_lacks_in_one_line(
    tmp_path: Path, changes: dict[str, Any], refused: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """What its certificate says, what its performance and its training lack, and the one word that runs it."""
    config = deployed(tmp_path, {"regret_pct": 127.0, "updates": 0}, backend=ChiBioConfig(), **changes)
    written(tmp_path / "given.npz", replace(laws.high_corner(), metadata=policy.load(tmp_path / "given.npz").metadata))
    if refused:
        with pytest.raises(UserError, match=r"^policy refused: .*; .*force_policy=true$") as caught:
            assemble.unpack(config, tmp_path)
        assert not caplog.messages
        said = str(caught.value)
    else:
        assert assemble.unpack(config, tmp_path).policy is not None
        said = " ".join(caplog.messages)
    failed = [check for check in proven(laws.high_corner()).checks if not check.holds]
    assert {check.kind for check in failed} == {SAFETY, PERFORMANCE}
    for kind in KINDS:
        assert all(str(check) in said for check in worst(check for check in failed if check.kind == kind))
    assert "its regret is 127 %" in said
    assert "before the first update" in said
    assert "\n" not in said


def test_a_policy_is_sound_at_the_very_ends_of_what_is_allowed(tmp_path, caplog):
    """Its regret is as large as may be; asked for are its lowest and highest setpoint."""
    edge = {"regret_pct": 10.0, "model": {"setpoints": [0.8, 0.65, 0.5]}, "updates": 1}
    assemble.unpack(deployed(tmp_path, edge, backend=ChiBioConfig()), tmp_path)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_a_policy_that_pumps_faster_than_the_bench_allows_is_refused_with_both_rates(tmp_path: Path) -> None:
    """It was trained for 0.02 mL/s; one of shares of the bench's own largest rate runs on any."""
    policy.save(tmp_path / "policy.npz", laws.law())
    assert load_policy(str(tmp_path), 1.0, 0.02).actions.max() == 0.02  # of the folder that holds it
    with pytest.raises(PumpsTooMuch) as fast:
        load_policy(str(tmp_path), 1.0, 0.019)
    assert (fast.value.fields["own"], fast.value.fields["most"]) == (0.02, 0.019)
    with pytest.raises(OtherPeriod) as slow:
        load_policy(str(tmp_path), 0.5, 0.02)
    assert (slow.value.fields["own_min"], slow.value.fields["asked_min"]) == (1.0, 0.5)
    assert load_policy("shipped", 0.5, 0.001).actions.max() == 1.0


def test_a_share_s_policy_of_a_deployment_is_its_composition_policy(tmp_path: Path) -> None:
    """Any other folder is a training's; a deployment has the policy of its density as policy.npz."""
    assert share_policies._found(str(tmp_path)) == tmp_path / "policy.npz"
    (tmp_path / "journal.jsonl").touch()
    assert share_policies._found(str(tmp_path)) == tmp_path / COMPOSITION_POLICY


def test_each_learned_law_of_a_share_has_a_policy_of_its_own_that_ships(tmp_path: Path) -> None:
    for kind, sees in (("dqn", 4), ("dqn_preview", 6)):
        (tmp_path / kind).mkdir()
        flies = composition_policy(kind, "shipped", tmp_path / kind, False)
        assert flies is not None
        assert len(flies.observation) == sees
        kept = policy.load(tmp_path / kind / COMPOSITION_POLICY)
        assert kept.observation == flies.observation
    assert composition_policy("midpoint", "shipped", tmp_path, False) is None
    other = tmp_path / "dqn" / COMPOSITION_POLICY  # whatever is asked for, a resumed run goes on with its copy
    for resumed, sees in ((True, 6), (False, 4)):
        goes_on = composition_policy("dqn_preview", str(other), tmp_path / "dqn_preview", resumed)
        assert goes_on is not None
        assert len(goes_on.observation) == sees
    assert not (tmp_path / COMPOSITION_POLICY).exists()


def test_each_step_of_the_demo_takes_what_the_step_before_it_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrated, trained on that, certified, run by the device, reported as one; a step that fails is the last one."""
    place = Path("runs/demo/now")
    steps = {name: dict(word.split("=", 1) for word in words) for name, *words in demo.commands(place)}
    folders = {
        name: f"{place}/{k}_{name}" for k, name in enumerate(("calibrate", "train", "certify", "deploy", "report"), 1)
    }
    assert {name: given["hydra.run.dir"] for name, given in steps.items()} == folders
    assert steps["train"]["env_file"] == f"{place}/1_calibrate/calibrated.yaml"
    assert [steps[name]["policy"] for name in ("certify", "deploy")] == [f"{place}/2_train/policy.npz"] * 2
    assert steps["deploy"]["backend"] == "emulator"
    assert steps["report"]["run"] == str(place)
    ran: list[str] = []
    status = {"deploy": 3}
    monkeypatch.setattr(demo, "step", lambda words, signals: (ran.append(words[0]), status.get(words[0], 0))[1])
    monkeypatch.setattr("sys.argv", ["demo"])
    with pytest.raises(SystemExit) as ended:
        demo.main()
    assert (ended.value.code, ran) == (3, list(folders)[:4])
    status.clear()
    ran.clear()
    demo.main()
    assert ran == list(folders)


def test_latest_is_what_train_or_demo_wrote_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Copies of policies that runs of a controller keep are none."""
    monkeypatch.chdir(tmp_path)
    _, learned, _, flown, _ = (
        Path(step[-1].removeprefix("hydra.run.dir=")) / "policy.npz" for step in demo.commands(Path("runs/demo/now"))
    )
    swept = Path("runs/train/then_sweep/3/policy.npz")
    copies = [flown, Path("runs/deploy/later/policy.npz"), Path("runs/benchmark/later/training/paper/policy.npz")]
    for age, path in enumerate([swept, learned, *copies]):
        path.parent.mkdir(parents=True)
        policy.save(path, laws.law())
        os.utime(path, (1e9 + age, 1e9 + age))
    assert find_policy("latest") == learned
    os.utime(swept, (2e9, 2e9))
    assert find_policy("latest") == swept


@pytest.mark.parametrize(
    ("name", "changes", "said", "remedy", "required"),
    [
        ("latest", {}, "policy=latest: no training run under runs/", "python -m experiments.train", False),
        ("nowhere.npz", {}, "policy nowhere.npz: no such file", "give another policy=PATH", True),
        ("given.npz", {"at_stake": True}, "it has no certificate", policies.FORCE, True),
        ("given.npz", {"at_stake": True, "forced": True}, "its regret is 127 %",
         "a device refuses it without force_policy=true", False),
    ],
)  # fmt: skip
def test_a_look_at_a_policy_says_what_is_wrong_with_it_and_whether_a_run_would_begin(
    name: str, changes: dict[str, Any], said: str, remedy: str, required: bool, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    given = laws.law()
    policy.save(tmp_path / "given.npz", replace(given, metadata={**given.metadata, **TRAINED, "regret_pct": 127.0}))
    asked = policies.WantedPolicy(name, Bench(), EnvConfig(), {}, (0.5,), at_stake=False, forced=False)
    found = policies.policy_check(replace(asked, **changes))
    assert (found.name, found.remedy, found.required) == ("policy", remedy, required)
    assert said in found.detail
    assert not found.ok


@pytest.fixture(scope="module")
def device() -> Iterator[ChiBioConfig]:
    """A device of the kind that runs cultures, as far as the program can see."""
    with EmulatorProcess(["--reactors", "M0", "--speed", "30", "--od", "0.5"]) as emulator:
        yield ChiBioConfig(url=emulator.url, speed=30.0)


def lines(config: DeployConfig, folder: Path, caplog: pytest.LogCaptureFixture) -> list[str]:
    """What the preflight says of the policy, after it has been through."""
    with caplog.at_level("INFO"):
        assemble.run_preflight(assemble.unpack(config, folder), folder)
    assert any("M0 present" in record.getMessage() for record in caplog.records)
    return [line for record in caplog.records if "  policy: " in (line := record.getMessage())]


def test_the_device_is_looked_at_before_anything_was_trained(device, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    config = DeployConfig(backend=device, preflight_only=True, policy="latest")
    said = lines(config, tmp_path, caplog)
    assert len(said) == 1
    assert said[0].startswith("note  policy: policy=latest: no training run under runs/")
    caplog.clear()
    assert lines(replace(config, controller=registry.config("pi")), tmp_path, caplog) == []


def test_a_preflight_says_whether_a_policy_would_be_refused(device, tmp_path, caplog):
    config = deployed(tmp_path, {}, backend=device, preflight_only=True)
    assert lines(config, tmp_path, caplog) == [
        "pass  policy: regret 0.1 % against the optimum of its model, setpoints 0.2 to 1, proven safe"
    ]
    written(tmp_path / "given.npz", laws.high_corner())
    with pytest.raises(UserError, match=r"preflight: 1 of \d+ checks failed, the first: FAIL  policy: .* not safe: "):
        lines(config, tmp_path, caplog)
