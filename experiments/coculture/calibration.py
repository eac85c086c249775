"""Calibration of a light sensor with medium and a known culture (docs/coculture.md, Calibration of the sensor)."""

from dataclasses import dataclass

import numpy as np

from conf.schema import require
from envs.coculture.pair import PairConfig
from experiments.coculture.base import Array
from experiments.coculture.estimator import CompositionEstimatorConfig

OD_TERM = CompositionEstimatorConfig().od_term


@dataclass(frozen=True)
class SensorCalibration:
    """Factor k and offset o (counts) of a reading FL = k (f + 150 OD) + o, with their sds."""

    factor: float
    factor_sd: float
    offset: float
    offset_sd: float


def calibrate_sensor(
    blank: Array,
    light: Array,
    od: Array,
    temperature: float,
    share: float = 1.0,
    growth: float | None = None,
    share_sd: float = 0.0,
    growth_cv: float = 0.05,
    pair: PairConfig | None = None,
) -> SensorCalibration:
    """Calibrate a sensor with readings of medium, and of a culture in balance at constant temperature and density.

      o = mean(blank),   k = mean((FL - o) / OD) / L,   L = share g(T) / D + 150

    D is the dilution rate at constant density, which equals the growth rate, and g the production of pigment. The sds
    are first-order and follow from the scatter of the readings, `share_sd` and `growth_cv`.

    Args:
      blank: readings of sterile medium, counts, (B,), two or more.
      light, od: readings of the culture, counts and OD, (K,) each, two or more.
      temperature: temperature of the culture for at least three hours, degC.
      share, share_sd: share of the second species (1: a pure culture), and its sd. growth: growth rate, 1/h, from the
        doses; None: from the growth curve at this temperature. growth_cv: relative sd of the growth rate.
    Raises: ValueError with argument, value and allowed values.
    """
    dark, bright, dense = (np.asarray(a, dtype=np.float64) for a in (blank, light, od))
    for name, given in (("blank", dark), ("light", bright), ("od", dense)):
        require(given.ndim == 1 and given.size > 1, f"{name} readings", given.size, "two or more")
        require(
            bool(np.isfinite(given).all()), f"{name} readings", "nan or inf", "finite numbers; remove invalid readings"
        )
    require(bright.size == dense.size, "light readings", bright.size, f"as many as of OD, {dense.size}")
    require(bool((dense > 0.0).all()), "smallest od", float(dense.min()), "greater than 0")
    low, high = (pair := pair or PairConfig()).temperatures
    require(low <= temperature <= high, "temperature", temperature, f"{low:g} to {high:g} degC")
    require(0.0 < share <= 1.0, "share", share, "0 < share <= 1; without the second species nothing fluoresces")
    rate = float(pair.rates(temperature)[1]) if growth is None else growth
    require(rate > 0.0, "growth", rate, "greater than 0 1/h")
    pigment = share * float(pair.production(temperature)) / rate  # per OD
    glow = pigment + OD_TERM
    offset, offset_sd = float(dark.mean()), float(dark.std(ddof=1)) / dark.size**0.5
    each = (bright - offset) / dense
    factor = float(each.mean()) / glow
    require(factor > 0.0, "mean light over the blank", float(bright.mean() - offset), "greater than 0 counts")
    scatter = float(each.std(ddof=1)) / each.size**0.5
    by_offset = offset_sd * float((1.0 / dense).mean())
    by_pigment = factor * pigment * float(np.hypot(share_sd / share, growth_cv))
    return SensorCalibration(factor, float(np.linalg.norm([scatter, by_offset, by_pigment])) / glow, offset, offset_sd)
