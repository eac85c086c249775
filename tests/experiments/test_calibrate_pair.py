"""Two species from recordings of each alone, against plants whose curves are known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.coculture.pair import PairConfig, PigmentConfig, SpeciesConfig, named_pair
from envs.coculture.second import of_pair
from envs.identification import curves
from envs.identification.model import Parameter
from envs.identification.screening import Series
from envs.plant.plant import Plant
from experiments import calibrate_pair as command
from experiments.calibrate_pair import CalibratePairConfig, _growth, _pigment, _plateaus, _say, calibrate_pair
from experiments.cli import frame
from experiments.coculture import charts as composition_charts
from experiments.reporting import charts
from hardware.storage.marks import Mark, add_mark
from tests.envs.test_plant import preset

pytestmark = pytest.mark.numeric

TRUE = PairConfig(
    SpeciesConfig("alpha", (0.06, -1.1)), SpeciesConfig("beta", (-0.01, 0.6, -8.1), (), 60.0),
    PigmentConfig((-100.0, 4000.0), 31.0), (27.0, 35.0),
)  # fmt: skip
HOURS = {27.5: 6.5, 30.0: 6.0, 32.5: 5.5, 35.0: 7.0}


def recorded(
    path: Path, share: float, program: dict[float, float] = HOURS, *, pair: PairConfig = TRUE, seed: int = 0,
    gain: float = 1.0, factor: float = 1.0, volume_ml: float = 20.0, every: int = 1,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """A culture that is thinned from .55 to .45, at each temperature for some hours: minutes and true shares.

    A row, and a dose, every so many minutes.
    """
    config = of_pair(preset("coculture"), pair)
    config = replace(config, second=replace(config.second, start_share=(share, share)))
    config = replace(config, pump=replace(config.pump, gain_ml_s=gain, pulse_cv=0.1))
    config = replace(config, fluorescence=replace(config.fluorescence, factor=(factor, factor)))
    plant = Plant(config, 1, np.random.default_rng(seed), volume_ml)
    plant.reset(0.5, temperature=next(iter(program)))
    on, lines, minute, shares = False, ["time_min,od,pump_rate_ml_s,temperature_degc,fluorescence"], 0, []
    for target, hours in program.items():
        for _ in range(round(60 * hours / every)):
            od = float(plant.read_od()[0])
            on = od > 0.55 or (on and od > 0.45)
            light = float(plant.read_fluorescence()[0]) if plant.fluorescence is not None else float("nan")
            warm, rate = float(plant.thermal.read()[0]), 0.001 * volume_ml * on
            lines.append(f"{minute},{od:.5f},{rate},{warm:.3f},{'' if np.isnan(light) else f'{light:.1f}'}")
            shares.append((minute, plant.culture.share[0]))
            plant.advance(float(every), np.array([60.0 * every * rate]), temperature_target=target)
            minute += every
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    found = np.array(shares)
    return found[:, 0], found[:, 1]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("alone")
    recorded(folder / "a.csv", 0.0)
    recorded(folder / "b.csv", 1.0, seed=1)
    return str(folder / "a.csv"), str(folder / "b.csv")


@pytest.mark.slow
def test_shares_that_were_counted_in_a_mixed_run_correct_the_curves(tmp_path: Path) -> None:
    """The mixed culture grows by other rates than each alone: the second by a tenth less. A row every 2 min, 12 mL."""
    true = replace(TRUE, second=replace(TRUE.second, polynomial=tuple(0.9 * c for c in TRUE.second.polynomial)))
    run, volume = tmp_path / "run", 12.0
    program = {29.0: 8.0, 34.0: 6.0, 29.5: 10.0}
    minutes, shares = recorded(
        run / "recordings" / "M0.csv", 0.6, program, pair=true, seed=3, volume_ml=volume, every=2
    )
    recorded(tmp_path / "a.csv", 0.0, volume_ml=volume)
    recorded(tmp_path / "b.csv", 1.0, seed=1, volume_ml=volume)
    plain = CalibratePairConfig(
        (f"{tmp_path}/a.csv",), (f"{tmp_path}/b.csv",), factor=1.0, volume_ml=volume, mixed=f"{run}/recordings/M0.csv"
    )
    with pytest.raises(frame.UserError, match="no marked share for M0"):
        calibrate_pair(plain, tmp_path)
    (run / "marks.csv").write_text("time_min,reactor,text,written,level_ml,share,sd\n7,M0,counted,,,0.4,0\n")
    with pytest.raises(frame.UserError, match="share 0.4 at minute 7 has no sd above 0"):
        calibrate_pair(plain, tmp_path)
    (run / "marks.csv").unlink()
    rng = np.random.default_rng(0)
    for minute, share in list(zip(minutes, shares, strict=True))[100::120]:
        add_mark(run, Mark(minute, "M0", "counted", None, float(share + 0.02 * rng.standard_normal()), 0.02))
        add_mark(run, Mark(minute, "M1", "counted", None, 0.05, 0.01))  # of another culture
    calibrate_pair(plain, tmp_path)
    told = json.loads((tmp_path / "summary.json").read_text())["mixed"]
    less = (1.0 + told["second"]) / (1.0 + told["first"])
    assert less == pytest.approx(0.9, abs=0.04)
    for which, true_error in (("first", 0.0), ("second", -0.1)):
        assert told[which] == pytest.approx(true_error, abs=3.0 * told[f"{which}_sd"])
    assert told["first_sd"] != told["second_sd"]
    pair = named_pair(str(tmp_path / "pair.yaml"))
    assert pair.even_c == pytest.approx(true.even_c, abs=0.25)


@pytest.mark.slow
def test_a_mixed_run_leaves_curves_alone_that_are_right(alone: tuple[str, str], tmp_path: Path) -> None:
    """A thermometer that is as it was, and counts with noise: the crossing stays."""
    minutes, shares = recorded(
        tmp_path / "run" / "recordings" / "M0.csv", 0.4, {29.0: 8.0, 34.0: 6.0, 29.5: 10.0}, seed=5
    )
    rng = np.random.default_rng(1)
    for minute, share in list(zip(minutes, shares, strict=True))[100::150]:
        add_mark(tmp_path / "run", Mark(minute, "M0", "", None, float(share + 0.02 * rng.standard_normal()), 0.02))
    even: dict[bool, float] = {}
    for mixed in (None, f"{tmp_path}/run/recordings/M0.csv"):
        calibrate_pair(CalibratePairConfig((alone[0],), (alone[1],), factor=1.0, mixed=mixed), tmp_path)
        told = json.loads((tmp_path / "summary.json").read_text())
        even[mixed is None] = told["even_c"]
    assert told["mixed"]["first_sd"] < 0.0095  # a thermometer that might be off as well leaves .011
    assert even[False] == pytest.approx(even[True], abs=0.08)
    assert even[False] == pytest.approx(TRUE.even_c, abs=0.15)


def test_what_is_left_out_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorded(tmp_path / "a.csv", 0.0, {27.5: 4.0, 29.0: 2.5, 31.0: 3.6, 34.5: 3.6})
    for config, said in (
        (CalibratePairConfig(), r"first=\[\]: give one or more recordings"),
        (CalibratePairConfig((f"{tmp_path}/a.csv",), ("none.csv",)), r"none\.csv"),
    ):
        with pytest.raises(frame.UserError, match=said):
            calibrate_pair(config, tmp_path)
    assert "a.csv: ignored: 29.0 degC from minute" in caplog.text
    assert "at least 180 are needed" in caplog.text


@pytest.mark.slow
def test_other_sensor_other_pump_other_period_other_temperatures(tmp_path: Path) -> None:
    """A factor of .7, rows every 2 min, and the second species over a narrower range than the first.

    A pump that gives a tenth more than it is thought to scales both curves and leaves where they cross.
    """
    recorded(tmp_path / "a.csv", 0.0, every=2, gain=1.1)
    narrow = {28.5: 5.5, 31.0: 6.0, 34.0: 6.5}
    recorded(tmp_path / "b.csv", 1.0, narrow, seed=1, factor=0.7, every=2, gain=1.1)
    calibrate_pair(CalibratePairConfig((f"{tmp_path}/a.csv",), (f"{tmp_path}/b.csv",), factor=0.7), tmp_path)
    pair = named_pair(str(tmp_path / "pair.yaml"))
    assert pair.temperatures == pytest.approx((28.5, 34.0), abs=0.11)
    t = np.array([29.0, 31.0, 33.5])
    np.testing.assert_allclose(pair.rates(t), TRUE.rates(t) / 1.1, rtol=0.05)
    np.testing.assert_allclose(pair.production(t), TRUE.production(t) / 1.1, rtol=0.06)
    assert pair.even_c == pytest.approx(TRUE.even_c, abs=0.25)
    plateaus = json.loads((tmp_path / "summary.json").read_text())["plateaus"]
    assert len(plateaus[1]) == 3
    assert (tmp_path / "figures" / "pair.png").is_file()


def test_light_is_that_of_the_last_hour_whatever_the_period() -> None:
    """Four hours at one temperature, a row every 3 min; the light per OD rises by 1 a minute."""
    minutes = np.arange(0.0, 360.0, 3.0)
    od, none = 0.5 * np.exp(0.001 * minutes), np.zeros(minutes.size)
    series = Series(minutes, od, none, np.arange(minutes.size))
    light = 50.0 + od * (1000.0 + minutes)
    (found,), _ = curves.plateaus(series, np.full(minutes.size, 31.0), light, 1.0 / 3.0, 120.0, 90.0, 50.0)
    assert found.light is not None
    assert found.light.value == pytest.approx(1000.0 + 357.0 - 30.0, abs=2.0)
    assert found.growth.value == pytest.approx(0.06, rel=0.01)


def test_a_weighted_polynomial_goes_through_what_is_known_best() -> None:
    t, value = np.array([28.0, 30.0, 32.0, 34.0]), np.array([0.4, 0.5, 0.9, 0.7])
    found = curves.fit(t, value, np.array([0.01, 0.01, 10.0, 0.01]), 1)
    np.testing.assert_allclose(found.coefficients, [0.05, -1.0], atol=1e-4)
    assert found.off[2] == pytest.approx(0.03, abs=1e-3)
    exact = curves.fit(t, value, np.full(4, 0.1), 3, 31.0)
    np.testing.assert_allclose(np.polyval(exact.coefficients, t - 31.0), value, atol=1e-9)


def at(degc: float, growth: float, half: float = 0.01, light: float | None = None) -> curves.Plateau:
    lit = None if light is None else Parameter(light, light, light)
    return curves.Plateau(degc, Parameter(growth, growth - half, growth + half), lit, 0, 1)


def test_production_is_what_balances_dilution_by_hand() -> None:
    """g = mu ((light per OD) / k - light that any cell scatters), with a factor k of .7 and much scattered light."""
    t, growth, light = np.array([28.0, 31.0, 34.0]), np.array([0.5, 0.8, 0.6]), np.array([4000.0, 3000.0, 2000.0])
    points = [at(*point) for point in zip(t, growth, (0.0,) * 3, light, strict=True)]
    found = _pigment(points, CalibratePairConfig(factor=0.7, od_term=900.0))
    np.testing.assert_allclose(found.steady(t), growth * (light / 0.7 - 900.0), rtol=1e-9)


def test_points_count_by_their_own_band_and_by_how_far_cultures_differ() -> None:
    """sd of 1/1.96 of half the band and of 2 % of the rate together; a line through four points."""
    points = [at(28.0, 0.4, 0.01), at(30.0, 0.5, 0.05), at(32.0, 0.7, 0.002), at(34.0, 0.7, 0.02)]
    found = _growth("alpha", points, 2.0, CalibratePairConfig(degree=1))
    t, value = np.array([28.0, 30.0, 32.0, 34.0]), np.array([0.4, 0.5, 0.7, 0.7])
    sd = np.sqrt((np.array([0.01, 0.05, 0.002, 0.02]) / 1.96) ** 2 + (0.02 * value) ** 2)
    w = 1.0 / sd**2
    mean = (w * t).sum() / w.sum(), (w * value).sum() / w.sum()
    slope = (w * (t - mean[0]) * (value - mean[1])).sum() / (w * (t - mean[0]) ** 2).sum()
    np.testing.assert_allclose(found.coefficients, [slope, mean[1] - slope * mean[0]], rtol=1e-6)
    np.testing.assert_allclose(found.off, (value - mean[1] - slope * (t - mean[0])) / sd, rtol=1e-6)


def test_too_few_temperatures_are_told_of_the_species_with_the_minutes_that_its_own_lag_asks_for(caplog):
    """Four lags of 60 min and an hour behind them; 30.2 and 30.4 degC are one temperature."""
    few = [at(30.2, 0.5), at(30.4, 0.5), at(33.0, 0.6)]
    for lag, minutes in ((60.0, 300), (2.0, 180)):
        with pytest.raises(frame.UserError, match=rf"^beta: growth at 2 temperature\(s\); .* for {minutes} min"):
            _growth("beta", few, lag, CalibratePairConfig())
    config = CalibratePairConfig(settle_min=200.0, least_min=45.0)
    with pytest.raises(frame.UserError, match="held for 245 min"):
        _growth("beta", few, 2.0, config)
    assert caplog.text == ""
    exact = _growth("beta", [*few, at(35.0, 0.9)], 2.0, CalibratePairConfig(degree=4))
    assert len(exact.coefficients) == 3
    assert "beta: the curve meets all 3 points: its error is unknown; record more temperatures" in caplog.text


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        (["", ""], "no temperatures; give a recording with a column temperature_degc"),
        (["303", "300"], "temperatures from 300 to 303: allowed 4 to 60 degC; "),
        (["3.9", "31"], "temperatures from 3.9 to 31"), (["60.5", "31"], "temperatures from 31 to 60.5"),
    ],
)  # fmt: skip
def test_a_recording_whose_temperatures_cannot_be_is_named(cells: list[str], said: str, tmp_path: Path) -> None:
    path = tmp_path / "b.csv"
    rows = "".join(f"{k},0.5,0.001,{cells[k % 2]}\n" for k in range(400))
    path.write_text(f"time_min,od,pump_rate_ml_s,temperature_degc\n{rows}")
    with pytest.raises(frame.UserError, match=rf"b\.csv: {said}"):
        _plateaus((str(path),), 2.0, CalibratePairConfig())


def test_the_screen_says_of_each_species_its_own_points_and_who_gains_where(tmp_path, capsys):
    """0.06 T - 1.1 and -0.01 T^2 + 0.6 T - 8.1: at 27 degC 0.52 and 0.81 1/h, at 35 degC 1.0 and 0.65."""
    points = [[at(27.0, 0.52), at(35.0, 1.0, 0.02)], [at(28.0, 0.86, 0.03, 4100.0)]]
    found = [curves.Polynomial((1.0,), np.array([0.25, -1.5])), curves.Polynomial((1.0,), np.array([2.0]))]
    told = {"first": 0.021, "first_sd": 0.004, "second": -0.104, "second_sd": 0.012, "even_c_alone": 32.126}
    _say(CalibratePairConfig(names=("alpha", "beta")), TRUE, points, found, told, tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "alpha: temperature in degC, growth rate in 1/h (95 % interval), distance from the curve in sds"
    assert lines[1:3] == ["   27.00  0.5200 (0.5100 to 0.5300)  +0.2", "   35.00  1.0000 (0.9800 to 1.0200)  -1.5"]
    assert lines[4] == "   28.00  0.8600 (0.8300 to 0.8900)  +2.0   light per OD 4100"
    assert lines[5] == "mixed: curves corrected by +0.021 +- 0.004 and -0.104 +- 0.012; before, they met at 32.13 degC"
    crossing = (0.54 + np.sqrt(0.54**2 - 4 * 0.01 * 7.0)) / 0.02  # of the two curves, within 27 to 35 degC
    gains = "growth of beta minus alpha: +0.290 1/h at 27 degC and -0.350 1/h at 35 degC"
    assert lines[6] == f"both grow alike at {crossing:.2f} degC; {gains}"
    assert lines[7] == f"files {tmp_path}/pair.yaml, {tmp_path}/figures/pair.png"


def test_a_pair_holds_where_both_were_recorded_and_says_by_what(tmp_path, monkeypatch, capsys):
    """Points on both true curves, the second's over less than the first's; to a tenth of a degree within both."""
    linear, parabola = np.poly1d([0.06, -1.1]), np.poly1d([-0.01, 0.6, -8.1])
    first = [at(t, float(linear(t))) for t in (27.43, 30.0, 33.0, 35.08)]
    second = [at(t, float(parabola(t)), 0.01, 4000.0) for t in (28.51, 30.5, 32.5, 34.97)]
    read: list[tuple[object, ...]] = []

    def plateaus(paths: tuple[str, ...], lag: float, config: CalibratePairConfig) -> list[curves.Plateau]:
        read.append((paths, lag))
        return first if paths == ("a.csv", "c.csv") else second

    monkeypatch.setattr(command, "_plateaus", plateaus)
    monkeypatch.setattr(composition_charts, "pair_figure", lambda pair, points: "drawn")
    saved: list[tuple[object, ...]] = []
    monkeypatch.setattr(charts, "save", lambda *given: saved.append(given))
    config = CalibratePairConfig(("a.csv", "c.csv"), ("b.csv",), ("alpha", "beta"), lags_min=(5.0, 40.0))
    calibrate_pair(config, tmp_path)
    assert read == [(("a.csv", "c.csv"), 5.0), (("b.csv",), 40.0)]
    assert saved == [("drawn", tmp_path / "figures", "pair")]
    pair = named_pair(str(tmp_path / "pair.yaml"))
    assert pair.temperatures == (28.6, 34.9)
    assert (pair.first.name, pair.first.lag_min, pair.second.name, pair.second.lag_min) == ("alpha", 5.0, "beta", 40.0)
    told = json.loads((tmp_path / "summary.json").read_text())
    crossing = (0.54 + np.sqrt(0.54**2 - 4 * 0.01 * 7.0)) / 0.02
    assert told["even_c"] == pytest.approx(crossing, abs=1e-3)
    assert [[p["temperature"] for p in mine] for mine in told["plateaus"]] == [
        [27.43, 30.0, 33.0, 35.08], [28.51, 30.5, 32.5, 34.97],
    ]  # fmt: skip
    np.testing.assert_allclose(told["off_sd"], np.zeros((2, 4)), atol=1e-6)
    assert told["mixed"] is None
    assert "mixed" not in capsys.readouterr().out
    first[:] = [at(t, float(linear(t))) for t in (24.0, 26.0, 28.1)]
    with pytest.raises(frame.UserError, match=r"^alpha at 24\.0 to 28\.1 degC and beta at 28\.5 to 35\.0 "):
        calibrate_pair(config, tmp_path)
    for wrong, said in (
        ({"names": ("x", "x")}, "names = .*: allowed two different names"),
        ({"names": ("x",)}, "names = .*: allowed two values, one for each species"),
        ({"lags_min": (60.0, 2.0)}, "lags_min = .*: allowed 0 to 600 min, the smaller one first"),
        ({"lags_min": (0.0, 601.0)}, "lags_min = .*: allowed 0 to 600 min"),
    ):
        with pytest.raises(ValueError, match=said):
            CalibratePairConfig(**wrong)
    assert CalibratePairConfig(lags_min=(600.0, 600.0)).lags_min == (600.0, 600.0)
