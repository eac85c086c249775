"""The plant against formulas: training model, mass balances, pump, temperature, faults, and its random streams."""

from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from conf import presets
from conf.schema import build
from envs.integrators import euler
from envs.plant.culture import GrowthConfig
from envs.plant.plant import Plant, PlantConfig
from envs.plant.pump import PumpConfig
from envs.plant.sensor import SensorConfig
from envs.plant.thermal import ThermalConfig
from envs.plant.vessel import VesselConfig

Array = NDArray[np.float64]

PRESETS = sorted(p.stem for p in (Path(str(resources.files("conf"))) / "plant").glob("*.yaml"))
PULSE = PumpConfig(dosing="pulse")


SMALL = PlantConfig(vessel=VesselConfig(capacity_ml=20.0))


def preset(name: str) -> PlantConfig:
    return build(PlantConfig(), presets.load(f"plant/{name}"))


def plant(config: PlantConfig, n: int = 1, seed: int = 0) -> Plant:
    return Plant(config, n, np.random.default_rng(seed))


def test_nominal_is_the_training_model() -> None:
    n, rng = 32, np.random.default_rng(5)
    od = rng.uniform(0.1, 1.1, n)
    p = plant(preset("nominal"), n)
    p.reset(od)
    for _ in range(100):
        u = rng.choice(np.linspace(0.0, 0.02, 17), n)
        p.advance(1.0, 60.0 * u)
        od = euler(lambda x, u=u: (0.03 - 3.0 * u) * x, od, 1.0, 10)  # type: ignore[misc]
        np.testing.assert_allclose(p.culture.od, od, rtol=1e-13)
    np.testing.assert_array_equal(p.read_od(), p.culture.od)
    np.testing.assert_array_equal(p.vessel.volume_ml, 20.0)


@pytest.mark.parametrize("minutes", [0.5, 1.0, 1.5, 4.5])
def test_an_even_feed_dilutes_as_fast_in_an_interval_of_any_length(minutes: float) -> None:
    """x' = (mu - u / tau) x at 0.02 mL/s: 0.06 1/min are washed out while 0.03 grow."""
    p = plant(PlantConfig(integrator="rk4"), 2)
    p.reset(np.array([0.5, 0.3]))
    p.advance(minutes, 60.0 * minutes * np.array([0.02, 0.0]))
    np.testing.assert_allclose(p.culture.od, [0.5 * np.exp(-0.03 * minutes), 0.3 * np.exp(0.03 * minutes)], rtol=1e-7)


def test_without_waste_the_dose_stays_in_the_vial() -> None:
    p = plant(PlantConfig(pump=PULSE, growth=GrowthConfig(mu=0.0)))
    p.advance(1.0, np.array([2.0]), np.array([0.0]))
    assert p.culture.od[0] == pytest.approx(0.5 * 20.0 / 22.0)
    assert p.vessel.volume_ml[0] == pytest.approx(22.0)
    p.advance(1.0, np.array([0.0]), np.array([1.5]))  # the waste pump takes culture: OD unchanged
    assert p.vessel.volume_ml[0] == pytest.approx(20.5)
    p.advance(1.0, np.array([0.0]), np.array([60.0]))  # and never below its tube
    assert p.vessel.volume_ml[0] == pytest.approx(20.0)
    assert p.culture.od[0] == pytest.approx(0.5 * 20.0 / 22.0)


def test_blocked_waste_overflows_after_the_minutes_the_rim_allows() -> None:
    p = plant(PlantConfig(pump=PULSE), 2)
    p.vessel.waste_gain_factor[1] = 0.0
    first = 0
    for minute in range(1, 13):
        p.advance(1.0, np.array([1.2, 1.2]))
        if p.vessel.overflowed[1] and not first:
            first = minute
    assert first == 9  # 10 mL of room at 1.2 mL per minute
    np.testing.assert_array_equal(p.vessel.overflowed, [False, True])
    assert p.vessel.volume_ml[1] == 30.0
    p.vessel.waste_gain_factor[1] = 1.0  # repaired: what was spilt stays spilt, until the vial is another one
    p.advance(1.0, np.zeros(2), np.full(2, 60.0))
    np.testing.assert_allclose(p.vessel.volume_ml, 20.0)
    np.testing.assert_array_equal(p.vessel.overflowed, [False, True])
    p.reset(0.5)
    assert not p.vessel.overflowed.any()


def test_an_overflow_guard_keeps_the_level_where_its_tube_ends() -> None:
    """Three vials with blocked waste: a guard that is on, one that is blocked, one that is too slow."""
    p = plant(PlantConfig(pump=PULSE, growth=GrowthConfig(mu=0.0)), 3)
    p.vessel.waste_gain_factor[:] = 0.0
    p.vessel.overflow_gain_factor[:] = [1.0, 0.0, 0.1]
    for _ in range(8):
        p.advance(1.0, np.full(3, 1.5), np.full(3, 15.0), overflow_s=6.3)
    assert p.vessel.volume_ml == pytest.approx(
        [22.0, 30.0, 22.0 + 8 * (1.5 - 0.63) - (2.0 / 1.5) * (1.5 - 0.63)], abs=0.5
    )
    np.testing.assert_array_equal(p.vessel.overflowed, [False, True, False])


def test_above_its_tube_the_guard_exchanges_what_is_fed_and_below_it_takes_nothing() -> None:
    p = plant(PlantConfig(pump=PULSE, growth=GrowthConfig(mu=0.0)))
    p.advance(1.0, np.array([1.0]), np.array([0.0]), overflow_s=60.0)  # from 20 to 21 mL: nothing to take yet
    assert p.vessel.volume_ml[0] == pytest.approx(21.0)
    assert p.culture.od[0] == pytest.approx(0.5 * 20.0 / 21.0)
    p.advance(1.0, np.array([3.0]), np.array([0.0]), overflow_s=60.0)  # fills 1 mL to the tube, the rest is exchanged
    assert p.vessel.volume_ml[0] == pytest.approx(22.0)
    assert p.culture.od[0] == pytest.approx(0.5 * 20.0 / 22.0 * np.exp(-2.0 / 22.0))
    p.advance(1.0, np.array([4.0]), np.array([0.0]))  # without it the level rises
    assert p.vessel.volume_ml[0] == pytest.approx(26.0)
    od = p.culture.od[0]
    p.advance(1.0, np.array([0.0]), np.array([0.0]), overflow_s=3.0)  # it takes culture: OD unchanged
    assert (p.vessel.volume_ml[0], p.culture.od[0]) == (pytest.approx(23.0), pytest.approx(od))
    p.advance(1.0, np.array([0.0]), np.array([30.0]), overflow_s=30.0)  # the waste tube is the lower one
    assert p.vessel.volume_ml[0] == pytest.approx(20.0)


def test_chemostat_settles_where_monod_says() -> None:
    g = GrowthConfig(mu=0.03, yield_od=3.0, k_s=0.2)
    p = plant(PlantConfig(growth=g))
    for _ in range(2000):
        p.advance(1.0, np.array([0.4]))
    dilution = 0.4 / 20.0
    s = dilution * g.k_s / (g.mu * (1.0 + g.k_s) - dilution)  # mu_max = mu (1 + k_s)
    assert p.culture.substrate[0] == pytest.approx(s, rel=1e-6)
    assert p.culture.od[0] == pytest.approx(3.0 * (1.0 - s), rel=1e-6)


def test_cooling_is_passive_and_heating_fast() -> None:
    p = plant(PlantConfig())
    p.advance(31.0, np.zeros(1), temperature_target=30.0)
    p.advance(30.0, np.zeros(1), temperature_target=float("nan"))
    assert p.thermal.temperature[0] == 30.0  # nan leaves the target
    p.advance(5.0, np.zeros(1), temperature_target=37.0)
    assert p.thermal.temperature[0] == 37.0
    p.advance(600.0, np.zeros(1), temperature_target=0.0)
    assert p.thermal.temperature[0] == pytest.approx(24.0, abs=1e-3)


def test_the_thermostat_goes_by_its_thermometer_and_cells_by_the_truth() -> None:
    warm = GrowthConfig(temperature_law="arrhenius")
    p = plant(PlantConfig(growth=warm, thermal=ThermalConfig(offset_c=(-0.5, 0.7))), n=8)
    offset = p.draws["thermometer_offset"]
    assert -0.5 <= offset.min() < -0.1
    assert 0.1 < offset.max() <= 0.7
    np.testing.assert_allclose(p.thermal.read(), 37.0)
    for target, minutes in ((35.0, 30.0), (36.0, 1.0)):
        p.advance(minutes, np.zeros(8), temperature_target=target)
        np.testing.assert_allclose(p.thermal.read(), target, atol=1e-9)
        np.testing.assert_allclose(p.thermal.temperature, target - offset, atol=1e-9)
    before = p.culture.od.copy()
    p.advance(1.0, np.zeros(8))
    faster = np.log(p.culture.od / before)
    assert (np.diff(faster[np.argsort(offset)]) < 0.0).all()  # who shows more is colder than it seems


def test_feed_halves_the_time_of_cooling() -> None:
    p = Plant(PlantConfig(), 3, np.random.default_rng(0))
    minutes = np.zeros(3)
    while (p.thermal.temperature > 30.0).any():
        minutes += p.thermal.temperature > 30.0
        p.advance(1.0, 60.0 * np.array([0.0, 0.009, 0.02]), temperature_target=30.0)
    dilution = np.array([0.0, 0.027, 0.06])  # 60 u / 20 mL; T' = -(T - 24) (1/39 + D), from 13 to 6 degC over 24
    assert minutes.tolist() == np.ceil(np.log(13.0 / 6.0) / (1.0 / 39.0 + dilution)).tolist() == [31.0, 15.0, 10.0]


def test_fresh_medium_cools_the_vial() -> None:
    p = plant(PlantConfig(pump=PULSE, thermal=ThermalConfig(medium_c=20.0, heating_c_per_min=0.1)))
    p.advance(1e-6, np.array([1.2]))
    assert 37.0 - p.thermal.temperature[0] == pytest.approx(17.0 * (1.0 - np.exp(-0.06)), rel=1e-3)  # about 1 degC


@pytest.mark.parametrize(
    ("name", "ratio"), [("cold_switch_10", 0.9), ("cold_switch_25", 0.75), ("cold_switch_40", 0.6)]
)
def test_cold_switch_presets_slow_growth_as_named(name: str, ratio: float) -> None:
    p = plant(preset(name))

    def rate() -> float:
        before = p.culture.od.copy()
        p.advance(1.0, np.zeros(1))
        return float(np.log(p.culture.od / before)[0])

    warm = rate()
    p.advance(60.0, np.zeros(1), temperature_target=30.0)
    p.reset(0.5, temperature=30.0)
    assert rate() / warm == pytest.approx(ratio, abs=0.005)


def test_wall_biomass_saturates_and_lifts_the_reading() -> None:
    config = preset("long_run")
    quiet = replace(config, sensor=SensorConfig(wall_gain=config.sensor.wall_gain))
    p = plant(quiet, 4)
    for _ in range(48 * 60):
        p.advance(1.0, np.where(p.culture.od > 0.5, 1.2, 0.0))
    capacity = config.growth.wall_capacity_od
    assert np.all(p.culture.wall > 0.5 * capacity)
    assert np.all(p.culture.wall < 1.05 * capacity)
    np.testing.assert_allclose(p.apparent_od - p.culture.od, config.sensor.wall_gain * p.culture.wall)


def test_evaporation_concentrates() -> None:
    p = plant(PlantConfig(growth=GrowthConfig(mu=0.0), vessel=VesselConfig(evaporation_ml_day=2.0)))
    p.advance(720.0, np.zeros(1))
    assert p.vessel.volume_ml[0] == pytest.approx(19.0)
    assert p.culture.od[0] == pytest.approx(0.5 * 20.0 / 19.0)


def dose(config: PumpConfig, on_s: float, prepare: Callable[[Plant], None] = lambda p: None) -> float:
    p = plant(PlantConfig(pump=config))
    prepare(p)
    p.advance(1.0, np.array([on_s]))
    return float(p.feed.delivered_ml[0])


def test_pump_delivers_gain_times_on_time_less_dead_time() -> None:
    worn = replace(PULSE, gain_ml_s=0.7, dead_time_s=0.05, min_pulse_s=0.1)
    assert dose(worn, 1.05) == pytest.approx(0.7)
    assert dose(worn, 0.079) == 0.0  # the first of the 17 levels is dead
    assert dose(worn, 0.158) == pytest.approx(0.7 * 0.108)
    assert dose(replace(worn, gain_drift_per_h=-0.1), 1.05) == pytest.approx(0.7)


def test_fault_switches_of_the_pump() -> None:
    for factor in (0.0, 0.5, 1.5):
        assert dose(PULSE, 1.0, lambda p, f=factor: p.feed.gain_factor.fill(f)) == pytest.approx(factor)  # type: ignore[misc]
    assert dose(PULSE, 1.0, lambda p: p.feed.back_leak_ml.fill(0.2)) == pytest.approx(0.8)
    assert dose(PULSE, 1.0, lambda p: p.feed.media_left_ml.fill(0.3)) == pytest.approx(0.3)
    p = plant(PlantConfig(pump=PULSE))
    p.advance(1.0, np.array([-2.0]))  # backwards: culture leaves, nothing is diluted
    assert p.vessel.volume_ml[0] == pytest.approx(18.0)
    assert p.culture.od[0] > 0.5


def test_priming_loses_part_of_the_first_pulse_after_a_rest() -> None:
    p = plant(PlantConfig(pump=replace(PULSE, prime_low=0.3, prime_high=0.7)), 200)
    p.advance(11.0, np.zeros(200))
    p.advance(1.0, np.ones(200))
    first = p.feed.delivered_ml.copy()
    p.advance(1.0, np.ones(200))
    np.testing.assert_allclose(p.feed.delivered_ml - first, 1.0)
    assert first.min() >= 0.3
    assert first.max() <= 0.7
    assert first.mean() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("step", [0.1, 0.5, 1.0, 2.0])
def test_a_line_is_unprimed_after_ten_minutes_whatever_the_steps_are(step: float) -> None:
    p = plant(PlantConfig(pump=replace(PULSE, prime_low=0.5, prime_high=0.5)), 1)
    for rest, delivered in ((8.0, 1.0), (10.0, 1.0), (12.0, 0.5)):
        for _ in range(round(rest / step) - 1):  # and the rest of the step with the pulse before
            p.advance(step, np.zeros(1))
        before = p.feed.delivered_ml
        p.advance(step, np.ones(1))
        assert p.feed.delivered_ml - before == pytest.approx(delivered), rest


def test_pulse_spread_and_its_memory() -> None:
    p = plant(PlantConfig(pump=replace(PULSE, pulse_cv=0.1, pulse_ar=0.5)), 400)
    doses = []
    for _ in range(60):
        before = p.feed.delivered_ml
        p.advance(1.0, np.ones(400))
        doses.append(p.feed.delivered_ml - before)
    d = np.array(doses)[5:] - 1.0
    assert d.std() == pytest.approx(0.1, rel=0.03)
    assert np.mean(d[1:] * d[:-1]) / d.var() == pytest.approx(0.5, abs=0.02)


def test_small_irregular_steps_give_the_same_plant() -> None:
    config = preset("bench")
    whole, cut = plant(config, 3), plant(config, 3)
    steps = np.array([0.004, 0.009, 0.006, 0.002, 0.03, 0.2, 0.749])  # min; the pump runs through the first four
    for _ in range(20):
        whole.advance(1.0, np.full(3, 60.0 * steps[:4].sum()), np.full(3, 10.0))
        for k, h in enumerate(steps):
            cut.advance(float(h), np.full(3, 60.0 * h if k < 4 else 0.0), np.full(3, 2.5 if k < 4 else 0.0))
    np.testing.assert_allclose(cut.feed.delivered_ml, whole.feed.delivered_ml, rtol=1e-9)
    np.testing.assert_allclose(cut.vessel.volume_ml, whole.vessel.volume_ml, rtol=1e-6)
    np.testing.assert_allclose(cut.culture.od, whole.culture.od, rtol=2e-3)
    np.testing.assert_allclose(cut.read_od(), whole.read_od(), rtol=3e-3)


def test_noise_does_not_depend_on_what_the_pump_is_told() -> None:
    config = PlantConfig(
        growth=GrowthConfig(drift_sd_per_h=0.1),
        pump=replace(PULSE, pulse_cv=0.2, pulse_ar=0.5, timing_error_s=0.1),
        sensor=SensorConfig(noise_floor=0.01, lag1=0.1, outlier_rate=0.05, bubble_rate=0.05),
    )
    a, b = plant(config, 6), plant(config, 6)
    for minute in range(200):
        a.advance(1.0, 0.5)
        b.advance(1.0, 1.0 if minute % 7 == 0 else 0.0)
        np.testing.assert_allclose(a.read_od() - a.apparent_od, b.read_od() - b.apparent_od, atol=1e-12)
    before = a.feed.delivered_ml, b.feed.delivered_ml
    a.advance(1.0, 0.7)
    b.advance(1.0, 0.7)
    np.testing.assert_allclose(a.feed.delivered_ml - before[0], b.feed.delivered_ml - before[1], rtol=1e-9)
    x = a.culture.od.copy(), b.culture.od.copy()
    a.advance(1.0, 0.0)
    b.advance(1.0, 0.0)
    np.testing.assert_allclose(a.culture.od / x[0], b.culture.od / x[1], rtol=1e-12)  # growth drifted alike


def test_draws_have_the_configured_spread_and_seeds_differ() -> None:
    config = preset("bench")
    p = plant(config, 2000)
    assert p.draws["mu"].mean() == pytest.approx(0.025, rel=0.01)
    assert p.draws["mu"].std() / 0.025 == pytest.approx(0.07, rel=0.08)
    assert p.draws["pump_gain_ml_s"].std() / 1.11 == pytest.approx(0.15, rel=0.08)
    tau = p.draws["volume_ml"] / 60.0 / p.draws["pump_gain_ml_s"]
    assert np.quantile(tau, 0.025) > 0.21
    assert np.quantile(tau, 0.975) < 0.46
    assert np.abs(np.quantile(p.draws["sensor_noise_factor"], [0.1, 0.9]) - [0.5, 2.2]).max() < 0.15
    assert not np.array_equal(p.draws["mu"], plant(config, 2000, seed=1).draws["mu"])


def test_growth_faults_and_stirrer() -> None:
    p = plant(PlantConfig(), 3)
    p.culture.mu_factor[1] = 0.6
    p.culture.stir_factor[2] = 0.0
    p.advance(5.0, 0.0)
    rate = np.log(p.culture.od / 0.5) / 5.0
    np.testing.assert_allclose(rate / rate[0], [1.0, 0.6, 0.5], rtol=5e-3)
    assert 0.05 < 1.0 - p.apparent_od[2] / p.culture.od[2] < 0.10


def test_reset_starts_a_new_culture_in_the_same_reactor() -> None:
    p = plant(preset("bench"), 4)
    mu = p.draws["mu"].copy()
    p.advance(30.0, 1.0)
    p.reset(0.8, temperature=30.0)
    np.testing.assert_array_equal(p.culture.od, 0.8)
    np.testing.assert_array_equal(p.thermal.temperature, 30.0)
    np.testing.assert_array_equal(p.feed.delivered_ml, 0.0)
    np.testing.assert_array_equal(p.draws["mu"], mu)
    assert p.minutes == 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PumpConfig(dead_time_s=0.05), r"set dosing=pulse"),
        (lambda: PumpConfig(dosing="pulse", prime_low=0.9, prime_high=0.5), r"prime_low = 0.9"),
        (lambda: VesselConfig(20.0, capacity_ml=20.0), r"plant.vessel.capacity_ml = 20.0 mL: allowed 24.5"),
        (lambda: Plant(SMALL, 1, np.random.default_rng(0)), r"plant.vessel.capacity_ml = 20.0 mL: allowed 24.5"),
        (lambda: Plant(PlantConfig(), 0, np.random.default_rng(0)), r"number of vials = 0"),
        (lambda: Plant(PlantConfig(), 2, [np.random.default_rng(0)]), r"random streams = 1: allowed 2"),
        (lambda: plant(PlantConfig()).reset(-0.1), r"start OD"),
        (lambda: plant(PlantConfig()).advance(0.0, np.zeros(1)), r"interval = 0.0 min"),
        (lambda: plant(PlantConfig()).advance(1.0, np.array([np.nan])), r"pump on-time"),
        (lambda: GrowthConfig(knots_min=(0.0, 5.0), knots_mu=(0.01,)), r"growth.knots_mu = \[0.01\]: allowed one"),
        (
            lambda: GrowthConfig(knots_min=(5.0, 5.0), knots_mu=(0.01, 0.02)),
            r"knots_min = \[5.0, 5.0\], which",
        ),
        (lambda: GrowthConfig(mu=0.0, knots_min=(0.0,), knots_mu=(0.01,)), r"plant.growth.mu = 0.0: allowed > 0"),
        (lambda: PumpConfig(knots_min=(0.0,)), r"plant.pump.knots_ml_s = \[\]: allowed one value for each"),
    ],
)
def test_what_does_not_fit_together_is_named(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


KNOTS = PlantConfig(
    growth=GrowthConfig(mu=0.03, knots_min=(0.0, 60.0), knots_mu=(0.02, 0.04)),
    pump=PumpConfig(dosing="pulse", knots_min=(0.0, 60.0), knots_ml_s=(1.0, 0.5)),
    integrator="rk4",
)


def test_growth_follows_its_knots_and_stays_at_the_last() -> None:
    p = plant(KNOTS)
    p.advance(60.0, np.zeros(1))
    assert np.log(p.culture.od[0] / 0.5) == pytest.approx(60 * 0.03, rel=0.01)  # mean of the line, from minute starts
    before = p.culture.od[0]
    p.advance(10.0, np.zeros(1))
    assert np.log(p.culture.od[0] / before) == pytest.approx(10 * 0.04, rel=1e-6)
    np.testing.assert_allclose(p.culture.rates(np.array([30.0]))[:, 0], 0.03)


def test_the_pump_follows_its_knots() -> None:
    p = plant(KNOTS)
    for minute, dose in ((0, 1.2), (30, 0.9), (60, 0.6), (600, 0.6)):
        p.reset()
        p.minutes = float(minute)
        np.testing.assert_allclose(p.feed.expected(np.array([1.2]), p.age_min), dose)
        p.advance(1.0, np.array([1.2]))
        assert p.feed.delivered_ml[0] == pytest.approx(dose)


def test_vials_begin_at_ages_of_their_own() -> None:
    p = plant(replace(KNOTS, start_min=15.0, start_spread_min=30.0), 400)
    starts = p.draws["start_min"]
    assert 15.0 <= starts.min() < 16.0
    assert 44.0 < starts.max() <= 45.0
    np.testing.assert_allclose(p.culture.rates(p.age_min)[:, 0], 0.02 + 0.02 * starts / 60.0)
    once = plant(replace(KNOTS, start_min=30.0))
    once.advance(1.0, np.array([1.2]))
    assert once.culture.od[0] == pytest.approx(0.5 * np.exp(-0.9 / 20.0 + 0.03), rel=1e-9)


def test_ages_move_no_other_draw() -> None:
    """A vial that begins later has the same pump, sensor and noise."""
    now, later = (plant(replace(preset("bench"), start_spread_min=s), 3, seed=7) for s in (0.0, 600.0))
    for key in set(now.draws) - {"start_min"}:
        np.testing.assert_array_equal(now.draws[key], later.draws[key])
    np.testing.assert_array_equal(now.read_od(), later.read_od())


@pytest.mark.parametrize("dosing", ["pulse", "continuous"])
def test_three_minutes_at_once_run_each_pump_for_its_seconds_at_its_own_flow(dosing: str) -> None:
    """1.5 s of 0.8 mL/s in, with 0.9 mL of another fluid; 0.6 s of 0.5 mL/s and 0.2 s of 2 mL/s out."""
    pumps = PumpConfig(dosing=dosing, gain_ml_s=0.8, waste_ml_s=0.5, overflow_ml_s=2.0)
    p = plant(PlantConfig(pump=pumps, vessel=VesselConfig(overflow_above_ml=0.0)))
    p.advance(3.0, np.array([1.5]), np.array([0.6]), overflow_s=0.2, supply_ml=0.9)
    assert p.feed.delivered_ml[0] == pytest.approx(1.2)
    assert p.vessel.volume_ml[0] == pytest.approx(20.0 + 1.2 + 0.9 - 0.3 - 0.4)
    p.advance(1.0, np.array([-2.0]), np.zeros(1))
    assert p.vessel.volume_ml[0] == pytest.approx(21.4 - 1.6)


def test_each_vial_has_the_dilution_and_the_rim_of_its_own_volume() -> None:
    """14 mL in a vial of 30 and 26 mL in one of 36: a vial is 10 mL higher than its waste tube at least."""
    still = PlantConfig(pump=PULSE, growth=GrowthConfig(mu=0.0))
    p = Plant(still, 2, np.random.default_rng(0), np.array([14.0, 26.0]))
    p.advance(1.0, np.array([1.2, 1.2]))
    np.testing.assert_allclose(p.culture.od, 0.5 * np.exp(-1.2 / np.array([14.0, 26.0])))
    np.testing.assert_allclose(p.vessel.volume_ml, [14.0, 26.0])
    p.vessel.waste_gain_factor[:] = 0.0
    p.advance(1.0, np.array([12.0, 12.0]))
    np.testing.assert_array_equal(p.vessel.overflowed, [False, True])
    np.testing.assert_allclose(p.vessel.volume_ml, [26.0, 36.0])


def test_the_od_to_expect_is_that_of_the_mean_dose_in_the_vial_s_own_volume() -> None:
    """1.2 s, longer by 0.1 on average and dead for 0.3, at 0.8 mL/s, less 0.05 mL that flow back: 0.75 mL."""
    pump = replace(PULSE, gain_ml_s=0.8, dead_time_s=0.3, timing_error_s=0.2, back_leak_ml=0.05)
    p = Plant(PlantConfig(pump=pump, integrator="rk4"), 2, np.random.default_rng(0), np.array([14.0, 25.0]))
    expected = p.expected_od(0.5, np.array([[0.0, 0.0], [1.2, 1.2]]))
    np.testing.assert_allclose(expected[0], 0.5 * np.exp(0.015))
    np.testing.assert_allclose(expected[1], 0.5 * np.exp(0.015 - 0.75 / np.array([14.0, 25.0])))
    taken, share = p.at_rest(2.0, 1.2)
    np.testing.assert_allclose(taken, [0.75 / 14.0, 0.03])
    np.testing.assert_allclose(share, [0.06 * 14.0 / 0.75, 2.0])


def test_tubes_wear_and_growth_rises_with_the_age_at_which_a_run_begins() -> None:
    aged = PlantConfig(growth=GrowthConfig(ramp_per_h=0.2), pump=replace(PULSE, gain_drift_per_h=-0.1), start_min=120.0)
    p = plant(aged)
    np.testing.assert_allclose(p.culture.rates(p.age_min), 0.03 * 1.4)
    np.testing.assert_allclose(p.feed.expected(np.array([1.5]), p.age_min), 1.5 * 0.8)
    p.advance(1.0, np.array([1.5]))
    assert p.feed.delivered_ml[0] == pytest.approx(1.5 * 0.8)


def test_a_bottle_runs_out_once_and_a_new_culture_does_not_fill_it() -> None:
    p = plant(PlantConfig(pump=PULSE, vessel=VesselConfig(media_ml=2.0)))
    p.advance(1.0, np.array([1.5]))
    p.reset()
    np.testing.assert_allclose(p.feed.expected(np.array([1.5]), p.age_min), 0.5)
    p.advance(1.0, np.array([1.5]))
    assert p.feed.delivered_ml[0] == pytest.approx(0.5)
    assert p.feed.media_left_ml[0] == 0.0


def test_growth_wanders_by_its_sd_within_an_hour() -> None:
    p, rng = plant(PlantConfig(growth=GrowthConfig(drift_sd_per_h=0.1)), 1500), np.random.default_rng(2)
    for _ in range(60):
        p.culture.new_minute(rng.standard_normal(1500))
    assert np.log(p.culture.rates(p.age_min) / 0.03).std() == pytest.approx(0.1, rel=0.06)


def test_a_blank_ages_from_the_start_of_the_run_however_old_the_culture_is() -> None:
    """It rises by 0.002 OD/h and jumps by 0.1 after 90 min; the culture is ten hours old."""
    sensor = SensorConfig(drift_per_h=0.002, shift_od=0.1, shift_min=90.0)
    p = plant(PlantConfig(sensor=sensor, growth=GrowthConfig(mu=0.0), start_min=600.0))
    offsets = []
    for minutes in (30.0, 59.0, 1.0):
        p.advance(minutes, np.zeros(1))
        offsets.append(float(p.read_od()[0] - 0.5))
    assert offsets == pytest.approx([0.001, 0.002 * 89 / 60, 0.103])


def test_a_thermostat_is_set_in_the_vials_that_are_told_and_its_ripple_is_in_the_reading_alone() -> None:
    p = plant(PlantConfig(thermal=ThermalConfig(ripple_c=0.3)), 1000)
    wanted = np.where(np.arange(1000) % 2, np.nan, 40.0)
    p.advance(6.0, np.zeros(1000), temperature_target=wanted)
    truth = np.where(np.arange(1000) % 2, 37.0, 40.0)
    np.testing.assert_allclose(p.thermal.temperature, truth)
    assert (p.thermal.read() - truth).std() == pytest.approx(0.3, rel=0.08)


def test_cells_go_to_the_wall_and_back_and_sink_where_nothing_stirs() -> None:
    """Without growth, w = x0 a / (a + d) (1 - exp(-(a + d) t)); 8 % sink with 1.5 min."""
    held = GrowthConfig(mu=0.0, wall_attach_per_min=0.01, wall_detach_per_min=0.04)
    p = plant(PlantConfig(growth=held, integrator="rk4"))
    p.culture.stir_factor[:] = 0.0
    p.advance(3.0, np.zeros(1))
    assert p.apparent_od[0] / p.culture.od[0] == pytest.approx(1.0 - 0.08 * (1.0 - np.exp(-2.0)))
    p.advance(17.0, np.zeros(1))
    assert p.culture.wall[0] == pytest.approx(0.5 * 0.2 * (1.0 - np.exp(-1.0)), rel=1e-6)
    assert p.culture.od[0] + p.culture.wall[0] == pytest.approx(0.5)
