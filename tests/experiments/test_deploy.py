"""Deploying as a user does: a policy file, a scenario, a simulated reactor, and what is left in the run folder."""

import csv
import errno
import json
import os
import subprocess
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from dqn import policy
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.plant.pump import PumpConfig
from envs.scenario import Scenario
from envs.task import EnvConfig, step_factors
from experiments.cli import files, frame
from experiments.control import assemble, notify, policies, timetable
from experiments.control import run as control
from experiments.control.config import DeployConfig
from experiments.deploy import main as command
from experiments.laws import registry
from experiments.laws.density.learned import LearnedController
from experiments.loop.loop import ClosedLoop
from experiments.record.curves import Curves
from experiments.record.messages import AlarmsTold
from experiments.recordings.reader import read_recording
from hardware.chibio.messages import Absent
from hardware.errors import DeviceStateError
from hardware.family import family_of
from hardware.messages import PumpsNotOff
from hardware.reactor import Command
from hardware.safety.config import Responses, SafetyConfig
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.storage.journal import read_journal
from tests import programs
from tests.hardware.driver_lab import DriverLab

ROOT = programs.ROOT
pytestmark = pytest.mark.xdist_group("deploy")  # its tests share a run, made once


def run(*overrides: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return programs.run("experiments.deploy", *overrides, cwd=cwd, WITHOUT_FIGURES="1")


def inverse_policy(control_min: float = 1.0) -> policy.Policy:
    """A hand-made network that pumps u = 0.01 + 0.1 (x - setpoint), the steady rate of the nominal model plus feedback.

    One ReLU layer: Q_a = -|u_a - u| as -relu(u_a - u) - relu(u - u_a), which is largest at the nearest rate.
    """
    rates = EnvConfig().pump_rates()
    n = rates.size
    w0 = np.zeros((2, 2 * n), dtype=np.float32)
    w0[:, :n], w0[:, n:] = np.array([[-0.1], [0.1]]), np.array([[0.1], [-0.1]])
    b0 = np.concatenate([rates - 0.01, 0.01 - rates]).astype(np.float32)
    w1 = -np.concatenate([np.eye(n), np.eye(n)]).astype(np.float32)
    metadata = {"format": 2, "observation": ["od", "setpoint"], "control_min": control_min, "regret_pct": 1.0}
    one, none = np.eye(2, dtype=np.float32), np.zeros(2, np.float32)
    return policy.Policy(
        (w0, w1), (b0, np.zeros(n, np.float32)), one, none, rates, none - np.inf, none + np.inf, metadata
    )


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy.npz"
    policy.save(path, inverse_policy())
    return path


@pytest.fixture(scope="module")
def deployed(policy_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("deploy")
    done = run(f"policy={policy_file}", "hydra.run.dir=run", "backend.reactors=[M0,M1]", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "run"


def test_summary_and_recording_tell_the_whole_run(deployed):
    summary = json.loads((deployed / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert [w["setpoint"] for w in summary["windows"]] == [0.8, 0.65, 0.5] * 2
    for window in summary["windows"]:
        assert all(np.isfinite(window[key]) for key in ("itae", "itae_mean", "settling_min"))
        assert window["steady_abs_error"] < 0.03
        assert window["ise_mean"] == pytest.approx(window["ise"] / 30)
    with open(deployed / "recordings" / "M1.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    minutes = np.array([float(r["time_min"]) for r in rows])
    np.testing.assert_allclose(np.diff(minutes), 1.0)
    assert summary["minutes"] >= 90
    assert rows[0]["phase"] == "-1"
    assert {r["setpoint"] for r in rows} == {"0.8", "0.65", "0.5"}
    for row in rows:
        assert float(row["volume_ml"]) == pytest.approx(60 * float(row["pump_rate_ml_s"]))
    given = {name: r["volume_ml"] for name, r in summary["reactors"].items()}
    assert sum(float(r["volume_ml"]) for r in rows) == pytest.approx(given["M1"])
    assert summary["volume_ml"] == pytest.approx(sum(given.values()))
    recording = read_recording(deployed / "recordings" / "M1.csv")  # as a calibration reads it
    np.testing.assert_allclose(recording.pump_rate, [float(r["pump_rate_ml_s"]) for r in rows])


@pytest.mark.slow
def test_same_seed_same_recording_and_another_seed_another(policy_file, tmp_path):
    texts, short = [], ["scenario=hold", "scenario.minutes=[20]"]
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        words = f"policy={policy_file}", f"backend.seed={seed}", f"hydra.run.dir={name}"
        assert run(*words, *short, cwd=tmp_path).returncode == 0
        texts.append((tmp_path / name / "recordings" / "M0.csv").read_text())
    assert texts[0] == texts[1] != texts[2]


@pytest.mark.parametrize(
    ("word", "parts"),
    [
        ("policy=nowhere.npz", ["nowhere.npz"]),
        ("scenario.setpoints=[5,5,5]", ["scenario.setpoints = [5.0, 5.0, 5.0]", "0 < OD <= 1.5"]),
        ("env_file=nowhere.yaml", ["nowhere.yaml"]),
        (b"not a zip", ["policy.npz"]),
        (b"PK\x03\x04 torn", ["policy.npz"]),
        (inverse_policy(control_min=2.0), ["2.0 min", "1.0 min"]),  # another control period
    ],
)
def test_bad_input_ends_in_one_line(word, parts, tmp_path):
    if isinstance(word, bytes):
        (tmp_path / "policy.npz").write_bytes(word)
    elif not isinstance(word, str):
        policy.save(tmp_path / "policy.npz", word)
    done = run(word if isinstance(word, str) else "policy=policy.npz", cwd=tmp_path)
    assert done.returncode == 1
    assert all(part in done.stderr for part in parts)
    assert len([line for line in done.stderr.strip().splitlines() if not line[:2].isdigit()]) == 1
    assert "Traceback" not in done.stderr


class Tell:
    """A hook that keeps what it is told."""

    def __init__(self, told):
        self.told = told

    def __call__(self, event, text, reactor=""):
        self.told.append((event, reactor, text))

    def close(self):
        self.told.append("closed")


def test_a_run_says_which_reactor_was_stopped_and_what_each_of_them_was_given(tmp_path, monkeypatch, caplog):
    """M0 grows towards 1.2 for 20 min without a dose; M1 is held at 0.4, and given up once it has had 3 mL."""
    told = []
    monkeypatch.setattr(notify, "opened", lambda target, run, resumed: Tell(told))
    monkeypatch.setattr(control.charts, "save", lambda figure, folder, name: folder / name)  # takes most of the time
    monkeypatch.setattr(Curves, "end", lambda *given: told.append(("curves", given[1]["outcome"])))
    config = DeployConfig(
        SimulatedConfig(reactors=("M0", "M1")), PlantConfig(start_od=0.45), controller=registry.config("pi_tuned"),
        scenario=Scenario((0.4,), (12.0,), (37.0,)), fsync=False,
        safety=SafetyConfig(ml_per_run=3.0, responses=Responses(budget="stop")),
        each={"M0": {"setpoints": [1.2], "minutes": [20.0], "role": "control"}},
    )  # fmt: skip
    with caplog.at_level("INFO"):
        control.deploy(config, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["outcome"] == "stopped by the interlock: M1"
    assert summary["minutes"] == 20.0
    assert {name: r["role"] for name, r in summary["reactors"].items()} == {"M0": "control", "M1": "replicate"}
    fed = {name: r["volume_ml"] for name, r in summary["reactors"].items()}
    assert fed["M0"] == 0.0
    assert 2.0 < fed["M1"] <= 3.0
    assert summary["volume_ml"] == fed["M1"]
    assert [(w["reactor"], w["setpoint"], w["end_min"]) for w in summary["windows"]] == [
        ("M0", 1.2, 20.0), ("M1", 0.4, 12.0),
    ]  # fmt: skip
    assert [row for row in told if row[0] != "alarm"] == [
        ("start", "", "started: M0, M1"), ("curves", "stopped by the interlock: M1"),
        ("end", "", "stopped by the interlock: M1"), "closed",
    ]  # fmt: skip
    assert {row[1] for row in told if row[0] == "alarm"} == {"M1"}
    assert f"{fed['M1']:.1f} mL" in caplog.text
    alarms = [r.msg.fields for r in caplog.records if isinstance(r.msg, AlarmsTold)]
    assert [(row["reactor"], row["kinds"].split()[0]) for row in alarms] == [("M1", "budget")]
    starts = [row for row in read_journal(tmp_path / "journal.jsonl")[0] if row["kind"] == "start"]
    assert [(row["time_s"], row["pid"]) for row in starts] == [(0.0, os.getpid())]


@pytest.mark.parametrize(
    ("ends", "told", "raised"),
    [
        ("completed", "completed", None),
        ("stopped by the interlock: M1", "stopped by the interlock: M1", None),
        ("stopped by the operator", "stopped by the operator", None),
        ("failed: disk", "failed: disk", (frame.UserError, "^failed: disk$")),
        (DeviceStateError("unplugged"), "failed: unplugged", (frame.UserError, "^unplugged$")),
        (frame.UserError("no policy"), "failed: no policy", (frame.UserError, "^no policy$")),
        (RuntimeError("a bug"), "ended before its summary: see the log", (RuntimeError, "^a bug$")),
    ],
)
def test_how_a_run_ended_is_told_once_and_a_failure_ends_the_command(ends, told, raised, tmp_path, monkeypatch):
    heard = []
    monkeypatch.setattr(notify, "opened", opened := Mock(return_value=Tell(heard)))
    monkeypatch.setattr(control, "_recorded", Mock(side_effect=[ends]))
    config = DeployConfig(controller=registry.config("pi"), notify="mail lab")
    with nullcontext() if raised is None else pytest.raises(raised[0], match=raised[1]):
        control.deploy(config, tmp_path)
    assert heard == [("end", "", told), "closed"]
    opened.assert_called_once_with("mail lab", tmp_path, False)


def test_a_summary_that_the_disk_refuses_fails_the_run_and_says_how_it_ended(tmp_path, monkeypatch):
    write = files.write_json

    def full(path, *given, **words):
        if path.name == "summary.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, *given, **words)

    monkeypatch.setattr(control.charts, "save", lambda figure, folder, name: folder / name)
    monkeypatch.setattr(files, "write_json", full)
    scenario = Scenario((0.5,), (2.0,), (37.0,))
    config = DeployConfig(controller=registry.config("pi"), scenario=scenario, fsync=False)
    with pytest.raises(frame.UserError, match=f"^failed: completed; .*{os.strerror(errno.ENOSPC)}"):
        control.deploy(config, tmp_path)
    assert len((tmp_path / "recordings" / "M0.csv").read_text().splitlines()) == 4


def test_reactors_around_which_no_loop_can_be_closed_are_stopped(tmp_path, monkeypatch):
    """An overflow pump may run already."""
    reactors = Mock()
    family = SimpleNamespace(open=lambda opening: nullcontext(reactors))
    setup = replace(assemble.unpack(DeployConfig(controller=registry.config("pi")), tmp_path), family=family)
    monkeypatch.setattr(assemble, "close_loop", Mock(side_effect=DeviceStateError("state.json: damaged")))
    record = SimpleNamespace(journal=None, folder=tmp_path)
    with pytest.raises(DeviceStateError, match="damaged"), assemble.opened(setup, record):
        pass
    reactors.stop.assert_called_once_with()
    with pytest.raises(frame.UserError, match="^preflight_only=true: "):
        assemble.run_preflight(replace(setup, family=family_of(SimulatedConfig())), tmp_path)


def test_a_timetable_names_the_last_folder_that_was_given(monkeypatch, capsys):
    monkeypatch.setattr(timetable, "timetable", lambda config, place, now: f"{config.controller.kind} in {place}")
    config = DeployConfig(controller=registry.config("pi"), dry_run=True)
    monkeypatch.setattr(frame.EntryPoint, "config", lambda self, words: config)
    words = ["dry_run=true", "controller=pi"]
    command._answer([*words, "hydra.run.dir=a", "hydra.run.dir=b c"])
    command._answer(words)
    assert capsys.readouterr().out == "pi in b c\npi in a new folder of runs/deploy/\n"


def test_the_perfect_plant_is_the_training_model():
    """Closed loop on the `nominal` plant against x <- f(u) x, step for step."""
    reactors = SimulatedReactors(Plant(PlantConfig(start_od=0.9), 1, np.random.default_rng(0)), SimulatedConfig())
    learned = LearnedController(inverse_policy())
    loop = ClosedLoop(reactors, learned, Interlock(1), Scenario((0.5,), (40.0,), (37.0,)))
    od = 0.9
    for step in loop.run():
        assert step.od[0] == pytest.approx(od, rel=1e-12)
        od *= step_factors(EnvConfig(), step.rate)[0]
    assert loop.done.all()


def test_a_rate_holds_for_the_whole_of_a_control_period():
    """0.01 mL/s over 2 min are 1.2 mL, of a pump of 0.8 mL/s, in one of two vials."""
    plant = Plant(PlantConfig(pump=PumpConfig(dosing="pulse", gain_ml_s=0.8)), 2, np.random.default_rng(0))
    reactors = SimulatedReactors(plant, SimulatedConfig(reactors=("A", "B"), pump_ml_s=0.8), control_min=2.0)
    assert reactors.measure().time_s.tolist() == [0.0, 0.0]
    receipt = reactors.actuate(Command(np.array([True, False]), np.full(2, 0.01), np.full(2, np.nan)))
    assert receipt.volume_ml == pytest.approx([1.2, 0.0])
    assert reactors.measure().time_s.tolist() == [120.0, 120.0]
    assert plant.feed.delivered_ml == pytest.approx([1.2, 0.0])
    reactors.measure()  # without a command there is no dose
    assert plant.feed.delivered_ml == pytest.approx([1.2, 0.0])


def test_what_is_switched_off_is_off_in_its_own_vial_alone():
    plant = Plant(PlantConfig(pump=PumpConfig(dosing="pulse")), 2, np.random.default_rng(0))
    reactors = SimulatedReactors(plant, SimulatedConfig(reactors=("A", "B")))
    plant.reset(0.5, temperature=37.0)
    reactors.measure()
    reactors.actuate(Command(np.array([True, True]), np.full(2, 0.01), np.array([38.0, 36.0])))
    second = np.array([False, True])
    assert reactors.pumps_off(second) == []
    reactors.measure()
    assert plant.feed.delivered_ml == pytest.approx([0.6, 0.0])
    assert plant.thermal.target.tolist() == [38.0, 36.0]
    assert reactors.heat_off(second) == []
    reactors.measure()
    assert plant.thermal.target.tolist() == [38.0, 0.0]
    assert reactors.heat_off(np.array([True, False])) == []
    reactors.actuate(Command(np.array([True, True]), np.zeros(2), np.array([np.nan, 35.0])))  # as the loop goes on
    reactors.measure()
    assert plant.thermal.target.tolist() == [0.0, 35.0]
    [said] = reactors.regulate(second, np.full(2, 0.5))
    assert said.startswith("B: ")


def test_a_training_that_ends_while_the_latest_policy_is_taken_swaps_nothing(tmp_path, monkeypatch):
    """What a resume flies is what the run began with, although `latest` is another file by the time it is copied."""
    monkeypatch.chdir(tmp_path)
    for name in ("old", "new", "run"):
        Path("runs/train", name).mkdir(parents=True)
    older = inverse_policy()
    newer = replace(older, biases=(older.biases[0] + 1.0, *older.biases[1:]))
    policy.save(Path("runs/train/old/policy.npz"), older)
    read = policy.load

    def read_while_a_training_ends(path: Path) -> policy.Policy:
        found = read(path)
        policy.save(Path("runs/train/new/policy.npz"), newer)
        return found

    monkeypatch.setattr(policy, "load", read_while_a_training_ends)
    wanted = policies.WantedPolicy("latest", Bench(), EnvConfig(), {}, (), at_stake=False, forced=False)
    flown, _ = policies.run_policy(wanted, tmp_path, resumed=False)
    monkeypatch.setattr(policy, "load", read)
    assert policies.find_policy("latest") == Path("runs/train/new/policy.npz")
    resumed, _ = policies.run_policy(wanted, tmp_path, resumed=True)
    for own in (flown, resumed):
        np.testing.assert_array_equal(own.biases[0], older.biases[0])


@pytest.mark.slow
def test_a_run_ends_although_an_absent_reactor_cannot_be_verified_off_and_says_so():
    lab = DriverLab(("M0", "M1"), od=0.5)
    lab.reactors.begin()
    schedule = Scenario((0.5,), (60.0,), (37.0,))
    interlock = Interlock(2, SafetyConfig(silent=20.0))
    loop = ClosedLoop(lab.reactors, LearnedController(inverse_policy()), interlock, schedule)
    steps = loop.run()
    while lab.clock.now() < 300.0:
        next(steps)
    lab.fault("unplugged", 1.0, "M1")
    while lab.device.supervisor.alive:
        next(steps)
    lab.fault("restart")
    reasons = [step.reasons[1] or "" for step in steps]  # comes to its end
    assert lab.clock.now() < 5000.0
    assert loop.done.tolist() == [True, False]
    assert loop.gone.tolist() == [False, True]
    assert any("absent" in reason for reason in reasons)
    assert any("silent" in reason for reason in reasons)
    with pytest.raises(PumpsNotOff) as error:
        lab.reactors.stop()
    assert error.value.fields == {"failed": f"M1: {Absent(reactor='M1', present='M0')}"}
    assert lab.motors_off()
    assert lab.device.supervisor.exits == 1
