"""Every controller of the list through `deploy`, on simulated vials and on the emulated device in virtual time."""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dqn import policy
from envs.bench import Bench
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control import run
from experiments.control.config import DeployConfig
from experiments.laws import registry
from experiments.laws.registry import KINDS
from experiments.loop.loop import ClosedLoop, Step
from hardware.chibio.config import EmulatorConfig
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice
from hardware.emulator.family import EmulatorFamily
from hardware.emulator.transport import EmulatorTransport
from hardware.errors import LinkError
from hardware.family import Opening, family
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.family import PioreactorFamily
from hardware.storage.journal import Journal, read_journal
from tests.experiments.test_deploy import inverse_policy

pytestmark = pytest.mark.numeric

ROOT = Path(__file__).parents[2]
NAMES = ("M0", "M1")
WHY = {  # what each controller says of a decision: name -> number of values per reactor
    "dqn": {"q_best": 1, "q_lead": 1},
    "mpc": {"planned_rate": 5, "predicted_od": 5},  # over its horizon of five minutes
}


def config(kind: str, backend: str, folder: Path) -> DeployConfig:
    """Three minutes at 0.4 from a culture above it."""
    policy.save(folder / "given.npz", inverse_policy())
    schema = DeployConfig(backend=family(backend).config(), controller=registry.config(kind))
    reactors = replace(schema.backend, reactors=NAMES)
    plant = replace(schema.plant, start_od=0.5)
    scenario = Scenario((0.4,), (3.0,), (37.0,))
    return replace(
        schema, backend=reactors, plant=plant, scenario=scenario, policy=str(folder / "given.npz"), fsync=False
    )


@pytest.fixture
def emulated(monkeypatch: pytest.MonkeyPatch) -> list[ChiBioDevice]:
    """`backend=emulator` finds its device in this process; returns those it was given."""
    devices = []

    @contextmanager
    def linked(
        _: EmulatorFamily, backend: EmulatorConfig, bench: Bench
    ) -> Iterator[tuple[EmulatorTransport, VirtualClock]]:
        clock = VirtualClock()
        rng = np.random.default_rng(1)
        devices.append(ChiBioDevice(backend.reactors, clock, rng, od=0.5, temperature=37.0, blanked=True))
        yield EmulatorTransport(devices[-1]), clock

    monkeypatch.setattr(EmulatorFamily, "linked", linked)
    return devices


def check(folder: Path, kind: str) -> None:
    """Everything that a run of three minutes leaves, against what it was asked."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert list(summary["reactors"]) == list(NAMES)
    assert [w["setpoint"] for w in summary["windows"]] == [0.4, 0.4]
    assert all(np.isfinite(w["ise"]) for w in summary["windows"])
    for suffix in ("svg", "png"):
        assert (folder / f"figures/closed_loop.{suffix}").stat().st_size > 5000
    assert Path(summary["figure"]).name == "closed_loop.png"
    fed = 0.0
    for name in NAMES:
        with open(folder / f"recordings/{name}.csv", newline="") as f:
            rows = list(csv.DictReader(f))
        assert len(rows) >= 4
        assert summary["reactors"][name]["rows"] == len(rows)
        assert all(0.0 <= float(row["pump_rate_ml_s"]) <= 0.02 for row in rows)
        fed += sum(float(row["volume_ml"]) for row in rows if row["volume_ml"] not in ("", "nan"))
    assert summary["volume_ml"] == pytest.approx(fed, abs=1e-3)
    decisions = [row for row in read_journal(folder / "journal.jsonl")[0] if row["kind"] == "decision"]
    assert len(decisions) == sum(reactor["rows"] for reactor in summary["reactors"].values())
    for decision in decisions:
        found = {key: len(value) if isinstance(value, list) else 1 for key, value in decision["why"].items()}
        assert WHY.get(kind, found) == found
    for name in NAMES:
        tags = set(EventAccumulator(str(folder / "reactors" / name)).Reload().Tags()["tensors"])
        assert {"culture/od", "culture/setpoint", "culture/setpoint_low", "pump/rate_ml_s"} <= tags
        numbers = {tag for tag, values in WHY.get(kind, {}).items() if values == 1}
        assert {f"controller/{tag}" for tag in numbers} <= tags
    if kind == "mpc":  # a plan is no curve
        assert not {tag for tag in tags if "plan" in tag or "predicted" in tag}


@pytest.mark.parametrize("kind", KINDS)
def test_every_controller_on_simulated_vials(kind: str, tmp_path: Path) -> None:
    run.deploy(config(kind, "sim", tmp_path), tmp_path)
    check(tmp_path, kind)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "oracle"])
def test_every_controller_on_the_emulated_device(kind: str, tmp_path: Path, emulated: list[ChiBioDevice]) -> None:
    run.deploy(config(kind, "emulator", tmp_path), tmp_path)
    check(tmp_path, kind)
    assert not any(on for name in NAMES for on in emulated[0].truth(name)["motors"].values())


def test_the_oracle_needs_a_plant_that_it_can_know(tmp_path: Path, emulated: list[ChiBioDevice]) -> None:
    with pytest.raises(frame.UserError, match="^controller=oracle needs .* use it with backend=sim"):
        run.deploy(config("oracle", "emulator", tmp_path), tmp_path)
    assert not emulated  # before a device is asked for anything


@pytest.mark.slow
def test_the_paper_s_rival_on_an_emulated_device_behind_a_real_socket(tmp_path: Path) -> None:
    words: list[Any] = ["controller=mpc", "backend=emulator", "backend.reactors=[M0,M1]", "backend.speed=60"]
    words += ["scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[3]", f"hydra.run.dir={tmp_path}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "experiments.deploy", *words]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout
    assert done.stderr == ""
    check(tmp_path, "mpc")


@pytest.mark.parametrize(("kind", "first"), [(EmulatorFamily, "linked"), (PioreactorFamily, "units")])
@pytest.mark.parametrize(
    ("error", "resumed", "said"),
    [(KeyboardInterrupt, False, True), (LinkError, True, True), (LinkError, False, False)],
)
def test_an_end_before_the_pumps_were_looked_at_says_so(
    kind: Any, first: str, error: Any, resumed: bool, said: bool, tmp_path: Path, monkeypatch, caplog
):
    """At the first request, by which the device is found: what an earlier life left on may run on."""
    monkeypatch.setattr(kind, first, Mock(side_effect=error))
    backend = EmulatorConfig() if kind is EmulatorFamily else PioreactorConfig()
    with closing(Journal(tmp_path / "journal.jsonl", fsync=False)) as journal:
        journal.rows = [{"wall": 0.0}] * resumed
        opening = Opening(backend, Bench(), PlantConfig(), journal, tmp_path, resumed=resumed)
        with pytest.raises(error), kind().open(opening):
            pass
    assert ("pumps not verified off" in caplog.text) == said


def virtual(resume: str | None = None) -> DeployConfig:
    """Two unlike schedules' worth of work in a few minutes, on one vial that begins near its setpoint."""
    backend = EmulatorConfig(reactors=("M1",), speed=0.0, od=0.7)
    scenario = Scenario((0.65, 0.5), (7.0, 4.0), (37.0, 37.0))
    return DeployConfig(backend, scenario=scenario, controller=registry.config("pi"), fsync=False, resume=resume)


def made(at: Path) -> Path:
    at.mkdir()
    return at


def test_a_run_in_virtual_time_completes_and_repeats_to_the_byte(tmp_path: Path) -> None:
    runs = [made(tmp_path / name) for name in "ab"]
    for folder in runs:
        run.deploy(virtual(), folder)
    assert json.loads((runs[0] / "summary.json").read_text())["outcome"] == "completed"
    first, second = ((folder / "recordings" / "M1.csv").read_text().splitlines() for folder in runs)
    assert [line for line in first if line[:1] != "#"] == [line for line in second if line[:1] != "#"]


def test_time_stands_still_between_two_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, steps = made(tmp_path / "run"), []
    original = ClosedLoop.step

    def killed(loop: ClosedLoop) -> Step:
        if len(steps) == 5:
            raise RuntimeError("the program dies")
        steps.append(original(loop))
        return steps[-1]

    with monkeypatch.context() as patched:
        patched.setattr(ClosedLoop, "step", killed)
        with pytest.raises(Exception, match="the program dies"):
            run.deploy(virtual(), folder)
    before = max(float(row.get("time_s") or 0.0) for row in read_journal(folder / "journal.jsonl")[0])
    run.deploy(virtual(resume=str(folder)), folder)
    rows = read_journal(folder / "journal.jsonl")[0]
    lives = [n for n, row in enumerate(rows) if row["kind"] == "start"]
    assert len(lives) == 2
    assert before <= float(rows[lives[1]]["time_s"]) < before + 60.0
