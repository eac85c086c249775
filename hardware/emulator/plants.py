"""The cultures and pumps of the emulated reactors: the presets of conf/plant, as the device works them."""

from __future__ import annotations

import functools
from dataclasses import replace

from conf.presets import load
from conf.schema import build
from envs.plant.plant import PlantConfig

__all__ = ["plant_preset"]


@functools.cache
def plant_preset(name: str) -> PlantConfig:
    """Preset `conf/plant/NAME.yaml` with pulse dosing, the only one the device knows.

    The vial's optics (`VialConfig`) stand for noise, misreadings and counts of the preset's sensor, which are left out:
    a vial takes only the sensor's noise-free value. Raises: ValueError naming the presets.
    """
    plant = build(PlantConfig(), load(f"plant/{name}"), "plant")
    return replace(plant, pump=replace(plant.pump, dosing="pulse"))
