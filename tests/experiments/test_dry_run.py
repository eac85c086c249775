"""`dry_run=true`: the timetable by hand, no device asked, nothing left behind."""

import math
import os
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control.config import DeployConfig
from experiments.control.timetable import expected, timetable
from experiments.deploy import deploy, main
from tests.experiments.test_deploy import ROOT
from tests.patience import PATIENCE_S

NOON = datetime(2026, 3, 2, 12, 0)
GROWTH, DILUTION, VOLUME_ML = 0.03, 0.06, 20.0


def step(setpoint: float, minutes: float, od: float, until: str | None = None) -> tuple[float, float, float]:
    e = expected(Scenario((setpoint,), (minutes,), (37.0,), until=(until,)), 0, od, GROWTH, DILUTION, VOLUME_ML)
    return e.minutes, e.ml, e.od


def test_what_a_step_takes_by_hand() -> None:
    up, down = math.log(2.0) / 0.03, math.log(2.0) / (0.06 - 0.03)  # 0.4 to 0.8 and back
    assert step(0.8, 60.0, 0.4) == pytest.approx((60.0, (60.0 - up) * 0.03 * 20.0, 0.8))
    assert step(0.4, 60.0, 0.8) == pytest.approx((60.0, (down * 0.06 + (60.0 - down) * 0.03) * 20.0, 0.4))
    assert step(0.8, 600.0, 0.4, "od >= 0.8") == pytest.approx((up, 0.0, 0.8))
    assert step(0.3, 600.0, 0.8, "od <= 0.4") == pytest.approx((down, down * 0.06 * 20.0, 0.4))
    assert step(0.8, 600.0, 0.8, "settled") == pytest.approx((10.0, 10.0 * 0.03 * 20.0, 0.8))
    assert step(0.5, 60.0, 0.5, "od >= 0.8")[0] == 60.0  # held at 0.5 it never gets there
    assert step(0.5, 60.0, 0.9, "od >= 0.8")[0] == 1.0  # it is there already


def told(*overrides: str) -> str:
    return timetable(main.config(["dry_run=true", *overrides]), "HERE", NOON)


def test_steps_clock_and_bottle_are_told() -> None:
    text = told("scenario=hold", "scenario.minutes=[1500]", "bench.bottle_ml=500", "backend.reactors=[M0,M1]")
    assert text.count("Mon 02 12:00 Tue 03 13:00    1500     1500") == 2
    assert text.count("900 mL of medium expected") == 2  # 1500 min x 0.03 1/min x 20 mL
    assert text.count("bench.bottle_ml=500 does NOT last") == 2
    assert "controller dqn, policy shipped" in text
    budget = told("scenario=hold", "scenario.minutes=[100]", "bench.bottle_ml=500", "safety.ml_per_run=59")
    assert "safety.ml_per_run=59 does NOT last: the interlock stops feeding there" in budget  # 60 mL expected
    assert "safety.ml_per_run=61 lasts" in told("scenario=hold", "scenario.minutes=[100]", "safety.ml_per_run=61")
    assert "would record in HERE" in text
    assert "bench.bottle_ml=2000 lasts" in told("scenario=hold")
    both = told("scenario=hold", "scenario.minutes=[90]", "scenario.outputs=['pump3 2 mL/h, pump4 1.5 mL']")
    assert "at most 3.0 mL by Pump3, at most 1.5 mL by Pump4" in both
    fed = told("scenario=hold", "scenario.minutes=[60]", "scenario.outputs=['pump3 20 mL/h, pump4 20 mL']")
    assert "40 mL of medium expected, 40 mL if" in fed  # more than growth asks for, 36 mL
    longer = told("scenario=hold", "scenario.minutes=[1500]", "scenario.until=[settled]", "bench.bottle_ml=500")
    assert "may not last" in longer


def test_each_step_begins_where_the_one_before_it_is_expected_to_end() -> None:
    """0.4 to 0.8 takes 10 ln 2 / 0.3 = 23 min; the clock counts from noon, or from the end of a recovery."""
    words = "setpoints=[0.8,0.8,0.8]", "minutes=[600,90,45]", "until=['od >= 0.8',null,null]", "recovery_od=0.4"
    text = told("scenario=grow_hold_dilute", "plant.start_od=0.3", *(f"scenario.{word}" for word in words))
    assert [line.split()[3:7:3] for line in text.splitlines() if line.split()[1:2] == ["Mon"]] == [
        ["12:00", "12:23"], ["12:23", "13:53"], ["13:53", "14:38"],
    ]  # fmt: skip
    assert "the times below count from its end" in text


def test_each_reactor_is_reckoned_by_its_own_volume_and_the_bench_s_fastest_pump() -> None:
    """From 0.8 to 0.4 at full rate, u / V - mu, then mu V to hold it; an hour at most, or until OD 0.5."""
    down = "plant.start_od=0.8", "scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[60]"
    down += "scenario.recovery_od=0", "bench.volume_ml=16", "bench.max_rate=0.015", "backend.reactors=[M0,M1]"
    for until, level, lasts in (("null", 0.4, 60.0), ("'od <= 0.5'", 0.5, 0.0)):
        text = told(*down, "bench.volumes_ml.M1=12", f"scenario.until=[{until}]")
        steps = [line.split() for line in text.splitlines() if line.split()[1:2] == ["Mon"]]
        for words, volume_ml in zip(steps, (16.0, 12.0), strict=True):
            full = 60.0 * 0.015 / volume_ml
            falls = math.log(0.8 / level) / (full - 0.03)
            ml = volume_ml * (falls * full + max(lasts - falls, 0.0) * 0.03)
            assert float(words[7]) == pytest.approx(max(falls, lasts), abs=0.5)
            assert float(words[11]) == pytest.approx(ml, abs=0.05)


def test_what_the_run_would_refuse_is_refused() -> None:
    with pytest.raises(frame.UserError, match="nowhere"):
        told("policy=nowhere.npz")
    with pytest.raises(frame.UserError, match="drop dry_run"):
        timetable(DeployConfig(resume="RUN"), "HERE", NOON)


@pytest.mark.parametrize("swept", [False, True])
def test_what_has_no_timetable_is_refused_and_does_not_run(
    swept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job of a sweep comes here with its folder; it doses nothing."""
    monkeypatch.setattr(frame, "swept", lambda: swept)
    config = main.config(["dry_run=true", "controller=pi", "scenario.minutes=[2,2,2]"])
    with pytest.raises(frame.UserError, match="dry_run=true: a sweep has no timetable; drop --multirun"):
        deploy(config, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_no_device_is_asked_and_no_folder_left(tmp_path: Path) -> None:
    """The address answers nobody, so a run would fail."""
    command = [sys.executable, "-m", "experiments.deploy", "backend=chibio", "backend.url=http://127.0.0.1:9"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*command, "dry_run=true"], capture_output=True, text=True, env=environment, timeout=PATIENCE_S, cwd=tmp_path
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "pumps not weighed, taken as 1 mL/s: M0" in done.stdout
    assert list(tmp_path.iterdir()) == []
