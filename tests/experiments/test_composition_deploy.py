"""Density and composition deployed, in a simulation and on the emulated device: recorded, drawn, killed, refused."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import yaml

from conf import presets
from conf.schema import build
from envs.scenario import Scenario
from experiments import report
from experiments.cli import frame
from experiments.coculture import run as coculture_run
from experiments.coculture.base import SHARE
from experiments.coculture.config import read_pair
from experiments.coculture.policies import SHIPPED_COMPOSITION
from experiments.coculture.signal import COLUMNS, Share
from experiments.control import assemble, policies, run
from experiments.control.run import BenchMarks
from experiments.deploy import main
from experiments.laws import registry
from experiments.loop.metrics import mean_errors
from experiments.record.recovery import COLUMNS as USUAL
from experiments.recordings.reader import read_recording
from hardware.emulator.device import DeviceOptions, plant_preset
from hardware.emulator.vial import VialConfig
from hardware.storage.journal import read_journal
from hardware.storage.marks import Mark, add_mark
from tests.campaigns.audit import audit_doses, audit_rows
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.experiments.composition_keeper import Reckoning
from tests.hardware.test_serial_transport import Cable, wired
from tests.patience import PATIENCE_S

F = TypeVar("F", bound=Callable[..., Any])
WORDS = ("plant=coculture", "scenario=ratio_steps", "composition=proportional", "fsync=false")
STEPS, TWO, OTHER = "scenario=ratio_steps", "plant=coculture scenario=ratio_steps", "use composition=midpoint"
TRAINED = "composition=dqn_preview: its policy was trained for shares 0.1 to 0.9, but the scenario has"
FAR = "+each.M1.ratios=[null,0.95,0.5,0.4]"
PHASES = ("scenario.minutes=[20,150,180,30]", "backend.reactors=[M0,M1]", "+each.M1.ratios=[0.6,null,0.4,null]")


def shared(test: F) -> F:
    """One of the tests of the run that is made once for all of them."""
    return pytest.mark.slow(pytest.mark.xdist_group("composition")(test))


def deploy(folder: Path, *words: str) -> Path:
    folder.mkdir()
    config = main.config(words)
    frame.save_config(config, folder)
    run.deploy(config, folder)
    return folder


@pytest.fixture(scope="module")
def deployed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return deploy(tmp_path_factory.mktemp("composition") / "run", *WORDS, *PHASES)


def rows(folder: Path, name: str = "M0") -> list[dict[str, str]]:
    with open(folder / "recordings" / f"{name}.csv", newline="") as f:
        return list(csv.DictReader(f))


def column(folder: Path, key: str, name: str = "M0") -> np.ndarray:
    return np.array([float(row[key] or "nan") for row in rows(folder, name)])


@shared
def test_the_recording_has_its_columns_behind_the_usual_ones(deployed: Path) -> None:
    assert tuple(rows(deployed)[0]) == (*USUAL, *COLUMNS, "true_ratio")
    for name, asked in (("M0", (None, 0.3, 0.7, 0.3)), ("M1", (0.6, None, 0.4, None))):
        phase, setpoint = column(deployed, "phase", name), column(deployed, "ratio_setpoint", name)
        for k, share in enumerate(asked):
            found = set(setpoint[phase == k][:-1])
            assert found == {share} if share else np.isnan(list(found)).all()
        target = column(deployed, "temperature_target_degc", name)
        assert set(target[np.isnan(setpoint)]) == {33.2}
        assert target.min() >= 29.0
        assert target.max() <= 36.0
        np.testing.assert_allclose(column(deployed, "fluorescence", name).mean(), 1600.0, atol=500.0)
        low, ratio, high = (column(deployed, key, name) for key in ("ratio_low", "ratio", "ratio_high"))
        assert (low < ratio).all()
        assert (ratio < high).all()
    assert read_recording(deployed / "recordings" / "M0.csv").od.size == len(rows(deployed))


@shared
def test_the_summary_has_the_errors_of_every_window(deployed: Path) -> None:
    windows = json.loads((deployed / "summary.json").read_text())["windows"]
    assert [w["ratio_setpoint"] for w in windows] == [None, 0.3, 0.7, 0.3, 0.6, None, 0.4, None]
    minute, ratio, true = (column(deployed, key) for key in ("elapsed_min", "ratio", "true_ratio"))
    od = column(deployed, "od")
    inside = (minute >= 170.0) & (minute < 350.0)
    late = inside & (minute >= 230.0)
    assert inside.sum() == 180
    third = windows[2]
    assert third["ratio_abs_error_mean"] == pytest.approx(np.abs(ratio[inside] - 0.7).mean())
    assert third["ratio_abs_error_last2h"] == pytest.approx(np.abs(ratio[late] - 0.7).mean())
    assert third["true_ratio_abs_error_mean"] == pytest.approx(np.abs(true[inside] - 0.7).mean())
    assert third["od_abs_error_mean"] == pytest.approx(np.abs(od[inside] - 0.5).mean())
    ends = (minute >= 170.0) & (minute <= 350.0)
    assert third["ise"] == pytest.approx(np.trapezoid((od[ends] - 0.5) ** 2, minute[ends]))
    assert windows[0]["ratio_abs_error_mean"] is windows[5]["ratio_abs_error_last2h"] is None


@shared
def test_figure_curves_and_page_show_it(deployed: Path, tmp_path: Path) -> None:
    picture = (deployed / "figures" / "composition.svg").read_text()
    for word in ("share of P. putida", "truth", "thermostat", "fluorescence,", "M1, estimate"):
        assert word in picture
    (events,) = (deployed / "reactors" / "M0").glob("events*")
    written = events.read_bytes()
    for tag in ("share/estimate", "share/setpoint", "share/fluorescence", "culture/temperature_target_degc",
                "share/true", "controller/bias_e"):  # fmt: skip
        assert tag.encode() in written
    page = report.write(deployed).read_text()
    assert "ratio_abs_error_last2h" in page
    assert ">composition<" in page
    assert "the model has one species" in page


def test_without_a_composition_nothing_of_it_is_left(tmp_path: Path) -> None:
    folder = deploy(tmp_path / "run", "plant=coculture", "scenario=regulation", "fsync=false")
    assert tuple(rows(folder)[0]) == (*USUAL, "fluorescence")  # the light of its vials
    summary, state = ((folder / f"{name}.json").read_text() for name in ("summary", "state"))
    assert "ratio" not in summary
    assert "composition" not in state
    assert not (folder / "figures" / "composition.svg").exists()


@pytest.mark.slow
def test_a_sine_is_followed_by_the_minute_and_has_no_one_setpoint(tmp_path: Path) -> None:
    words = ("scenario=ratio_sine", "scenario.minutes=[30,10]", "composition=pi", "fsync=false")
    folder = deploy(tmp_path / "run", "plant=coculture", *words)
    minute, asked = column(folder, "elapsed_min"), column(folder, "ratio_setpoint")
    np.testing.assert_allclose(asked, 0.5 - 0.4 * np.sin(2.0 * np.pi * minute / 1200.0), atol=1e-12)
    window = json.loads((folder / "summary.json").read_text())["windows"][0]
    inside = minute < 30.0
    error = np.abs(column(folder, "ratio") - asked)[inside].mean()
    assert window["ratio_setpoint"] is None
    assert window["ratio_abs_error_mean"] == pytest.approx(error)


def test_the_error_of_a_share_by_hand() -> None:
    minute = np.array([[0.0, 60.0, 121.0, 180.0, 240.0], [0.0, np.nan, 10.0, 20.0, 240.0]])
    share = np.array([[0.5, 0.4, 0.3, np.nan, 0.9], [np.nan] * 4 + [0.2]])
    setpoint = np.full((2, 5), 0.2)
    whole, late = mean_errors(minute, share, setpoint, 0.0, 240.0)
    assert whole[0] == pytest.approx(0.2)  # of 0.3, 0.2 and 0.1: the one at the end is of the next window
    assert late[0] == pytest.approx(0.1)
    assert np.isnan(whole[1])
    assert np.isnan(late[1])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("plant=coculture composition=pi", "no scenario has setpoints of the share; add scenario=ratio_steps"),
        (f"{STEPS} composition=pi plant=bench", "one species; use plant=coculture"),
        (f"{STEPS} composition=pi backend=emulator backend.plant=bench", "one species; use backend.plant=coculture"),
        (f"{TWO} composition=dqn composition_policy=nowhere", "policy nowhere: no such file"),
        (f"{TWO} composition=dqn composition_policy={policies.SHIPPED}", r"'growth_share'\]: allowed .*'logit_share'"),
        (f"{TWO} composition=optimum backend.reactors=[M0,M1] +each.M1.ratios=[0.6,0.5,0.4,0.3]", "programs differ"),
        (f"{TWO} composition=dqn_preview scenario.ratios=[null,0.95,0.5,0.03]", f"{TRAINED} 0.03, 0.95; {OTHER}"),
        (f"{TWO} composition=dqn_preview backend.reactors=[M0,M1] {FAR}", f"{TRAINED} 0.95; "),
        (f"{TWO} composition=dqn_preview pair=ecoli_psyringae", "growth differs by up to 0.5. 1/h: .* train a policy"),
        (f"{TWO} pair=yeasts", "pair = yeasts: allowed ecoli_pputida, ecoli_psyringae, a pair.yaml, or"),
        (f"{TWO} composition=pi safety.composition_high=31", "29 to 31 degC: allowed a range that includes 33.20 degC"),
        (f"{TWO} composition=pi +each.M0.ratios=[0.5]", "each.M0: scenario.ratios"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_remedy(words: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(frame.UserError, match=said) as caught:
        deploy(tmp_path / "run", *words.split())
    assert "\n" not in str(caught.value)


def test_a_learned_controller_without_a_policy_that_ships_says_what_to_give(tmp_path, monkeypatch):
    monkeypatch.setitem(SHIPPED_COMPOSITION, "dqn", tmp_path / "none.npz")
    with pytest.raises(frame.UserError, match="composition=dqn: this version ships no policy for it; give compos"):
        deploy(tmp_path / "run", *WORDS[:2], "composition=dqn")


def test_a_share_beyond_training_runs_where_it_is_forced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = (*WORDS[:2], "composition=dqn_preview", "scenario.ratios=[null,0.95,0.5,0.5]", "scenario.minutes=[1,2,1,1]")
    deploy(tmp_path / "run", *words, "force_policy=true")
    assert "trained for shares 0.1 to 0.9, but the scenario has 0.95; " in caplog.text


def test_the_light_of_a_culture_whose_share_nobody_holds_is_recorded(tmp_path: Path) -> None:
    """Of one species alone, for its curve; a plant of one species has no such column."""
    alone = ("plant=coculture", "plant.second.start_share=[1,1]", "controller=threshold", "scenario.setpoints=[0.5]")
    timed = ("scenario.minutes=[10]", "scenario.temperatures=[30]")
    folder = deploy(tmp_path / "lit", *alone, *timed)
    light = column(folder, "fluorescence")
    assert (light > 1000.0).all()
    assert "ratio" not in rows(folder)[0]
    folder = deploy(tmp_path / "dark", *alone, *timed, "plant.second.start_share=[0,0]")
    assert "fluorescence" not in rows(folder)[0]


@pytest.mark.slow
def test_another_pair_lives_in_the_vials_and_within_its_own_limits(tmp_path: Path) -> None:
    pair = tmp_path / "pair.yaml"
    pair.write_text(
        "first: {name: alpha, polynomial: [0.06, -1.1]}\nsecond: {name: beta, polynomial: [-0.01, 0.6, -8.1]}\n"
        "pigment: {}\ntemperatures: [26.0, 34.0]\n"
    )
    folder = deploy(
        tmp_path / "run", "scenario=ratio_steps", f"pair={pair}", "scenario.ratios=[null,0.3,0.7,0.3]",
        "scenario.minutes=[10,150,150,10]", "scenario.announce_min=0", "controller=inverse",
    )  # fmt: skip
    config = yaml.safe_load((folder / "config.yaml").read_text())
    pair.unlink()  # a run keeps its own, also for a resume
    again = coculture_run._with_pair(replace(main.config([f"pair={pair}"]), resume=str(folder)), folder)
    assert again.pair == str(folder / "pair.yaml")
    kept = read_pair(again.pair)
    assert config["plant"]["pair"]["second"]["name"] == kept.second.name == "beta"
    assert set(column(folder, "temperature_target_degc")[:8]) == {kept.resting_c}
    assert abs(kept.resting_c - 33.2) > 0.5
    assert "share of beta" in (folder / "figures" / "composition.svg").read_text()
    one = main.config(["scenario=ratio_steps", f"pair={folder}", "safety.composition_low=27"])
    one_side = assemble.completed(one)
    assert (one_side.safety.composition_low, one_side.safety.composition_high) == (27.0, 34.0)
    assert (config["safety"]["composition_low"], config["safety"]["composition_high"]) == (26.0, 34.0)
    target, truth = column(folder, "temperature_target_degc"), column(folder, "true_ratio")
    elapsed = column(folder, "elapsed_min")
    assert 26.0 <= np.nanmin(target) < 26.5  # what the thermometer has to show, by its estimated error
    start, low, high = (float(truth[elapsed == minute][0]) for minute in (9.0, 159.0, 309.0))
    assert low < start - 0.05
    assert high > low + 0.05


ROOT = Path(__file__).parents[2]
DAY = build(Scenario(), presets.load("scenario/ratio_steps"), "scenario")
SHORT = replace(DAY, minutes=(20.0, 60.0, 60.0, 20.0))
PLANT = replace(plant_preset("coculture"), pump=plant_preset("healthy").pump)  # pumps as `SOUND` has them
EMULATED = DeviceOptions(vial=VialConfig(outlier_rate=0.0), plant=PLANT)


def rehearsal(
    folder: Path, scenario: Scenario, names: tuple[str, ...] = ("M0",), kind: str = "proportional"
) -> Rehearsal:
    config = replace(rehearsed(names, scenario), composition=registry.config(kind, SHARE))
    return Rehearsal(folder, config, EMULATED, seed=1)


def share(scenarios: Sequence[Scenario]) -> Share:
    keeper = Reckoning()
    return Share(keeper, keeper, scenarios)


def distances(run: Rehearsal, n: int = 0) -> Iterator[float]:
    """Distance of the true share from what is asked for, sample by sample."""
    for step in run.run():
        asked = float(step.columns["ratio_setpoint"][n])
        if np.isfinite(asked):
            yield abs(float(run.device.vials[run.names[n]].plant.culture.share[0]) - asked)


@pytest.mark.campaign
def test_a_day_and_three_hours_of_steps(tmp_path: Path) -> None:
    run = rehearsal(tmp_path, DAY)
    run.begin()
    errors = list(distances(run))
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
    words += ["backend.transport.floor_s=10"]  # a busy machine may answer late
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
