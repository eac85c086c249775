"""The command `calibrate`: its files, its numbers, and its refusals."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib import resources
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from omegaconf import OmegaConf

from envs.identification.calibration import Calibration, calibrate
from envs.identification.drift import Drift
from envs.identification.model import Parameter
from envs.identification.open_loop import OpenLoop, open_loop
from envs.identification.screening import Series
from envs.identification.validation import Validation
from envs.task import EnvConfig
from experiments import calibrate as command
from experiments.calibration import study
from experiments.calibration.config import CalibrateConfig
from experiments.calibration.result import environment_yaml, summary
from experiments.calibration.study import against_truth, simulated
from experiments.cli import frame
from experiments.cli.calibrated import read_plant_file
from experiments.recordings import reader as source
from experiments.recordings.reader import Recording, read_recording
from experiments.reporting import calibration_charts, charts, tensorboard
from experiments.reporting.verdict import verdict
from hardware.errors import RecordingError
from tests.real_recording import DITHER, needs_dither

pytestmark = pytest.mark.numeric

SHIPPED = Path(str(resources.files("experiments") / "data" / "open_loop.csv"))
Cli, Summary = Callable[..., str], Callable[[], dict[str, Any]]


@pytest.fixture
def cli(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cli:
    """The command with these words, in this process; what it printed. Raises: UserError where it ends with a line."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> str:
        (tmp_path / "run").mkdir(exist_ok=True)
        command.body(command.main.config(words), tmp_path / "run")
        return capsys.readouterr().out

    return run


@pytest.fixture
def plain(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> Cli:
    """The command without twin and figures, which take longer than the fit."""
    monkeypatch.setattr(command, "twin", lambda *given: None)
    monkeypatch.setattr(command, "twin_yaml", lambda *given: "")
    monkeypatch.setattr(command, "_draw", lambda *given: None)
    return cli


@pytest.fixture
def summary_of(tmp_path: Path) -> Summary:
    return lambda: json.loads((tmp_path / "run" / "summary.json").read_text())  # type: ignore[no-any-return]


def tidy(path: Path, od: np.ndarray, time: np.ndarray, pump_rate: np.ndarray) -> str:
    rows = zip(time.tolist(), od.tolist(), pump_rate.tolist(), strict=True)
    path.write_text("time_min,od,pump_rate_ml_s\n" + "".join(f"{t!r},{y!r},{u!r}\n" for t, y, u in rows))
    return f"data={path}"


@pytest.fixture(scope="module")
def recording() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time, od, pump_rate = open_loop(OpenLoop(hours=4.0), np.random.default_rng(6))
    return time, od[0], pump_rate[0]


@pytest.fixture(scope="module")
def shipped() -> Recording:
    return read_recording(str(SHIPPED))


@pytest.fixture(scope="module")
def real(shipped: Recording) -> Calibration:
    return calibrate(Series(shipped.time_min, shipped.od, shipped.pump_rate, shipped.row))


@pytest.mark.slow
def test_the_shipped_recording(cli: Cli, summary_of: Summary, tmp_path: Path) -> None:
    cli()
    run, content = tmp_path / "run", summary_of()
    assert content["mu"]["ci95"][0] <= 0.028 <= content["mu"]["ci95"][1]
    assert content["tau"]["ci95"][0] <= 0.31 <= content["tau"]["ci95"][1]
    assert content["rows_used"] == [0, 361]
    assert (content["n_used"], content["n_rejected"], content["warnings"]) == (361, 0, [])
    assert content["pmse_pct"] < 0.05
    assert content["verdict"]["word"] == "use"
    for figure in ("figures/fit.png", "figures/drift.png", "figures/twin.png"):
        assert (run / figure).read_bytes().startswith(b"\x89PNG")
    assert list(run.glob("events.out.tfevents.*"))
    nominal = OmegaConf.create(asdict(EnvConfig()))
    fitted = OmegaConf.load(run / "calibrated.yaml")
    assert list(fitted) == list(nominal)
    assert {k for k in nominal if nominal[k] != fitted[k]} == {"mu", "tau"}
    assert (fitted.mu, fitted.tau) == (content["mu"]["value"], content["tau"]["value"])
    plant = read_plant_file(str(run / "twin.yaml"))
    assert plant.growth.mu == pytest.approx(0.028, rel=0.02)
    assert 20.0 / (60.0 * plant.pump.gain_ml_s) == pytest.approx(0.31, rel=0.02)
    assert np.hypot(plant.sensor.noise_floor / 0.5, plant.sensor.noise_relative) == pytest.approx(0.01, rel=0.2)
    assert plant.sensor.outlier_rate == 0.0


def test_the_shipped_recording_is_what_the_generator_makes(cli: Cli, tmp_path: Path) -> None:
    cli("generate=true", "out=again.csv")
    assert (tmp_path / "again.csv").read_text() == SHIPPED.read_text()


@needs_dither
@pytest.mark.slow
def test_a_real_recording(cli: Cli, summary_of: Summary, tmp_path: Path) -> None:
    cli(f"data={DITHER}")
    content = summary_of()
    assert 0.0098 <= content["mu"]["value"] <= 0.0108
    assert 0.28 <= content["tau"]["value"] <= 0.33
    broken = [r for r in content["rejected"] if "sensor broken" in r["reason"]]
    assert [(r["first"], r["last"]) for r in broken] == [(1157, 1208)]
    assert content["drift"]["mu"]["significant"]
    plant = read_plant_file(str(tmp_path / "run" / "twin.yaml"))
    mu, tau = np.array(plant.growth.knots_mu), 1.0 / (3.0 * np.array(plant.pump.knots_ml_s))
    assert plant.growth.knots_min[-1] == pytest.approx(1157, abs=2)
    # slopes of single swings, by hand: tau 0.29 to 0.42, growth 0.010 to 0.014
    assert 0.27 < tau[0] < 0.31
    assert 0.38 < tau[-1] < 0.46
    assert 0.0095 < mu[3:5].mean() < 0.0115
    assert 0.0125 < mu[-3:].mean() < 0.0145
    # second differences of ln OD in rows without a dose, at OD 0.3 to 0.5 and 0.05 to 0.2
    floor, share = plant.sensor.noise_floor, plant.sensor.noise_relative
    assert [np.hypot(floor, od * share) for od in (0.4, 0.1)] == pytest.approx([0.0127, 0.0057], rel=0.1)


def test_a_recording_that_cannot_be_used_is_one_line_with_its_name(plain, tmp_path, recording):
    """One that is not there, one that the reader refuses, one that the fit refuses."""
    time, od, pump_rate = recording
    tidy(tmp_path / "counts.csv", 13000 * 10**-od, time, pump_rate)
    tidy(tmp_path / "always.csv", 0.1 * np.exp(0.005 * time), time, 0 * time + 0.01)
    for name in ("absent.csv", "counts.csv", "always.csv"):
        with pytest.raises(frame.UserError, match=name.removesuffix(".csv")) as caught:
            plain(f"data={tmp_path / name}")
        assert str(tmp_path / name) in str(caught.value)
        assert "\n" not in str(caught.value)


def of_two_pumps(path: Path, recording: tuple[np.ndarray, np.ndarray, np.ndarray], first: float) -> str:
    """A file in which pump 1 gave this share of the medium, and pump 3 the rest."""
    rows = "".join(
        f"{60 * t},{y},{first * u},{(1.0 - first) * u}\n"
        for t, y, u in zip(*map(np.ndarray.tolist, recording), strict=True)
    )
    path.write_text("exp_time,od_measured,pump_1_rate,pump_3_rate\n" + rows)
    return f"data={path}"


def test_a_refusal_of_the_fit_carries_what_the_reader_noted(plain, tmp_path, recording):
    data = of_two_pumps(tmp_path / "third.csv", recording, 0.0)
    with pytest.raises(frame.UserError, match=r"pump 3 .*pumps=\[3\]") as caught:
        plain(data)
    assert "\n" not in str(caught.value)
    plain(data, "pumps=[3]", "pump_ml_s=1")


def test_a_second_feed_is_told_in_the_first_line_and_on_the_page(plain, summary_of, tmp_path, recording):
    """Pumps 1 and 3 share the feed, 7 to 3: with one of them alone tau is wrong by 30 %."""
    data = of_two_pumps(tmp_path / "shared.csv", recording, 0.7)
    first = next(line for line in plain(data).splitlines() if line.startswith("Calibration of"))
    content = summary_of()
    assert next(iter(content)) == "verdict"
    assert content["verdict"]["word"] == "use with care"
    assert "pumps=[1,3]" in first
    assert content["tau"]["value"] == pytest.approx(0.7 * 0.31, rel=0.05)
    said = verdict(content, {"data": data.removeprefix("data=")})
    assert said is not None
    assert "shared.csv" in said.claim
    assert "use with care" in said.claim
    plain(data, "pumps=[1,3]")
    again = summary_of()
    assert again["verdict"]["word"] == "use"
    assert again["tau"]["value"] == pytest.approx(0.31, rel=0.05)


def test_a_recording_without_tau_leaves_mu_and_what_to_do(plain: Cli, summary_of: Summary, tmp_path: Path) -> None:
    time = np.arange(0.0, 240.0)
    od = 0.1 * np.exp(0.009 * time) * (1.0 + 0.01 * np.random.default_rng(3).standard_normal(240))
    with pytest.raises(frame.UserError) as caught:
        plain(tidy(tmp_path / "batch.csv", od, time, 0.0 * time))
    content = summary_of()
    for part in ("word", "why", "then"):
        assert content["verdict"][part] in str(caught.value)
    assert "mu is 0.00" in str(caught.value)
    assert content["verdict"]["word"] == "record again"
    assert (content["mu"], content["tau"]) == (None, None)
    assert content["mu_alone"]["ci95"][0] <= 0.009 <= content["mu_alone"]["ci95"][1]
    assert content["mu_alone"]["rows"] == [0, 240]


def test_merged_rows_are_told_beside_what_the_reader_noted(plain: Cli, summary_of: Summary, tmp_path: Path) -> None:
    """Six hours of rows of 2 s, one of them without a reading."""
    time, od, rate = open_loop(OpenLoop(hours=6.0), np.random.default_rng(3))
    fine = np.arange(0.0, 360.0, 1.0 / 30.0)
    smooth = np.exp(np.interp(fine, time, np.log(od[0])))
    smooth[500] = np.nan
    plain(tidy(tmp_path / "fine.csv", smooth, fine, rate[0][np.floor(fine).astype(int)]))
    content = summary_of()
    assert [n.split(":")[0] for n in content["notes"][:1]] == ["row 500"]
    assert content["notes"][-1].startswith("10800 rows merged into 360 ")
    assert content["tau"]["value"] == pytest.approx(0.31, rel=0.05)


def test_rows_too_far_apart_for_the_segments_are_told_as_that(plain: Cli, summary_of: Summary, tmp_path: Path) -> None:
    time = 15.0 * np.arange(60)
    pump_rate = np.where(time % 120 < 60, 0.018, 0.0)
    volume = np.concatenate([[0.0], np.cumsum(15.0 * pump_rate[:-1])])
    noise = np.random.default_rng(2).normal(0.0, 0.005, len(time))
    data = tidy(tmp_path / "slow.csv", 0.3 * np.exp(0.028 * time - volume / 0.31 + noise), time, pump_rate)
    with pytest.raises(frame.UserError, match=r"slow\.csv: .*15 min.*120 min.*identify\.segment_min=300") as caught:
        plain(data)
    assert "\n" not in str(caught.value)
    plain(data, "identify.segment_min=300")
    content = summary_of()
    assert content["verdict"]["word"] == "use with care"
    assert "15 min" in content["verdict"]["why"]
    assert content["tau"]["value"] == pytest.approx(0.31, rel=0.05)


def test_flaws_are_excluded_and_reported(plain, summary_of, tmp_path, recording):
    time, od, pump_rate = (a.copy() for a in recording)
    od[[30, 31]], od[60], od[90] = np.nan, -0.5, 3.0 * od[90]
    time[120], time[150] = time[119], time[140] + 0.5
    out, content = plain(tidy(tmp_path / "flawed.csv", od, time, pump_rate)), summary_of()
    assert content["n_rejected"] == 4
    assert [(r["rows"], r["n"]) for r in content["rejected"]] == [("90", 1)]
    for rows in ("30-31", "60", "120, 150"):
        assert any(rows in note and note in out for note in content["notes"])
    assert content["tau"]["value"] == pytest.approx(0.31, rel=0.02)


def test_a_study_of_intervals_counts_its_recordings_and_draws_them(cli, summary_of, tmp_path):
    cli("coverage=3", "protocol.hours=2.5")
    content = summary_of()
    assert (content["recordings"], content["refused"]) == (3, 0)
    assert 0.0 < content["relative_half_width_pct"]["mu"] < content["relative_half_width_pct"]["tau"] < 10.0
    assert (tmp_path / "run" / "figures" / "coverage.png").read_bytes().startswith(b"\x89PNG")


def test_rows_are_those_of_the_file_also_where_its_beginning_is_left_out() -> None:
    """From minute 40 of a recording by the minute, with two rows rejected among them."""
    r = read_recording(str(SHIPPED))
    od = r.od.copy()
    od[[90, 200]] *= 4.0
    raw = Series(r.time_min[40:], od[40:], r.pump_rate[40:], r.row[40:])
    content = summary(calibrate(raw), r, raw)
    assert content["rows"] == [40, 361]
    assert [(each["rows"], each["n"]) for each in content["rejected"]] == [("90, 200", 2)]
    spans = [each["rows"] for each in content["segments"]]
    assert len(spans) >= 2
    assert (spans[0][0], spans[-1][1]) == (40, 361)
    assert [end for _, end in spans[:-1]] == pytest.approx([first for first, _ in spans[1:]], abs=1)
    for (first, end), each in zip(spans, content["segments"], strict=True):
        assert each["middle_min"] == pytest.approx(0.5 * (first + end - 1), abs=1.0)
    assert 40 <= content["rows_used"][0] < content["rows_used"][1] <= 361


def test_a_tuned_pi_is_tuned_for_the_protocol_s_period() -> None:
    """u = (K z + I) / 3, I <- I + K dt z / T with K = 1/2, T = 8 min and dt = 2 min, but where u is at a bound."""
    protocol = OpenLoop(start_od=0.5, control_min=2.0, hours=2.0, noise=0.03)
    config = CalibrateConfig(law="pi_tuned", setpoints=(0.5,), rest_min=0.0, protocol=protocol)
    time, od, rate, _ = simulated(config, 2)
    np.testing.assert_array_equal(time, np.arange(0.0, 121.0, 2.0))
    for readings, given in zip(od, rate, strict=True):
        integral = 0.03
        for reading, u in zip(readings, given, strict=True):
            z = np.log(reading / 0.5)
            wanted = (0.5 * z + integral) / 3.0
            assert u == pytest.approx(np.clip(wanted, 0.0, 0.02))
            if not ((wanted > 0.02 and z > 0.0) or (wanted < 0.0 and z < 0.0)):
                integral += 0.5 * 2.0 * z / 8.0


def test_a_study_counts_what_is_wrong_of_all_and_what_holds_of_those_accepted(real: Calibration) -> None:
    """Eight recordings, three refused; of the others each pair of intervals by hand, truth 0.03 and 0.3."""

    def off(mu: float, tau: float) -> Calibration:
        """So many half widths, of 0.001 and of 0.01."""
        centres = ((0.03, 0.001, mu), (0.3, 0.01, tau))
        found = [Parameter(at + half * by, at + half * (by - 1.0), at + half * (by + 1.0)) for at, half, by in centres]
        return replace(real, mu=found[0], tau=found[1])

    kept = [off(0.5, -0.5), off(1.5, 0.0), off(3.0, 0.0), off(0.0, -2.5), off(-3.0, 4.0)]
    found = ["flat", kept[0], "short", kept[1], kept[2], kept[3], "flat", kept[4]]
    true = [isinstance(each, Calibration) for each in found]
    numbers = against_truth(found, np.where(true, 0.03, 1.0), np.where(true, 0.3, 1.0))
    assert (numbers["recordings"], numbers["refused"], numbers["refusals"]) == (8, 3, ["flat", "short"])
    assert numbers["wrong_pct"] == pytest.approx(100.0 * 3 / 8)
    assert numbers["coverage_pct"] == pytest.approx({"mu": 100.0 * 2 / 5, "tau": 100.0 * 3 / 5})
    assert numbers["median_bias_pct"] == pytest.approx({"mu": 100.0 * 0.0005 / 0.03, "tau": 0.0})
    assert against_truth(["flat"], np.ones(1), np.ones(1))["wrong_pct"] == 0.0


@pytest.fixture(scope="module")
def fitted(real: Calibration) -> Calibration:
    """The shipped recording's calibration, in which every number is another one."""
    faster, slower = Parameter(0.002, 0.001, 0.003), Parameter(-0.01, -0.02, -0.001)
    return replace(
        real, mu=Parameter(0.02, 0.018, 0.023), tau=Parameter(0.4, 0.35, 0.44), pmse_pct=1.25, pair_pmse_pct=2.5,
        drift_mu=Drift(0.019, 0.022, 15.8, faster, 4), drift_tau=Drift(0.41, 0.37, -9.8, slower, 3),
        validation=Validation(3.5, 0.75, 61, 4.25, 17), warnings=("it drifts", "it is noisy"),
    )  # fmt: skip


def test_the_screen_and_the_file_say_of_each_number_what_it_is(fitted: Calibration, shipped: Recording) -> None:
    """Doubling in ln 2 / 0.02 = 34.7 min, dilution of 0.02 / 0.4 = 0.05 1/min at 0.02 mL/s."""
    r = replace(shipped, notes=("a note",))
    raw = Series(r.time_min, r.od, r.pump_rate, r.row)
    content = summary(fitted, r, raw)
    assert content["doubling_min"] == pytest.approx(np.log(2.0) / 0.02)
    assert (content["mu"], content["tau"]) == (
        {"value": 0.02, "ci95": [0.018, 0.023]}, {"value": 0.4, "ci95": [0.35, 0.44]},
    )  # fmt: skip
    assert (content["pmse_pct"], content["pair_pmse_pct"]) == (1.25, 2.5)
    first = {"first": 0.019, "last": 0.022, "change_pct": 15.8, "significant": True, "segments": 4}
    assert content["drift"]["mu"] == {**first, "per_hour": {"value": 0.002, "ci95": [0.001, 0.003]}}
    assert (content["drift"]["tau"]["first"], content["drift"]["tau"]["segments"]) == (0.41, 3)
    told = verdict(content, {"data": "mine.csv"})
    assert told is not None
    for key, *numbers in (
        ("mu", "0.02", "0.018", "0.023", "34.7"), ("tau", "0.4", "0.35", "0.44"), ("PMSE", "1.25 %"),
    ):  # fmt: skip
        assert any(line.startswith(key) and all(n in line for n in numbers) for line in told.items), key
    assert "it drifts" in told.remark
    assert "it is noisy" in told.remark
    head = environment_yaml(fitted, "mine.csv")
    origin = "mine.csv, rows 0:361, 361 readings"
    for part in (origin, "mu 0.018 to 0.023 1/min, tau 0.35 to 0.44", "1.25 %", "it drifts", "it is noisy"):
        assert any(line.startswith("#") and part in line for line in head.splitlines())
    model = OmegaConf.create(head)
    assert (model.mu, model.tau, model.control_min) == (0.02, 0.4, 1.0)


@pytest.mark.parametrize("rest_min", [10.0, 0.0])
def test_a_proportional_law_is_asked_for_each_setpoint_as_long_and_rests_at_the_start_of_every_hour(rest_min):
    """u = 0.01 + 0.05 (x - r) between 0 and 0.02; three setpoints in three hours."""
    protocol = OpenLoop(start_od=0.5, hours=3.0, noise=0.02, control_min=1.0)
    config = CalibrateConfig(
        law="proportional", setpoints=(0.4, 0.7, 0.5), rest_min=rest_min, gain=0.05, protocol=protocol
    )
    time, od, rate, _ = simulated(config, 2)
    asked = np.where(time < 60.0, 0.4, np.where(time < 120.0, 0.7, 0.5))
    by_hand = np.clip(0.01 + 0.05 * (od - asked), 0.0, 0.02) * (time % 60.0 >= rest_min)
    np.testing.assert_allclose(rate[:, :-1], by_hand[:, :-1])
    assert not np.allclose(rate[0], rate[1])


def test_a_generated_recording_is_as_long_as_asked_and_says_what_it_is_of(tmp_path, capsys):
    protocol = OpenLoop(mu=0.021, tau=0.41, hours=2.0, control_min=2.0)
    config = CalibrateConfig(generate=True, law="threshold", setpoints=(0.4,), protocol=protocol)
    assert command.body(config, tmp_path) is None
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content == {"file": str(tmp_path / "threshold.csv"), "rows": 61, "mu": 0.021, "tau": 0.41}
    rows = (tmp_path / "threshold.csv").read_text().splitlines()
    assert (len(rows), rows[0], rows[-1].split(",")[0]) == (62, "time_min,od,pump_rate_ml_s", "120.0")
    assert f"61 rows (threshold; mu 0.021, tau 0.41) in {tmp_path}/threshold.csv" in capsys.readouterr().out
    with pytest.raises(frame.UserError, match=r"threshold\.csv: this file exists; remove it or choose another file"):
        command.body(config, tmp_path)


@pytest.mark.parametrize(
    ("rows", "given"), [(None, (0, None)), ("40:", (40, None)), (":700", (0, 700)), ("5:9", (5, 9)), (":", (0, None))]
)
def test_what_is_read_of_a_file_is_what_was_asked_for(rows, given, tmp_path, monkeypatch):
    monkeypatch.setattr(source, "read_recording", read := Mock(side_effect=RecordingError("enough")))
    config = CalibrateConfig(data="a.csv", rows=rows, run=2, reactor="M3", pump_ml_s=0.02, pumps=(1, 3))
    with pytest.raises(frame.UserError, match="^enough$"):
        command.body(config, tmp_path)
    words = {"run": 2, "reactor": "M3", "pump_ml_s": 0.02, "pumps": (1, 3)}
    read.assert_called_once_with("a.csv", rows=given, doses=None, columns={}, time_unit=None, **words)


def test_files_have_the_name_that_was_given_and_curves_the_numbers_of_each_segment(
    fitted: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second segment's tau is not known."""
    parts = (fitted.segments[0], replace(fitted.segments[0], middle_min=99.0, mu=Parameter(0.05, 0.04, 0.06), tau=None))
    parts = (replace(parts[0], mu=Parameter(0.03, 0.02, 0.04), tau=Parameter(0.3, 0.2, 0.5)), parts[1])
    found = replace(fitted, segments=parts)
    events = Mock()
    for figure in ("fit_figure", "drift_figure", "twin_figure"):
        monkeypatch.setattr(calibration_charts, figure, lambda *given, name=figure: name)
    monkeypatch.setattr(charts, "save", lambda figure, folder, key: (figure, folder))
    monkeypatch.setattr(tensorboard, "Events", lambda folder: events)
    monkeypatch.setattr(command, "calibrate", lambda raw, config, doubts: found)
    monkeypatch.setattr(command, "twin", lambda raw, result, segment_min: segment_min)
    monkeypatch.setattr(command, "twin_yaml", lambda behind, source: f"# {source}, {behind:g}\n")
    identify = replace(CalibrateConfig().identify, segment_min=75.0)
    assert command.body(CalibrateConfig(name="mine", identify=identify), tmp_path) == 1.25
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["env_file"] == f"{tmp_path}/mine.yaml"
    assert Path(content["data"]).name == "open_loop.csv"
    assert OmegaConf.load(tmp_path / "mine.yaml").tau == 0.4
    assert (tmp_path / "twin.yaml").read_text() == "# open_loop.csv, 75\n"
    assert not (tmp_path / "calibrated.yaml").exists()
    out = capsys.readouterr().out
    assert all(f"{tmp_path}/{name}.yaml" in out for name in ("mine", "twin"))
    results = {"mu_per_min": 0.02, "tau": 0.4, "pmse_pct": 1.25}
    assert [call.args for call in events.method_calls] == [
        ({f"calibration/{key}": value for key, value in results.items()}, 0),
        ({"drift/mu_per_min": 0.03, "drift/tau": 0.3}, 0), ({"drift/mu_per_min": 0.05}, 1),
        *((f"calibration/{key}", (f"{key}_figure", tmp_path / "figures"), 0) for key in ("fit", "drift", "twin")),
        (),
    ]  # fmt: skip


def test_a_study_returns_the_worse_share_of_both_and_says_each(fitted, tmp_path, monkeypatch):
    """Four recordings, one refused; mu is held by one of three intervals and tau by two."""
    protocol = OpenLoop(tau=0.4, hours=5.0, noise=0.02, seed=4)
    growth = np.array([0.02, 0.0175, 1.0, 0.024])
    found = [fitted, fitted, "flat", replace(fitted, tau=Parameter(0.5, 0.45, 0.55))]
    asked: list[int] = []
    empty = np.zeros((4, 1))
    monkeypatch.setattr(study, "simulated", lambda config, n: asked.append(n) or (empty[0], empty, empty, growth))
    monkeypatch.setattr(study, "fitted", lambda time, od, rate, config, bar=False: found)
    monkeypatch.setattr(calibration_charts, "coverage_figure", lambda mu, tau, truth, title: (mu[:, 0], truth, title))
    drawn: list[tuple[np.ndarray, tuple[np.ndarray, np.ndarray], str]] = []
    monkeypatch.setattr(charts, "save", lambda figure, folder, key: drawn.append(figure))
    config = CalibrateConfig(coverage=4, law="pi", protocol=protocol)
    assert command.body(config, tmp_path) == pytest.approx(100.0 / 3)
    assert asked == [4]
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["coverage_pct"] == pytest.approx({"mu": 100.0 / 3, "tau": 200.0 / 3})
    ((values, truth, _),) = drawn
    assert (values.tolist(), truth[0].tolist(), truth[1].tolist()) == ([0.02] * 3, [0.02, 0.0175, 0.024], [0.4] * 3)
    # half widths: 0.0025 of 0.02, and 0.045 of 0.4 twice beside 0.05 of 0.5
    assert content["relative_half_width_pct"] == pytest.approx({"mu": 12.5, "tau": 11.25})
