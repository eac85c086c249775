"""The vial's temperature: thermostat, surroundings, fresh medium."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.plant.noise import check_ranges

__all__ = ["Thermal", "ThermalConfig"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ThermalConfig:
    """Heater and surroundings: heating is active and fast, cooling passive and slow.

    ambient_c: temperature the vial cools to; cooling_min: time constant of it, min.
    heating_c_per_min: fastest rise of a heated vial; medium_c: temperature of fresh medium.
    ripple_c: sd of the temperature reading.
    """

    ambient_c: float = 24.0
    cooling_min: float = 39.0
    heating_c_per_min: float = 2.0
    medium_c: float = 24.0
    ripple_c: float = 0.0

    def __post_init__(self) -> None:
        ranges = {
            "ambient_c": (0.0, 45.0, "degC"),
            "cooling_min": (1.0, 600.0, "min"),
            "heating_c_per_min": (0.1, 10.0, "degC/min"),
            "medium_c": (0.0, 45.0, "degC"),
            "ripple_c": (0.0, 2.0, "degC"),
        }
        check_ranges(self, "plant.thermal", ranges)


class Thermal:
    """N heated vials.

    Args: config: heater and surroundings; n: number of vials.
    State, shape (N,), degC: `temperature`, `target` of the thermostat (0 = off), `mean` of the last interval.
    """

    def __init__(self, config: ThermalConfig, n: int) -> None:
        self.config, self._n = config, n

    def reset(self, temperature: float) -> None:
        """Vial and thermostat at `temperature`, degC."""
        self.temperature: Array = np.full(self._n, float(temperature))
        self.target: Array = np.full(self._n, float(temperature))
        self.mean: Array = self.temperature
        self._ripple = np.zeros(self._n)

    def set_target(self, target: Array | float) -> None:
        """New target of the thermostat, degC, scalar or shape (N,); nan leaves it."""
        wanted = np.broadcast_to(np.asarray(target, dtype=np.float64), (self._n,))
        self.target = np.where(np.isnan(wanted), self.target, wanted)

    def new_minute(self, z: Array) -> None:
        """Take this minute's draw: standard normal, shape (N,)."""
        self._ripple = z

    def advance(self, minutes: float, kept: Array) -> None:
        """Mix in the medium's temperature, cool passively, heat towards the target without overshoot.

        Args: kept: share of the vial's content that fresh medium has left in it, shape (N,).
        """
        t = self.config
        mixed = t.medium_c + (self.temperature - t.medium_c) * kept
        cooled = t.ambient_c + (mixed - t.ambient_c) * np.exp(-minutes / t.cooling_min)
        heated = np.minimum(self.target, cooled + t.heating_c_per_min * minutes)
        self.temperature = np.maximum(cooled, heated)
        # A vial that reaches its target early in the interval spends only that share of it on the way.
        rise = self.temperature - mixed
        share = np.where(rise > 0.0, np.minimum(rise / (t.heating_c_per_min * minutes), 1.0), 1.0)
        self.mean = self.temperature - 0.5 * rise * share

    def read(self) -> Array:
        """The thermometer's value, degC, shape (N,); its ripple changes every minute."""
        return self.temperature + self.config.ripple_c * self._ripple
