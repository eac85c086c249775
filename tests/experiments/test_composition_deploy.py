"""Density and composition deployed as a user does: what is recorded, summed up, drawn, and refused."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import yaml

from experiments import report
from experiments.cli import frame
from experiments.coculture import run as coculture_run
from experiments.coculture.config import read_pair
from experiments.coculture.policies import SHIPPED_COMPOSITION
from experiments.coculture.signal import COLUMNS
from experiments.control import assemble, policies, run
from experiments.deploy import main
from experiments.loop.metrics import mean_errors
from experiments.record.recovery import COLUMNS as USUAL
from experiments.recordings.reader import read_recording

F = TypeVar("F", bound=Callable[..., Any])
WORDS = ("plant=coculture", "scenario=ratio_steps", "composition=proportional", "fsync=false")
STEPS, TWO, OTHER = "scenario=ratio_steps", "plant=coculture scenario=ratio_steps", "give composition=midpoint"
TRAINED = "composition=dqn_preview: its policy was trained for shares of 0.1 to 0.9, the scenario asks for"
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
    assert "of one species" in page


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


def test_a_scenario_alone_is_completed(tmp_path: Path) -> None:
    """`scenario=ratio_steps` and nothing else: the best law there is, two species in the vial."""
    words = ["scenario=ratio_steps", "scenario.minutes=[10,20,20,20]", "fsync=false"]
    folder = deploy(tmp_path / "run", *words)
    summary = json.loads((folder / "summary.json").read_text())
    assert {row["ratio_setpoint"] for row in summary["windows"]} == {None, 0.3, 0.7}
    stored = yaml.safe_load((folder / "config.yaml").read_text())
    assert stored["composition"]["kind"] == "midpoint"
    assert stored["plant"]["second"]["start_share"] == [0.5, 0.5]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("plant=coculture composition=pi", "composition=pi: no scenario asks for a share; give scenario=ratio_steps"),
        (f"{STEPS} composition=pi plant=bench", "composition=pi: the vials hold one species .* give plant=coculture"),
        (
            f"{STEPS} composition=pi backend=emulator backend.plant=bench",
            "composition=pi: the vials hold one species .* give backend.plant=coculture",
        ),
        (f"{TWO} composition=dqn composition_policy=nowhere", "policy nowhere: no such file; give the policy.npz"),
        (
            f"{TWO} composition=dqn composition_policy={policies.SHIPPED}",
            r"policy = \['error', 'growth_share'\]: allowed one with observation \['logit_share'",
        ),
        (
            f"{TWO} composition=optimum backend.reactors=[M0,M1] +each.M1.ratios=[0.6,0.5,0.4,0.3]",
            "composition=optimum plans one program: give all reactors the same shares and minutes",
        ),
        (f"{TWO} composition=dqn_preview scenario.ratios=[null,0.95,0.5,0.03]", f"{TRAINED} 0.03, 0.95; {OTHER}"),
        (f"{TWO} composition=dqn_preview backend.reactors=[M0,M1] {FAR}", f"{TRAINED} 0.95; "),
        (
            f"{TWO} composition=dqn_preview pair=ecoli_psyringae",
            "policy's pair = of E. coli and P. putida, for a run with E. coli and P. syringae; growth differs by up to "
            "0.5. 1/h: allowed the run's own: train one with pair=",
        ),
        (f"{TWO} pair=yeasts", "pair = yeasts: allowed ecoli_pputida, ecoli_psyringae, a pair.yaml, or"),
        (
            f"{TWO} composition=pi safety.composition_high=31",
            "safety.composition_low to composition_high = 29 to 31 degC: allowed a range that holds 33.20 degC, where",
        ),
        (f"{TWO} composition=pi +each.M0.ratios=[0.5]", "each.M0: scenario.ratios"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_remedy(words: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(frame.UserError, match=said) as caught:
        deploy(tmp_path / "run", *words.split())
    assert "\n" not in str(caught.value)


def test_a_learned_controller_without_a_policy_that_ships_says_what_to_give(tmp_path, monkeypatch):
    monkeypatch.setitem(SHIPPED_COMPOSITION, "dqn", tmp_path / "none.npz")
    with pytest.raises(frame.UserError, match="composition=dqn: no policy for it comes with this version; give compos"):
        deploy(tmp_path / "run", *WORDS[:2], "composition=dqn")


def test_a_share_beyond_training_runs_where_it_is_forced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = (*WORDS[:2], "composition=dqn_preview", "scenario.ratios=[null,0.95,0.5,0.5]", "scenario.minutes=[1,2,1,1]")
    deploy(tmp_path / "run", *words, "force_policy=true")
    assert "trained for shares of 0.1 to 0.9, the scenario asks for 0.95; it runs all the same" in caplog.text


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
