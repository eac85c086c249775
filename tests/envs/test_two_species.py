"""Two species in one vial: shares, lags, pigment and its sensor, against closed forms and figures done by hand."""

from dataclasses import replace

import numpy as np
import pytest

from conf.presets import load
from conf.schema import build
from envs.coculture.fluorescence import FluorescenceConfig
from envs.coculture.second import SecondSpeciesConfig
from envs.plant.culture import GrowthConfig
from envs.plant.plant import Plant, PlantConfig
from envs.plant.thermal import ThermalConfig
from envs.plant.vessel import VesselConfig
from tests.two_species import p_putida_rate, steady_production

QUIET = FluorescenceConfig(noise_sd=0.0)
STEADY = ThermalConfig(medium_c=37.0, heating_c_per_min=10.0)


def plant(config: PlantConfig, n: int = 1, seed: int = 0) -> Plant:
    return Plant(config, n, np.random.default_rng(seed))


def pair(**changes) -> PlantConfig:
    """Rates 0.02 and 0.01 1/min whatever the temperature, half and half at the start, nothing random."""
    second = SecondSpeciesConfig(start_share=(0.5, 0.5), mu=0.01)
    base = PlantConfig(growth=GrowthConfig(mu=0.02), second=second, fluorescence=QUIET, integrator="rk4")
    return replace(base, **changes)


def logit(share):
    return np.log(share / (1.0 - share))


@pytest.mark.parametrize("dosing", ["continuous", "pulse"])
def test_the_logit_of_the_share_falls_by_the_difference_of_the_rates(dosing) -> None:
    """Whatever is fed and evaporates."""
    pump, vessel = replace(PlantConfig().pump, dosing=dosing), VesselConfig(evaporation_ml_day=50.0)
    p = plant(pair(pump=pump, vessel=vessel), n=3)
    p.reset(share=np.array([0.1, 0.5, 0.9]))
    start = logit(p.culture.share)
    for _ in range(60):
        p.advance(1.0, np.array([0.0, 0.3, 1.2]))
    np.testing.assert_allclose(logit(p.culture.share) - start, 60 * (0.01 - 0.02), rtol=1e-6)


def test_both_eat_the_same_medium_and_share_the_wall() -> None:
    growth = GrowthConfig(mu=0.02, yield_od=2.0, wall_attach_per_min=1e-3, wall_growth_ratio=0.0)
    p = plant(pair(growth=growth))
    for _ in range(120):
        p.advance(1.0, np.zeros(1))
        total = p.culture.od + p.culture.wall + 2.0 * p.culture.substrate
        assert total[0] == pytest.approx(2.0, rel=1e-9)
    assert p.culture.wall[0] > 0.05


def test_two_species_that_are_alike_are_one() -> None:
    growth = GrowthConfig(
        mu=0.025, mu_cv=0.0, temperature_law="cardinal", adaptation_min=10.0, yield_od=3.0, drift_sd_per_h=0.05,
        wall_attach_per_min=2e-4, wall_detach_per_min=1e-3, wall_growth_ratio=0.5, wall_capacity_od=0.2,
    )  # fmt: skip
    twin = SecondSpeciesConfig((0.3, 0.3), mu=0.025, temperature_law="cardinal", adaptation_min=10.0)
    one, two = plant(PlantConfig(growth=growth), 2), plant(PlantConfig(growth=growth, second=twin), 2)
    for k in range(200):
        for p in (one, two):
            p.advance(1.0, np.array([0.3, 1.2]), temperature_target=37.0 if k < 100 else 30.0)
        now = [p.expected_od(1.0, np.array([[0.0, 0.0], [1.2, 0.5]])) for p in (one, two)]
        np.testing.assert_allclose(now[1], now[0], rtol=1e-9)
    for name in ("od", "substrate", "wall"):
        np.testing.assert_allclose(getattr(two.culture, name), getattr(one.culture, name), rtol=1e-9)
    np.testing.assert_allclose(two.culture.share, 0.3, rtol=1e-9)


def test_a_second_species_moves_no_draw_of_the_first() -> None:
    """The same reactors and noise: what was drawn for a vial stays when a species is added."""
    bench = build(PlantConfig(), load("plant/bench"))
    share = SecondSpeciesConfig((0.2, 0.8), mu=0.01, mu_cv=0.1)
    one, two = plant(bench, 4), plant(replace(bench, second=share), 4)
    for name, drawn in one.draws.items():
        np.testing.assert_array_equal(two.draws[name], drawn)
    assert np.unique(two.draws["second_share"]).size == 4
    first = two.culture.share
    two.reset()
    np.testing.assert_array_equal(two.culture.share, first)


def test_one_species_has_no_share_and_no_light() -> None:
    p = plant(PlantConfig(), 2)
    assert np.isnan(p.culture.share).all()
    assert np.isnan(p.read_fluorescence()).all()
    assert p.culture.biomass.shape == (2, 1)


def test_each_species_follows_the_temperature_with_its_own_lag() -> None:
    config = build(PlantConfig(), load("plant/coculture"))
    p = plant(replace(config, thermal=STEADY))
    p.reset(temperature=29.0)
    p.thermal.temperature[:] = 36.0  # a step, not a ramp
    for _ in range(60):
        p.advance(1.0, np.zeros(1), temperature_target=36.0)
    e, putida = 60.0 * p.culture.rates(p.age_min)[0]
    assert e == pytest.approx(1.11218, rel=1e-6)
    assert putida == pytest.approx(0.47996 + (float(p_putida_rate(29.0)) - 0.47996) * np.exp(-1.0), rel=1e-4)


def test_expected_od_is_the_sum_of_both() -> None:
    p = plant(pair())
    (grown,) = p.expected_od(1.0, np.zeros((1, 1)))
    assert grown[0] == pytest.approx(0.25 * (np.exp(0.02) + np.exp(0.01)), rel=1e-9)


def test_a_share_outside_its_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"start share = 1\.5: allowed 0 to 1"):
        plant(pair()).reset(share=1.5)


# -- pyoverdine and its light ------------------------------------------------------------------------------------------


def test_production_answers_at_once_and_overshoots_after_the_delay() -> None:
    """g' = k (1 - g(t - d)) from 0: k t until d, then k d + k (t - d) (1 - k (t - d) / 2); k = 1.6 / h, d = 0.5 h."""
    light = plant(pair()).fluorescence
    low, high = float(steady_production(35.0)), float(steady_production(32.0))
    light.reset(np.array([0.2]), np.array([0.01]), np.array([35.0]))
    done = []
    for _ in range(120):
        light.new_minute(np.array([32.0]))
        done.append((light.production[0] - low) / (high - low))
    assert done[14] == pytest.approx(1.6 * 0.25, rel=1e-9)
    assert done[29] == pytest.approx(0.8, rel=1e-9)
    assert done[44] == pytest.approx(0.8 + 0.4 * (1.0 - 0.2), abs=0.01)
    assert 1.05 < max(done) < 1.6
    for _ in range(120):
        light.new_minute(np.array([36.0]))
        assert light.production[0] >= 20.0


def test_pulses_and_steady_flow_wash_out_alike() -> None:
    pulse = replace(pair().pump, dosing="pulse")
    readings = []
    for config in (pair(), pair(pump=pulse)):
        p = plant(replace(config, thermal=STEADY, start_temperature=33.0))
        for _ in range(300):
            p.advance(1.0, np.array([0.4]))
        readings.append(p.read_fluorescence()[0])
    assert readings[1] == pytest.approx(readings[0], rel=0.02)


def test_evaporation_concentrates_the_pigment() -> None:
    dry = pair(vessel=VesselConfig(evaporation_ml_day=50.0), growth=GrowthConfig(mu=0.0))
    p = plant(replace(dry, second=replace(dry.second, mu=0.0)))
    p.fluorescence.pigment[:], p.fluorescence.production[:] = 1000.0, 0.0
    p.fluorescence.advance(1.0, np.zeros(1), np.ones(1), np.zeros(1), np.array([1.1]))
    assert p.fluorescence.pigment[0] == pytest.approx(1100.0)


def test_a_reactor_s_factor_offset_and_ageing_are_in_its_reading() -> None:
    lamp = FluorescenceConfig((0.8, 0.8), (300.0, 300.0), noise_sd=0.0, ageing_per_day=0.1)
    light = plant(pair(fluorescence=lamp)).fluorescence
    light.pigment[:] = 1000.0
    assert light.read(np.array([0.5]), 0.0)[0] == pytest.approx(0.8 * 1075.0 + 300.0)
    assert light.read(np.array([0.5]), 2880.0)[0] == pytest.approx(0.8 * 0.8 * 1075.0 + 300.0)


def test_drift_goes_either_way_and_stays_with_the_reactor() -> None:
    light = plant(pair(fluorescence=replace(QUIET, drift_per_day=0.1)), 40).fluorescence
    light.pigment[:] = 1000.0
    day = light.read(np.zeros(40), 1440.0) - 214.0
    assert day.min() < 950.0 < 1050.0 < day.max() <= 1100.0
    np.testing.assert_allclose(light.read(np.zeros(40), 2880.0) - 214.0, 2.0 * day - 1000.0)


def test_a_reading_spreads_as_configured_and_stays_within_the_converter() -> None:
    light = plant(pair(fluorescence=FluorescenceConfig(saturation=1000.0)), 500).fluorescence
    light.pigment[:] = 500.0
    assert np.std([light.read(np.zeros(500), 0.0) for _ in range(20)]) == pytest.approx(30.0, rel=0.05)
    light.pigment[:] = 5000.0
    np.testing.assert_array_equal(light.read(np.zeros(500), 0.0), 1000.0)


def test_fault_switches_of_the_light() -> None:
    light = plant(pair(fluorescence=FluorescenceConfig()), 4).fluorescence
    before = light.read(np.full(4, 0.5), 0.0)
    light.dead[1], light.saturated[2], light.frozen[3] = True, True, True
    after = light.read(np.full(4, 0.5), 0.0)
    assert after[0] != before[0]
    np.testing.assert_array_equal(after[1:], [0.0, 65535.0, before[3]])


def test_the_published_presets_start_where_they_say() -> None:
    p = plant(build(PlantConfig(), load("plant/coculture_mixed")), 50)
    share = p.culture.share
    assert 0.2 <= share.min() < 0.3 < 0.7 < share.max() <= 0.8
    np.testing.assert_allclose(p.thermal.read(), 33.2)
    assert 0.75 <= p.draws["fluorescence_factor"].min() <= p.draws["fluorescence_factor"].max() <= 1.19
    nominal = load("plant/coculture")
    both = load("plant/coculture_growth_both")
    assert both["growth"]["mu"] / nominal["growth"]["mu"] == pytest.approx(0.95)
    assert both["second"]["mu"] / nominal["second"]["mu"] == pytest.approx(0.90)


def test_a_day_of_temperatures_goes_as_in_the_public_model() -> None:
    """Run of Janmorlock/CompEst3000 (1 s steps, held OD 0.5) from half and half in balance at 33.2 degC."""
    program = [(2, 33.2), (4, 29.0), (4, 36.0), (2, 33.2)]  # hours, degC
    shares = {2: 0.4997, 4: 0.6471, 6: 0.7694, 8: 0.5734, 10: 0.2844, 12: 0.2169}
    pigments = {2: 2941.6, 4: 2718.5, 6: 3127.3, 8: 852.6, 10: 161.9, 12: 1237.4}  # over OD
    config = build(PlantConfig(), load("plant/coculture"))
    hour = 0
    p = plant(config)
    for hours, degrees in program:
        p.thermal.config = ThermalConfig(ambient_c=degrees, medium_c=degrees)
        p.thermal.temperature[:] = degrees  # steps
        for _ in range(hours):
            for _ in range(60):
                p.advance(1.0, np.maximum(20.0 * np.log(p.culture.od / 0.5), 0.0), temperature_target=degrees)
            hour += 1
            if hour in shares:
                assert p.culture.share[0] == pytest.approx(shares[hour], abs=0.002)
                assert p.fluorescence.pigment[0] / p.culture.od[0] == pytest.approx(pigments[hour], rel=0.015)
