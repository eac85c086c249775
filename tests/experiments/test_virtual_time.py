"""The Chi.Bio driver against an emulated device in virtual time: a run takes as long as its arithmetic."""

import json
from pathlib import Path

import pytest

from envs.scenario import Scenario
from experiments.control import run as control
from experiments.control.config import DeployConfig
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop, Step
from hardware.chibio.config import EmulatorConfig
from hardware.storage.journal import read_journal


def config(resume: str | None = None) -> DeployConfig:
    """Two unlike schedules' worth of work in a few minutes, on one vial that begins near its setpoint."""
    backend = EmulatorConfig(reactors=("M1",), speed=0.0, od=0.7)
    scenario = Scenario((0.65, 0.5), (7.0, 4.0), (37.0, 37.0))
    return DeployConfig(backend, scenario=scenario, controller=registry.config("pi"), fsync=False, resume=resume)


def folder(at: Path) -> Path:
    at.mkdir()
    return at


def test_a_run_in_virtual_time_completes_and_repeats_to_the_byte(tmp_path: Path) -> None:
    runs = [folder(tmp_path / name) for name in "ab"]
    for run in runs:
        control.deploy(config(), run)
    assert json.loads((runs[0] / "summary.json").read_text())["outcome"] == "completed"
    first, second = ((run / "recordings" / "M1.csv").read_text().splitlines() for run in runs)
    assert [line for line in first if line[:1] != "#"] == [line for line in second if line[:1] != "#"]


def test_time_stands_still_between_two_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, steps = folder(tmp_path / "run"), []
    original = ClosedLoop.step

    def killed(loop: ClosedLoop) -> Step:
        if len(steps) == 5:
            raise RuntimeError("the program dies")
        steps.append(original(loop))
        return steps[-1]

    with monkeypatch.context() as patched:
        patched.setattr(ClosedLoop, "step", killed)
        with pytest.raises(Exception, match="the program dies"):
            control.deploy(config(), run)
    before = max(float(row.get("time_s") or 0.0) for row in read_journal(run / "journal.jsonl")[0])
    control.deploy(config(resume=str(run)), run)
    rows = read_journal(run / "journal.jsonl")[0]
    lives = [n for n, row in enumerate(rows) if row["kind"] == "start"]
    assert len(lives) == 2
    assert before <= float(rows[lives[1]]["time_s"]) < before + 60.0
