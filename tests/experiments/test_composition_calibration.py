"""Factor and offset from two known cultures, against a plant whose constants are known."""

from dataclasses import replace

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from envs.plant.plant import Plant, PlantConfig
from envs.task import EnvConfig
from experiments.coculture.calibration import calibrate_sensor
from experiments.laws import registry
from tests.two_species import p_putida_rate, steady_production

pytestmark = pytest.mark.numeric


def protocol(share, n=40, hours=5, factor=0.8, offset=300.0):
    """Thirty readings of medium, and thirty of a culture at 33.2 degC after some hours at OD 0.5, (N, 30) each."""
    config = build(PlantConfig(), presets.load("plant/coculture"))
    light = replace(config.fluorescence, factor=(factor, factor), offset=(offset, offset))
    config = replace(config, fluorescence=light, second=replace(config.second, start_share=(share, share)))
    plant = Plant(config, n, np.random.default_rng(1))
    density = registry.build(registry.config("inverse"), model=EnvConfig())
    density.reset(n)
    readings, ods = [], []
    for k in range(60 * hours):
        od, light_now = plant.read_od(), plant.read_fluorescence()
        readings.append(light_now)
        ods.append(od)
        rate = density.act(od, np.full(n, 0.5), np.full(n, float(k)), np.ones(n, dtype=bool))
        plant.advance(1.0, 60.0 * rate)
    plant.reset(od=0.0)
    blank = [plant.read_fluorescence() for _ in range(30)]
    return np.array(blank).T, np.array(readings[-30:]).T, np.array(ods[-30:]).T


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_constants_of_a_reactor_are_found_within_their_sds(share):
    blank, light, od = protocol(share)
    found = [calibrate_sensor(*three, 33.2, share=share, growth_cv=0.0) for three in zip(blank, light, od, strict=True)]
    factor, offset = np.array([c.factor for c in found]), np.array([c.offset for c in found])
    assert factor.mean() == pytest.approx(0.8, rel=0.01)
    assert offset.mean() == pytest.approx(300.0, abs=3.0)
    assert np.mean([c.factor_sd for c in found]) == pytest.approx(factor.std(ddof=1), rel=0.35)
    assert np.mean([c.offset_sd for c in found]) == pytest.approx(offset.std(ddof=1), rel=0.35)


def test_what_is_not_known_of_the_culture_widens_the_factor():
    blank, light, od = (three[0] for three in protocol(0.4, n=1))
    sure = calibrate_sensor(blank, light, od, 33.2, share=0.4, growth_cv=0.0)
    unsure = calibrate_sensor(blank, light, od, 33.2, share=0.4, share_sd=0.04, growth_cv=0.05)
    pigment = 0.4 * 5269.7 / 0.895  # counts per OD; the curves at 33.2 degC
    by_culture = pigment / (pigment + 150.0) * np.hypot(0.1, 0.05)
    assert unsure.factor_sd == pytest.approx(np.hypot(sure.factor_sd, sure.factor * by_culture), rel=0.01)


@pytest.mark.parametrize("growth", [None, 0.6])
def test_factor_and_offset_of_a_few_readings_by_hand(growth):
    """At 31 degC, where the curve's growth is another, or at the rate that was dosed: L = 0.8 g / D + 150.

    Mean light per OD over the blank's 300: that of 0.4 and 0.8, which is not the mean light over the mean OD.
    """
    rate = float(p_putida_rate(31.0)) if growth is None else growth
    pigment = 0.8 * float(steady_production(31.0)) / rate
    bright = 300.0 + np.array([0.4, 0.8]) * np.array([3000.0, 3300.0])
    found = calibrate_sensor(
        np.array([280.0, 300.0, 320.0]), bright, np.array([0.4, 0.8]), 31.0, 0.8, growth, share_sd=0.08, growth_cv=0.03
    )
    assert found.offset == pytest.approx(300.0)
    assert found.offset_sd == pytest.approx(20.0 / np.sqrt(3.0))
    factor = 3150.0 / (pigment + 150.0)
    assert found.factor == pytest.approx(factor)
    parts = [150.0, 20.0 / np.sqrt(3.0) * 1.875, factor * pigment * np.hypot(0.1, 0.03)]  # scatter, offset, culture
    assert found.factor_sd == pytest.approx(np.linalg.norm(parts) / (pigment + 150.0))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"blank": [300.0]}, "blank readings = 1: allowed two or more"),
        ({"light": [900.0, np.nan]}, "light readings = nan or inf"),
        ({"light": [900.0, 910.0, 920.0]}, "as many as of OD, 2"),
        ({"od": [0.5, 0.0]}, "smallest od"),
        ({"share": 0.0}, "without the second species nothing fluoresces"),
        ({"temperature": 37.0}, "29 to 36 degC"),
        ({"growth": 0.0}, "growth = 0.0"),
        ({"light": [100.0, 110.0]}, "light over the blank"),
    ],
)
def test_what_cannot_calibrate_is_refused(change, says):
    given = {"blank": [300.0, 310.0], "light": [900.0, 910.0], "od": [0.5, 0.5], "temperature": 33.2} | change
    with pytest.raises(ValueError, match=says):
        calibrate_sensor(**given)
