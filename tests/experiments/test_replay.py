"""A recording replayed: what is expected, decided and told, and that nothing acts."""

import json
from pathlib import Path

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from envs.bench import Bench
from envs.identification.calibration import calibrate
from envs.identification.screening import Series
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments import replay as command
from experiments.laws import registry
from experiments.laws.base import Controller
from experiments.loop.loop import ClosedLoop
from experiments.replay import ReplayConfig
from experiments.replays.figure import replay_figure
from experiments.replays.replay import replay
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.watched import WatchedInterlock

MODEL = EnvConfig()


def law() -> Controller:
    controller: Controller = registry.build(registry.config("inverse"), model=MODEL)
    return controller


def recorded(minutes: int = 300) -> tuple[Series, np.ndarray]:
    """What a controller did at OD 0.5, as a recording, and the temperatures."""
    plant = Plant(build(PlantConfig(), presets.load("plant/nominal_noise"), "plant"), 1, np.random.default_rng(3))
    loop = ClosedLoop(
        SimulatedReactors(plant, SimulatedConfig()), law(), Interlock(1), Scenario((0.5,), (1e4,), (37.0,))
    )
    steps = [loop.step() for _ in range(minutes)]
    od, rate, warm = (np.array([getattr(s, key)[0] for s in steps]) for key in ("od", "rate", "temperature"))
    return Series(np.arange(float(minutes)), od, rate, np.arange(minutes)), warm


def test_the_controller_that_made_a_recording_decides_as_it_did_and_its_filter_expects_what_came() -> None:
    series, warm = recorded()
    found = replay(series, warm, law(), WatchedInterlock(1, SafetyConfig()), 0.5, MODEL)
    np.testing.assert_allclose(found.decided_ml, 60.0 * series.pump_rate, atol=1e-9)
    for inside in (found.one, found.ten):
        assert 0.85 <= np.nanmean(inside) <= 1.0
    assert found.doses["both"] + found.doses["neither"] == pytest.approx(100.0)


@pytest.mark.parametrize("kind", ["inverse", "pi_tuned", "threshold"])
def test_doses_that_were_not_given_are_never_added_up(kind: str) -> None:
    """A culture that nobody feeds grows on; each decision is of one period, and the interlock only tells."""
    time = np.arange(200.0)
    fed = Series(time, 0.3 * np.exp(0.01 * time), np.zeros(200), np.arange(200))
    made = registry.build(registry.config(kind), model=MODEL)
    found = replay(fed, np.full(200, 37.0), made, WatchedInterlock(1, SafetyConfig()), 0.4, MODEL)
    assert found.decided_ml.max() <= 1.2 + 1e-9
    assert found.decided_ml[-20:].min() > 0.0
    assert found.given_ml.sum() == 0.0
    assert not any("undosed" in reason for reason in found.reasons)


def test_the_figure_draws_the_gain_in_per_cent_over_hours_and_each_dose_in_ml() -> None:
    """Rows 2 min apart: a constant rate decides twice the volume of a minute's."""
    time = 2.0 * np.arange(60)
    series = Series(time, 0.5 + 0.001 * np.arange(60) % 7, np.zeros(60), np.arange(60))
    made = registry.build(registry.config("hold"), model=MODEL)
    interlock = WatchedInterlock(1, SafetyConfig(), Bench(period_s=120.0))
    found = replay(series, np.full(60, 37.0), made, interlock, 0.5, MODEL)
    np.testing.assert_allclose(found.decided_ml[5:], 120.0 * MODEL.mu * MODEL.tau)
    axes = replay_figure(found, "").axes
    np.testing.assert_array_equal(axes[2].lines[0].get_xydata(), np.stack([time / 60.0, 100.0 * found.gain], 1))
    np.testing.assert_allclose(axes[3].lines[1].get_ydata(), found.decided_ml[found.decided_ml > 0.0])


def test_the_second_half_is_predicted_by_the_first_better_than_by_guesses() -> None:
    time = np.arange(600.0)
    rate = np.where(time % 77 < 26, 0.02, 0.0)
    volume = np.append(0.0, np.cumsum(rate[:-1]))
    od = 0.3 * np.exp(0.02 * time - 3.0 * volume + np.random.default_rng(0).normal(0.0, 0.005, 600))
    for ahead in calibrate(Series(time, od, rate, np.arange(600))).validation.ahead:
        assert ahead.model_pct < 1.5 < min(ahead.od_stays_pct, ahead.same_slope_pct)


@pytest.mark.slow
def test_the_page_opens_with_the_answer(tmp_path: Path) -> None:
    command.body(ReplayConfig(), tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert 90.0 <= summary["inside_pct"]["one"] <= 100.0
    assert sum(summary["doses_pct"].values()) == pytest.approx(100.0)
    assert summary["twin"]["mean_abs_error"] < 0.02
    page = (tmp_path / "report.html").read_text()
    assert page.index("95 % band") < page.index("<img")
