"""Pump calibration and blank: against the emulated device over HTTP, and from weighings in a file."""

import io
import json
import re
import sys
import urllib.request
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from experiments import blank as blanks
from experiments.blank import BlankConfig, blank
from experiments.calibrate_pump import CalibratePumpConfig, Weighing, _number, calibrate, report, weigh
from experiments.cli import frame
from hardware.chibio.calibrations import load_calibrations
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import fit_pump
from hardware.chibio.protocol import PERIOD_S
from hardware.emulator.process import EmulatorProcess
from hardware.errors import DeviceStateError, UnfitError


def truth(emulator: EmulatorProcess) -> dict:  # type: ignore[type-arg]
    with urllib.request.urlopen(f"{emulator.control}/_emulator/truth") as answer:
        return dict(json.load(answer)["M0"])


@pytest.mark.slow
def test_weighing_the_emulators_pump_finds_what_it_delivers() -> None:
    with EmulatorProcess(["--speed", "200", "--unit", "5"]) as emulator:
        backend = ChiBioConfig(url=emulator.url, speed=200.0)
        config = CalibratePumpConfig(backend, duties=(0.008, 0.02, 0.04), doses=10)
        on_balance = [0.0]
        answers = iter(["no idea", "12,5"])

        def ask(question: str) -> str:
            """An operator with a balance: tares it, later reads it."""
            if "tare" in question:
                on_balance.append(truth(emulator)["feed_ml"])
                return ""
            return next(answers, str(truth(emulator)["feed_ml"] - on_balance[-1]))

        found, identity = weigh(config, ask)
        after = truth(emulator)
    assert identity == "1000200030004005"
    assert [s.duty for s in found] == [0.008, 0.02, 0.04]
    assert found[0].grams == 12.5  # asked again after an answer that is no number; a comma is a point
    assert not any(after["motors"].values())
    expected = [10 * (PERIOD_S * s.duty + 0.06) for s in found[1:]]  # bias 0.02 to 0.2 s, of which 0.05 s are dead
    assert [s.grams for s in found[1:]] == pytest.approx(expected, rel=0.12)


@pytest.mark.slow
def test_of_two_pumps_the_one_that_is_asked_for_runs_and_is_weighed(tmp_path: Path) -> None:
    """The waste pump, at duties that the feed pump may never have."""
    with EmulatorProcess(["--speed", "300"]) as emulator:
        backend = ChiBioConfig(url=emulator.url, speed=300.0, calibration=str(tmp_path / "c"))
        config = CalibratePumpConfig(backend, pump="waste", duties=(0.1, 0.3, 0.5), doses=3)
        asked = []

        def ask(question: str) -> str:
            asked.append(truth(emulator)["on_s"])
            return "" if "tare" in question else f"{1.2 * 3 * (PERIOD_S * config.duties[(len(asked) - 1) // 2]):.3f}"

        found, _ = weigh(config, ask)
        after = truth(emulator)
    assert [s.duty for s in found] == [0.1, 0.3, 0.5]
    assert not any(after["motors"].values())
    for tared, weighed, duty in zip(asked[::2], asked[1::2], config.duties, strict=True):
        ran = {pump: weighed[pump] - tared[pump] for pump in tared}
        assert ran.pop("Pump2") > 0.9 * 3 * PERIOD_S * duty  # more on a busy machine, which ends each dose late
        assert not any(ran.values())


@pytest.mark.slow
def test_pumps_of_a_running_experiment_are_not_weighed() -> None:
    with EmulatorProcess(["--speed", "60"]) as emulator:
        request = urllib.request.Request(f"{emulator.url}/Experiment/1/M0", method="POST")
        urllib.request.urlopen(request).close()
        config = CalibratePumpConfig(ChiBioConfig(url=emulator.url, speed=60.0))
        with pytest.raises(DeviceStateError, match="experiment is running"):
            weigh(config, lambda _: "1.0")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "at least 2 series"),
        ("duty,doses\n0.01,20\n", "line 2"),
        ("duty,doses,grams\n0.01,20,1.2\n0.02,twenty,1.2\n", "line 3"),
        ("duty,doses,grams\n0.01,20,12\n0.02,20,6\n", "weighed less"),
        ("duty,doses,grams\n0.01,20,nan\n", "line 2"),
        *(
            (f"duty,doses,grams\n1,1,0\n{row}\n", "line 3: .*columns duty,doses,grams")
            for row in ("0,20,1", "1.01,20,1", "0.01,0,1", "0.01,20,-1", "0.01,20,10000", "0.01,2.5,1")
        ),
        ("\0\1\2", "at least 2 series"),
    ],
)
def test_a_file_of_nonsense_ends_in_one_line(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "w.csv"
    path.write_text(content)
    config = CalibratePumpConfig(ChiBioConfig(calibration=str(tmp_path / "c")), csv=str(path))
    with pytest.raises(frame.UserError, match=words):
        calibrate(config, tmp_path)
    assert not (tmp_path / "c").exists()


def test_each_weighing_stands_beside_what_is_fitted_in_ml_of_one_of_its_doses() -> None:
    """0.8 mL/s of what a pump runs beyond 0.1 s less than asked; 20, 8 and 5 doses were weighed.

    Two series leave the spread unknown.
    """
    found = [Weighing(duty, n, n * 0.8 * (PERIOD_S * duty - 0.1)) for duty, n in ((0.01, 20), (0.02, 8), (0.05, 5))]
    on_s, doses, grams = np.array([[PERIOD_S * s.duty, s.doses, s.grams] for s in found]).T
    _, *lines = report(fit_pump(on_s, doses, grams), found).splitlines()
    assert [line.split() for line in lines[:3]] == [
        ["0.630", "20", "0.4240", "0.4240"], ["1.260", "8", "0.9280", "0.9280"], ["3.150", "5", "2.4400", "2.4400"],
    ]  # fmt: skip
    assert lines[3].startswith("flow 0.8000 +- 0.0000 mL/s, bias -0.100 +- 0.000 s, ")
    two = report(fit_pump(on_s[:2], doses[:2], grams[:2]), found[:2])
    assert ("nan" in two, "flow 0.8000 mL/s, bias -0.100 s" in two, "third" in two) == (False, True, True)


def test_two_pumps_of_two_units_are_stored_apart_with_what_was_weighed(tmp_path: Path) -> None:
    for reactor, pump, flow in (("M0", "feed", 0.9), ("M3", "waste", 1.4)):
        weighed = [f"{n},{n * flow * (PERIOD_S * d + 0.1):.6f},{d}" for d, n in ((0.01, 20), (0.02, 10), (0.04, 5))]
        (tmp_path / "w.csv").write_text("\n".join(["doses,grams,duty", *weighed]) + "\n")
        backend = ChiBioConfig(calibration=str(tmp_path / "c"))
        calibrate(CalibratePumpConfig(backend, reactor, pump, csv=str(tmp_path / "w.csv")), tmp_path)
        told = json.loads((tmp_path / "summary.json").read_text())
        assert told["file"] == str(tmp_path / "c" / f"{reactor}_{pump}.yaml")
        assert [(w["duty"], w["doses"]) for w in told["weighings"]] == [(0.01, 20), (0.02, 10), (0.04, 5)]
        assert (told["flow_ml_s"], told["bias_s"]) == (pytest.approx(flow, rel=1e-4), pytest.approx(0.1, abs=1e-4))
    first, second = load_calibrations(tmp_path / "c", ["M0", "M3"])
    assert first.feed.flow_ml_s == pytest.approx(0.9, rel=1e-4)
    assert second.waste.flow_ml_s == pytest.approx(1.4, rel=1e-4)
    assert [first.waste.date, second.feed.date] == ["", ""]
    assert second.waste.date
    assert not second.calibrated  # its feed pump was not weighed
    assert np.isnan(second.blank)


def test_an_answer_that_is_no_mass_is_asked_for_again(capsys: pytest.CaptureFixture[str]) -> None:
    answers = iter(["", "-0.1", "10000", "nan", "12,5 g", " 12,75 "])
    assert _number(lambda question: next(answers), "grams: ") == 12.75
    assert capsys.readouterr().out.count("is not a mass in grams; type a number from 0 to 10000") == 5
    assert _number(lambda question: "0", "grams: ") == 0.0


def test_duties_may_reach_both_ends_of_what_their_pump_takes() -> None:
    assert CalibratePumpConfig(duties=(0.003, 0.05)).duties == (0.003, 0.05)
    assert CalibratePumpConfig(pump="waste", duties=(0.5, 0.003)).duties == (0.5, 0.003)
    for pump, duties in (
        ("feed", (0.002, 0.05)), ("feed", (0.02, 0.06)), ("feed", (0.02, 0.02)), ("waste", (0.003, 0.51)),
    ):  # fmt: skip
        most = {"feed": 0.05, "waste": 0.5}[pump]
        with pytest.raises(ValueError, match=f"duties = .*: allowed at least two different ones from 0.003 to {most}$"):
            CalibratePumpConfig(pump=pump, duties=duties)


@pytest.mark.parametrize("fails", [False, True])
def test_each_vial_s_blank_is_stored_under_its_own_name_and_unit(fails, tmp_path, monkeypatch):
    """Of M2 and M5; where the counts do not come, everything is switched off and nothing stored."""
    stations = tuple(SimpleNamespace(connection=SimpleNamespace(device_id=number)) for number in ("22", "55"))
    two, warmed = Mock(names=("M2", "M5"), stations=stations), Mock(return_value=[])
    counts = np.array([14000.4, 15500.6]), np.array([12.4, 30.6])
    measured = Mock(side_effect=UnfitError("no light") if fails else None, return_value=counts)
    parts = {"linked": lambda backend: nullcontext((None, None)), "ChiBioReactors": lambda *given: two}
    for name, part in (parts | {"warm_up": warmed, "measure_blanks": measured}).items():
        monkeypatch.setattr(blanks, name, part)
    backend = ChiBioConfig(reactors=("M2", "M5"), temperature=33.0, calibration=str(tmp_path / "c"))
    config = BlankConfig(backend, warm_up=70.0, tolerance=0.5, samples=9)
    with pytest.raises(frame.UserError, match="^no light$") if fails else nullcontext():
        blank(config, tmp_path)
    assert [call[0] for call in two.method_calls] == ["begin", "stop" if fails else "end"]
    assert (warmed.call_args.args[1:], measured.call_args.args[1:]) == ((0.5, 70.0), (9,))
    if fails:
        assert list(tmp_path.iterdir()) == []
        return
    told = json.loads((tmp_path / "summary.json").read_text())
    assert {name: (r["blank"], r["sd"], r["samples"], r["device_id"]) for name, r in told.items()} == {
        "M2": (14000.4, 12.4, 9, "22"), "M5": (15500.6, 30.6, 9, "55"),
    }  # fmt: skip
    assert [rig.blank for rig in load_calibrations(tmp_path / "c", ["M2", "M5"])] == [14000.4, 15500.6]


def test_without_a_terminal_nobody_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    with pytest.raises(frame.UserError, match="csv=FILE"):
        calibrate(CalibratePumpConfig(), tmp_path)


@pytest.mark.slow
def test_the_blank_of_clear_medium_is_found_stored_and_restored(tmp_path: Path) -> None:
    with EmulatorProcess(["--speed", "100", "--od", "0", "--unblanked", "--reactors", "M0,M1"]) as emulator:
        backend = ChiBioConfig(url=emulator.url, speed=100.0, reactors=("M0", "M1"), calibration=str(tmp_path / "c"))
        blank(BlankConfig(backend, samples=4), tmp_path)
        real, left = truth(emulator)["blank"], truth(emulator)
        connected = CalibratePumpConfig(backend, duties=(0.008, 0.02), doses=3)
        found, _ = weigh(connected, lambda _: "1.0")
    assert len(found) == 2, "the experiment is over: the next work on the bench begins"
    assert not any((left["heat"], left["stir"], *left["motors"].values()))
    rigs = load_calibrations(tmp_path / "c", ["M0", "M1"])
    assert rigs[0].blank == pytest.approx(real, rel=0.01)
    assert rigs[1].blank != rigs[0].blank
    assert json.loads((tmp_path / "summary.json").read_text())["M0"]["samples"] == 4


@pytest.mark.slow
def test_a_cold_vial_is_warmed_before_its_blank_is_measured(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = ["--speed", "60", "--od", "0", "--unblanked", "--reactors", "M0,M1", "--temperature", "24"]
    with EmulatorProcess(words) as emulator, caplog.at_level("INFO"):
        backend = ChiBioConfig(
            url=emulator.url, speed=60.0, reactors=("M0", "M1"), calibration=str(tmp_path), temperature=33.0
        )
        blank(BlankConfig(backend, reactor="M0", samples=3), tmp_path)
        said = [record.getMessage() for record in caplog.records]
        assert truth(emulator)["temperature"] == pytest.approx(33.0, abs=1.5)
    assert not [record for record in caplog.records if record.name.startswith("http")]  # not every request is shown
    warm = [re.fullmatch(r"minute (\d+): ([\d.]+) degC, waiting for 33", line) for line in said]
    seen = [(int(match[1]), float(match[2])) for match in warm if match]
    assert seen  # on a busy machine one line only
    assert 24.0 < seen[0][1] < 32.0
    assert [path.name[:2] for path in tmp_path.glob("*blank.yaml")] == ["M0"]


@pytest.mark.slow
def test_a_vial_that_does_not_warm_up_gets_no_blank(tmp_path: Path) -> None:
    words = ["--speed", "600", "--od", "0", "--unblanked", "--temperature", "20"]
    with EmulatorProcess(words) as emulator:
        backend = ChiBioConfig(url=emulator.url, speed=600.0, calibration=str(tmp_path))
        with pytest.raises(frame.UserError, match=r"M0: .* after [56] min, .*37"):
            blank(BlankConfig(backend, samples=3, warm_up=5.0), tmp_path)
    assert not list(tmp_path.glob("*blank.yaml"))


@pytest.mark.slow
def test_a_culture_is_no_blank(tmp_path: Path) -> None:
    with EmulatorProcess(["--speed", "100", "--od", "2.5", "--unblanked"]) as emulator:
        backend = ChiBioConfig(url=emulator.url, speed=100.0, calibration=str(tmp_path))
        with pytest.raises(frame.UserError, match="allowed 3000 to 60000"):
            blank(BlankConfig(backend, samples=3), tmp_path)


@pytest.mark.parametrize(
    ("what", "content", "words"),
    [
        ("feed", "{", "not readable"), ("feed", "- 1", "no keys"), ("feed", "flow_ml_s: fast", "flow_ml_s = fast"),
        ("feed", "flow_ml_s: 70", "flow_ml_s = 70"), ("blank", "blank: 13.0", "blank = 13"),
    ],
)  # fmt: skip
def test_a_broken_calibration_file_is_named(tmp_path: Path, what: str, content: str, words: str) -> None:
    (tmp_path / f"M0_{what}.yaml").write_text(content)
    with pytest.raises(UnfitError, match=words):
        load_calibrations(tmp_path, ["M0"])
