"""A run against its model: errors by hand, plants that left the model at a known time, plants that never did."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.identification.agreement import Agreement, Compared, agreement
from envs.identification.model import Parameter
from envs.identification.screening import Series
from envs.plant.culture import GrowthConfig
from envs.plant.plant import PlantConfig
from envs.plant.pump import PumpConfig
from envs.plant.sensor import SensorConfig
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig
from tests.envs.test_twin import controlled

pytestmark = pytest.mark.numeric

Array = NDArray[np.float64]

MODEL = (0.03, 1.0 / 3.0)
SOUND = PlantConfig(
    pump=PumpConfig(dosing="pulse", pulse_cv=0.1),
    sensor=SensorConfig(noise_floor=0.0033, noise_relative=0.003, lag1=0.12),
)
GOALS = (0.8, 0.65, 0.5, 0.7)


def runs(config: PlantConfig, hours: float, n: int = 4, seed: int = 3) -> list[Series]:
    """Recordings of n vials under the device's PI, with a setpoint of its own for each quarter."""
    time, od, rate = controlled(config, ChiBioPI(ChiBioPIConfig()), GOALS, seed, n, round(60.0 * hours))
    return [Series(time, y, u, np.arange(time.size)) for y, u in zip(od, rate, strict=True)]


def compared(config: PlantConfig, hours: float, n: int = 4) -> list[Agreement]:
    return [agreement(series, *MODEL) for series in runs(config, hours, n)]


def test_the_next_reading_is_what_the_model_makes_of_this_one() -> None:
    series = runs(SOUND, 2.0, n=1)[0]
    found = agreement(series, *MODEL)
    assert np.isnan(found.predicted[0])
    for i in (3, 60, 119):
        by_hand = series.od[i] * np.exp(0.03 - 3.0 * series.pump_rate[i])
        assert found.predicted[i + 1] == pytest.approx(by_hand)
    error = series.od[1:] - found.predicted[1:]
    assert found.rms == pytest.approx(np.sqrt(np.nanmean(error**2)))


@pytest.mark.parametrize("hours", [1.5, pytest.param(8.0, marks=pytest.mark.slow)])
def test_a_model_that_holds_is_left_alone(hours: float) -> None:
    for found in compared(SOUND, hours, 20):
        assert found.verdict().startswith("No need to recalibrate: the model held to the end of the run")
        assert found.attainable == pytest.approx(found.rms, rel=0.02)


def test_growth_that_rises_is_told_from_the_hour_on_at_which_it_matters() -> None:
    """By 4 % an hour: 10 % are reached after 2.5 h, in the second segment of two hours; at the end it is 32 %."""
    for found in compared(replace(SOUND, growth=GrowthConfig(ramp_per_h=0.04)), 8.0):
        assert found.net.left_min in (120.0, 240.0)
        assert found.net.latest is not None
        assert found.net.latest.value == pytest.approx(0.03 * 0.04 * 7.0, rel=0.15)  # mean of the last two hours
        assert found.verdict().startswith("Recalibrate: ")
        unused = found.verdict(planned=False)
        assert unused.startswith("This run needs no calibration, and its culture is not the model: ")
        assert unused.endswith(found.verdict().removeprefix("Recalibrate"))
        assert "the predicted net growth is off by 10 % or more since hour " in found.verdict()
        assert found.attainable < 0.95 * found.rms


@pytest.mark.parametrize(("flow", "sign"), [(0.7, 1.0), (1.4, -1.0)])
def test_a_pump_of_another_flow_is_told_throughout(flow: float, sign: float) -> None:
    for found in compared(replace(SOUND, pump=replace(SOUND.pump, gain_ml_s=flow)), 6.0):
        assert found.net.left_min == 0.0
        assert all(p is not None and sign * p.value > 0.0 for p in found.net.found)
        gains = [p for p in found.gain.found if p is not None]
        assert np.median([p.value for p in gains]) == pytest.approx(flow, rel=0.15)
        assert all(p.low < p.value < p.high for p in gains)
        assert sum(p.low <= flow <= p.high for p in gains) >= len(gains) - 1  # one in twenty is wrong by chance


def test_net_growth_is_per_minute_also_where_rows_are_two_minutes_apart() -> None:
    """A culture left to itself grows by .004/min where the model says .003: a third of its growth is missed."""
    time = np.arange(0.0, 300.0, 2.0)
    noise = 1.0 + 0.003 * np.random.default_rng(5).standard_normal(time.size)
    grown = Series(time, 0.3 * np.exp(0.004 * time) * noise, np.zeros(time.size), np.arange(time.size))
    found = agreement(grown, 0.003, 1.0 / 3.0)
    for net in found.net.found:
        assert net is not None
        assert net.value == pytest.approx(0.001, abs=1e-4)
        assert net.low < 0.001 < net.high
    assert found.net.left_min == 0.0
    assert found.net.latest is not None
    assert found.net.off_pct(found.net.latest) == pytest.approx(33.3, abs=4.0)


def test_a_short_run_says_that_it_is_too_short() -> None:
    for found in compared(replace(SOUND, growth=GrowthConfig(mu=0.05)), 0.75):
        assert found.verdict() == "Too short to tell: 45 min of trustworthy readings, at least 60 are needed."


def test_nothing_is_predicted_across_a_pause() -> None:
    series = runs(SOUND, 6.0, n=1)[0]
    kept = (series.time < 150.0) | (series.time >= 200.0)
    od = np.where(series.time < 200.0, series.od, 0.6 * series.od)  # diluted by hand, and watched again
    paused = Series(series.time[kept], od[kept], series.pump_rate[kept], series.row[kept])
    found = agreement(paused, *MODEL)
    assert found.net.left_min is None
    assert found.rms < 0.01


def told(name: str, expected: float, scale: float, off_pct: int | None) -> Compared:
    """A parameter that is off by some per cent of its scale in each of three segments; None: unknown."""
    value = None if off_pct is None else Parameter(*(expected + scale * (off_pct + d) / 100 for d in (0, -2, 2)))
    return Compared(name, (0.0, 120.0, 240.0), (120.0, 240.0, 360.0), (value,) * 3, expected, scale)


def test_the_verdict_names_what_is_off_and_in_which_direction() -> None:
    """Growth by 20 %, the pump's gain by 30 %, net growth by 40 %: each up, down, not at all or unknown."""
    sizes = {"growth": (0.03, 0.03, 20), "the pump's gain": (1.0, 1.0, 30), "the predicted net growth": (0.0, 0.03, 40)}
    nothing = Series(*(np.zeros(0),) * 3, np.zeros(0, dtype=np.int64))
    for signs in product((None, -1, 0, 1), (None, -1, 0, 1), (-1, 0, 1)):
        offs = [None if sign is None else sign * size[2] for sign, size in zip(signs, sizes.values(), strict=True)]
        growth, gain, net = (told(name, *sizes[name][:2], off) for name, off in zip(sizes, offs, strict=True))
        verdict = Agreement(nothing, growth, gain, net, np.zeros(0), 0.1, 0.1, 360.0).verdict()
        said = re.findall(r"[:;] ([a-z' ]+) is off by 10 % or more throughout, by ([+-]\d+) %", verdict)
        assert sorted(said) == sorted((name, f"{off:+d}") for name, off in zip(sizes, offs, strict=True) if off)
        open_question = signs[2] if not (signs[0] or signs[1]) else 0  # answered where growth or gain is off
        directions = {1: {"faster", "weaker"}, -1: {"slower", "stronger"}, 0: set[str]()}
        assert set(re.findall("faster|slower|weaker|stronger", verdict)) == directions[open_question]


@pytest.mark.parametrize(
    ("found", "left"),
    [
        ([(1.0, 0.1)] * 3, None),
        ([(1.0, 0.1), (1.3, 0.1), (1.3, 0.1)], 120.0),
        ([(1.3, 0.1), (1.3, 0.1), (1.0, 0.1)], None),  # it came back
        ([(1.0, 0.1), (1.0, 0.1), (1.3, 0.1)], None),  # one alone
        ([(1.0, 0.1), (1.3, 0.4), (1.3, 0.1)], None),  # the interval holds 1
        ([(1.0, 0.1), (1.05, 0.01), (1.08, 0.01)], None),  # too little to matter
        ([(0.8, 0.1), None, (0.7, 0.1)], 0.0),
        ([None, None, None], None),
    ],
)
def test_a_value_is_left_where_segments_in_a_row_say_so(
    found: list[tuple[float, float] | None], left: float | None
) -> None:
    parameters = tuple(None if f is None else Parameter(f[0], f[0] - f[1], f[0] + f[1]) for f in found)
    given = Compared("gain", (0.0, 120.0, 240.0), (120.0, 240.0, 360.0), parameters, 1.0, 1.0)
    assert given.left_min == left


def test_one_segment_of_predictions_is_enough() -> None:
    given = Compared("net", (0.0, 120.0), (120.0, 240.0), (Parameter(0, -1, 1), Parameter(4, 3, 5)), 0.0, 30.0, 1)
    assert given.left_min == 120.0


@pytest.mark.slow
def test_the_interval_of_a_mean_error_allows_for_noise_that_is_in_two_errors() -> None:
    """Two hundred segments of a sound vial: the interval holds 0 as often as it says, and is narrow."""
    held, half = [], []
    for series in runs(SOUND, 10.0, n=40):
        net = agreement(series, *MODEL).net
        held += [p.low <= 0.0 <= p.high for p in net.found if p is not None]
        half += [p.half_width for p in net.found if p is not None]
    assert len(held) == 200
    assert 0.9 <= np.mean(held) <= 1.0
    assert np.median(half) < 0.05 * 0.03
