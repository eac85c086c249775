"""Liquid in the vial: inflow, outflow, level, evaporation."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.bench import VIAL_ML
from envs.plant.noise import Array, Streams, spread
from envs.plant.pump import PumpConfig

Mask = NDArray[np.bool_]

MIN_VOLUME_ML = 1.0  # mL; no pump can remove it, so concentrations stay finite


@dataclass(frozen=True)
class VesselConfig:
    """Settings of the vial and its bottle of fresh medium."""

    volume_ml: float | None = setting(
        None, "mean culture volume up to the waste tube; null: that of the bench", "mL", within=(5, 50)
    )
    volume_sd_ml: float = setting(0.0, "sd of the volume between vials", "mL", within=(0, 1.5))
    overflow_above_ml: float = setting(
        2.0, "height of the overflow pump's tube above the waste tube, as volume", "mL", within=(0, 10)
    )
    capacity_ml: float | None = setting(
        None, "volume at which the vial overflows; null: 30 mL, or 10 mL above the waste tube if that is more", "mL",
        at_most=200.0,
    )  # fmt: skip
    evaporation_ml_day: float = setting(0.0, "evaporation of water", "mL/day", within=(0, 50))
    media_ml: float = setting(math.inf, "fresh medium in the bottle; inf: never empty", "mL", within=(0, math.inf))

    def __post_init__(self) -> None:
        check(self, "plant.vessel")
        if self.volume_ml is not None:
            self._holds(self.volume_ml)

    def _holds(self, volume_ml: float) -> None:
        lowest = volume_ml + 4.5
        enough = self.capacity_ml is None or self.capacity_ml >= lowest
        require(enough, "plant.vessel.capacity_ml", f"{self.capacity_ml} mL", f"{lowest:g} to 200")

    def of(self, bench_ml: Array) -> Array:
        """Return the mean culture volume of each vial, mL, (N,): `volume_ml` of the config, else `bench_ml`.

        Raises: ValueError if a vial's capacity is too small.
        """
        mean = bench_ml if self.volume_ml is None else np.full(len(bench_ml), self.volume_ml)
        self._holds(float(mean.max()))
        return mean


class Vessel:
    """N vials with outlets at fixed heights.

    The waste pump lowers the level down to its tube. Liquid that it does not remove raises the level; above the
    capacity, `overflowed` is set. The overflow pump is a second outlet, a little higher.

    Args:
      config: heights and evaporation; pump: flows of the waste pump and of the overflow pump.
      rngs: one stream per vial, for the height of its tube. bench_ml: culture volume of the bench, mL, (N,).
    State, shape (N,): `volume_ml`, `overflowed`. Fault switches, shape (N,): `waste_gain_factor` and
    `overflow_gain_factor`, 0 blocked, 1 normal.
    """

    def __init__(self, config: VesselConfig, pump: PumpConfig, rngs: Streams, bench_ml: Array) -> None:
        self.config, self._pump = config, pump
        mean = config.of(bench_ml)
        self._tube_ml = spread(rngs, mean, config.volume_sd_ml / mean)
        given = config.capacity_ml
        self._capacity_ml = np.maximum(VIAL_ML, mean + 10.0) if given is None else np.full(len(rngs), given)
        self.draws: dict[str, Array] = {"volume_ml": self._tube_ml}
        self.waste_gain_factor, self.overflow_gain_factor = np.ones(len(rngs)), np.ones(len(rngs))
        self.reset()

    def reset(self) -> None:
        """Fill the vial to the waste tube."""
        self.volume_ml: Array = self._tube_ml.copy()
        self.overflowed: Mask = np.zeros(self._tube_ml.size, dtype=bool)

    def exchange(self, fresh: Array, waste_s: Array, overflow_s: Array) -> Array:
        """Add fresh medium and run the outlets; return the factor F of the old content's concentrations, shape (N,).

        Fresh medium first fills the vial up to the tube of an outlet. There it replaces the volume that the outlet's
        pump removes. The rest raises the level further.
        Args: fresh: fresh medium, mL, shape (N,). waste_s, overflow_s: on-times of the two pumps, s, shape (N,).
        """
        above_ml = self._tube_ml + self.config.overflow_above_ml
        outlets = [  # from below: level of the tube, volume that the pump can move in mL
            [self._tube_ml, _moved(waste_s, self._pump.waste_ml_s * self.waste_gain_factor)],
            [above_ml, _moved(overflow_s, self._pump.overflow_ml_s * self.overflow_gain_factor)],
        ]
        level, left, kept = self.volume_ml, fresh, np.ones(fresh.size)
        for outlet in outlets:
            tube, able = outlet
            fill = np.minimum(left, np.maximum(tube - level, 0.0))
            swapped = np.minimum(left - fill, able)
            kept = kept * (level / (level + fill)) * np.exp(-swapped / (level + fill))
            level, left, outlet[1] = level + fill, left - fill - swapped, able - swapped
        kept = kept * (level / (level + left))
        level = level + left
        self.overflowed = self.overflowed | (level > self._capacity_ml)
        for tube, able in outlets:
            level = np.maximum(level - able, np.minimum(tube, level))
        self.volume_ml = np.minimum(level, self._capacity_ml)
        return np.asarray(kept)

    def draw_out(self, volume_ml: Array) -> None:
        """Remove a volume of culture, mL, shape (N,), also below the waste tube."""
        self.volume_ml = np.maximum(self.volume_ml - volume_ml, MIN_VOLUME_ML)

    def evaporate(self, minutes: float) -> Array:
        """Evaporate water; return the factor of the concentrations, >= 1, shape (N,)."""
        before = self.volume_ml
        self.draw_out(np.asarray(self.config.evaporation_ml_day * minutes / 1440.0))
        return np.asarray(before / self.volume_ml)


def _moved(on_s: Array, flow: Array) -> Array:
    """Return the volume that a pump of `flow` mL/s can move, mL, shape (N,): never negative, 0 if blocked."""
    able = np.zeros_like(flow)  # a blocked pump moves nothing for any on-time (0 times infinity is 0 here)
    return np.multiply(np.maximum(on_s, 0.0), flow, out=able, where=flow > 0.0)
