"""Density and composition on the emulated device: days in virtual time, kills, the serial line."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from envs.scenario import Scenario
from experiments.coculture import run as coculture_run
from experiments.coculture.base import SHARE
from experiments.coculture.signal import Share
from experiments.control.run import BenchMarks
from experiments.laws import registry
from experiments.record.recovery import COLUMNS as USUAL
from hardware.emulator.device import DeviceOptions, plant_preset
from hardware.emulator.vial import VialConfig
from hardware.storage.journal import read_journal
from hardware.storage.marks import Mark, add_mark
from tests.campaigns.audit import audit_doses, audit_rows
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.experiments.composition_keeper import Reckoning
from tests.experiments.test_composition_deploy import column, rows
from tests.hardware.test_serial_transport import Cable, wired
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]
STEPS = build(Scenario(), presets.load("scenario/ratio_steps"), "scenario")
SHORT = replace(STEPS, minutes=(20.0, 60.0, 60.0, 20.0))
PLANT = replace(plant_preset("coculture"), pump=plant_preset("healthy").pump)  # pumps as `SOUND` has them
TWO = DeviceOptions(vial=VialConfig(outlier_rate=0.0), plant=PLANT)


def rehearsal(
    folder: Path, scenario: Scenario, names: tuple[str, ...] = ("M0",), kind: str = "proportional"
) -> Rehearsal:
    config = replace(rehearsed(names, scenario), composition=registry.config(kind, SHARE))
    return Rehearsal(folder, config, TWO, seed=1)


def share(scenarios: Sequence[Scenario]) -> Share:
    keeper = Reckoning()
    return Share(keeper, keeper, scenarios)


def error(run: Rehearsal, n: int = 0) -> Iterator[float]:
    """Distance of the true share from what is asked for, sample by sample."""
    for step in run.run():
        asked = float(step.columns["ratio_setpoint"][n])
        if np.isfinite(asked):
            yield abs(float(run.device.vials[run.names[n]].plant.culture.share[0]) - asked)


@pytest.mark.campaign
def test_a_day_and_three_hours_of_steps(tmp_path: Path) -> None:
    run = rehearsal(tmp_path, STEPS)
    run.begin()
    errors = list(error(run))
    run.reactors.stop()
    assert len(errors) == pytest.approx(1560, abs=20)
    assert np.mean(errors) < 0.1  # 0.081 to 0.086; the actuator's rate is the limit
    for end in (360, 960, 1560):
        assert np.mean(errors[end - 120 : end - 10]) < 0.03
    od = column(tmp_path, "od")
    assert od[30:].min() > 0.44
    assert od[30:].max() < 0.56
    missed, lost, twice = audit_rows(run)
    assert missed == lost == twice == 0
    run.close()


@pytest.mark.slow
def test_the_program_is_killed_twice_and_loses_nothing(tmp_path: Path) -> None:
    """Each time the device goes on by itself for a while, at the temperature that it was left at."""
    run = rehearsal(tmp_path, SHORT, ("M0", "M1"))
    kept: list[dict[str, Any]] = []
    for minute, away_s in ((41.3, 400.0), (91.02, 900.0)):
        run.begin()
        if kept:
            now = json.loads(json.dumps(run.loop.state()))["composition"]
            assert now["controller"]["law"] == kept[-1]["composition"]["controller"]["law"]
            assert now["nearer_min"] == kept[-1]["composition"]["nearer_min"]
        run.clock.at(60.0 * minute, run.kill)
        run.killed()
        kept.append(json.loads((tmp_path / "state.json").read_text()))
        run.wait(away_s)
    run.begin()
    list(run.run())
    run.reactors.stop()
    for n, name in enumerate(("M0", "M1")):
        share = float(run.device.vials[name].plant.culture.share[0])
        estimate = column(tmp_path, "ratio", name)
        low, high = column(tmp_path, "ratio_low", name), column(tmp_path, "ratio_high", name)
        assert low[-1] < share < high[-1]
        assert np.isfinite(estimate[1:]).all()
        setpoint = column(tmp_path, "ratio_setpoint", name)
        elapsed = column(tmp_path, "elapsed_min", name)
        for start, end, asked in ((20.0, 80.0, 0.3), (80.0, 140.0, 0.7), (140.0, 160.0, 0.3)):
            inside = (elapsed >= start) & (elapsed < end - 1.0) & np.isfinite(setpoint)
            assert set(setpoint[inside]) == {asked}
        fed = float(run.truth(name)["feed_ml"])
        assert float(run.loop.interlock.budget.fed_ml[n]) == pytest.approx(fed, rel=0.05)
        journal, _ = read_journal(tmp_path / "journal.jsonl")
        assert audit_doses(journal, run.device.vials[name].doses, name, run.spans[0][0])[0] == 0
    missed, lost, twice = audit_rows(run)
    assert missed == lost == twice == 0
    run.close()


def test_what_the_device_dosed_while_the_program_was_dead_is_told(tmp_path, monkeypatch):
    """A pump left on repeats its dose; the estimate's dilution is the interlock's account of it."""
    monkeypatch.setattr(coculture_run, "_share", lambda config, plant, folder, scenarios: share(scenarios))
    run = rehearsal(tmp_path, SHORT)
    run.begin()
    run.kill_at("/SetOutputOn/Pump1/1/M0", lambda: run.clock.now() > 1800.0, 0.3)
    run.killed()
    told = json.loads((tmp_path / "state.json").read_text())["composition"]["controller"]["law"]["told_ml"][0]
    run.wait(400.0)
    run.begin()
    list(run.run(run.clock.now() + 240.0))
    (held,) = (each for each in run.loop.signals if isinstance(each, Share))
    keeper = held.law
    assert isinstance(keeper, Reckoning)
    assert keeper.told_ml[0] == pytest.approx(float(run.loop.interlock.budget.fed_ml[0]), abs=1e-6)
    assert keeper.told_ml[0] > told + 3.0  # six repetitions of half a millilitre and more
    run.close()


def test_a_sample_that_was_not_decided_on_keeps_its_light(tmp_path: Path) -> None:
    run = rehearsal(tmp_path, SHORT)
    run.begin()
    list(run.run(1200.0))
    samples = [r for r in read_journal(tmp_path / "journal.jsonl")[0] if r["kind"] == "sample"]
    run.close()
    cut = (tmp_path / "journal.jsonl").read_text().splitlines(keepends=True)
    last = max(i for i, line in enumerate(cut) if '"kind":"sample"' in line[:120])
    (tmp_path / "journal.jsonl").write_text("".join(cut[: last + 1]))
    recording = (tmp_path / "recordings" / "M0.csv").read_text().splitlines(keepends=True)
    (tmp_path / "recordings" / "M0.csv").write_text("".join(recording[:-1]))
    run.begin()
    run.close()
    row = rows(tmp_path)[-1]
    assert float(row["fluorescence"]) == samples[-1]["fluorescence"] > 100.0
    assert row["interlock"] == "the program ended before it decided"
    assert row["ratio"] == ""


@pytest.fixture
def two_species(tmp_path: Path) -> Iterator[Cable]:
    with wired(tmp_path, "--plant", "coculture") as (line, _):
        yield line


@pytest.mark.slow
def test_over_the_serial_line(two_species: Cable, tmp_path: Path) -> None:
    line = two_species
    folder = tmp_path / "run"
    words = ["scenario=ratio_hold", "composition=proportional", "backend=chibio", "backend/transport=serial"]
    words += [f"backend.transport.port={line.pc}", "backend.speed=60", f"hydra.run.dir={folder}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "experiments.deploy", *words]
    client = subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=tmp_path
    )
    deadline = time.monotonic() + PATIENCE_S
    path = folder / "recordings" / "M0.csv"
    while not (path.exists() and len(rows(folder)) >= 5):
        assert client.poll() is None, client.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    client.send_signal(signal.SIGINT)
    said = client.communicate(timeout=PATIENCE_S)[0]
    assert client.returncode == 0, said
    assert tuple(rows(folder)[0])[: len(USUAL)] == USUAL
    assert (column(folder, "fluorescence") > 100.0).all()
    assert np.isfinite(column(folder, "ratio")[1:]).all()


@pytest.mark.slow
def test_a_share_that_was_counted_is_taken_over_once_also_over_a_kill(tmp_path: Path) -> None:
    """Marked at minute 60 for minute 40; the program is killed before its state is saved, and resumed."""
    run = rehearsal(tmp_path, SHORT, ("M0", "M1"))
    run.begin()
    for step in run.run():
        if float(step.minute[0]) > 60.0:
            break
    held = next(each for each in run.loop.signals if isinstance(each, Share))
    before = held.estimator.estimate()
    for text, share_, minute in (("taken", None, 20.0), ("counted", 0.6, 40.0)):
        add_mark(tmp_path, Mark(minute, "M1", text, None, share_, share_ and 0.02))
    marks = BenchMarks(run.record)
    marks.take(run.loop)
    marks.take(run.loop)
    after = held.estimator.estimate()
    assert after.logit[0] == pytest.approx(before.logit[0], abs=1e-12)
    assert 0.0 < after.sd[1] < 0.5 * before.sd[1]
    (row,) = [row for row in read_journal(tmp_path / "journal.jsonl")[0] if row["kind"] == "share"]
    assert (row["reactor"], row["share"], row["sd"], row["minute"]) == ("M1", 0.6, 0.02, 40.0)
    run.close()  # as a kill leaves it: the state is of before the mark
    run.wait(30.0)
    run.begin()
    again = next(each for each in run.loop.signals if isinstance(each, Share))
    BenchMarks(run.record).take(run.loop)
    assert len([1 for row in read_journal(tmp_path / "journal.jsonl")[0] if row["kind"] == "share"]) == 1
    for step in run.run():
        if float(step.minute[0]) > 62.0:
            break
    assert np.isfinite(again.estimator.estimate().logit).all()
    run.close()
