"""Temperature of the vial: thermostat, surroundings, fresh medium."""

from dataclasses import dataclass

import numpy as np

from conf.schema import check, setting
from envs.plant.noise import Array, Streams, uniform


@dataclass(frozen=True)
class ThermalConfig:
    """Heater and surroundings: heating is active and fast, cooling is passive and slow.

    Public Chi.Bio logs show ambient 21.4 and 25.7 degC, cooling 30 and 53 min, fastest heating 2.3 to 2.5 degC/min.
    """

    ambient_c: float = setting(24.0, "temperature an unheated vial cools to", "degC", within=(0, 45))
    cooling_min: float = setting(39.0, "time constant of passive cooling", "min", within=(1, 600))
    heating_c_per_min: float = setting(2.0, "fastest rise of a heated vial", "degC/min", within=(0.1, 10))
    medium_c: float = setting(24.0, "temperature of fresh medium", "degC", within=(0, 45))
    ripple_c: float = setting(0.0, "standard deviation of a temperature reading", "degC", within=(0, 2))
    offset_c: tuple[float, float] = setting(
        (0.0, 0.0), "range of measured minus true temperature, drawn once per vial", "degC", within=(-3, 3),
        interval=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self, "plant.thermal")


class Thermal:
    """N heated vials. The thermostat sees the measured temperature, true plus `offset`; the cells feel the true one.

    Args: config: heater and surroundings; rngs: one stream per vial, for its thermometer.
    State, shape (N,), degC: true `temperature`, `target` of the thermostat (0: off), true `mean` of the last interval.
    """

    def __init__(self, config: ThermalConfig, rngs: Streams) -> None:
        self.config, self._n = config, len(rngs)
        self.draws: dict[str, Array] = {"thermometer_offset": uniform(rngs, *config.offset_c)}
        self.offset = self.draws["thermometer_offset"]

    def reset(self, temperature: Array | float) -> None:
        """Set vial and thermostat so that the thermometer shows `temperature`, degC, scalar or shape (N,)."""
        shown = np.full(self._n, temperature, dtype=np.float64)
        self.temperature: Array = shown - self.offset
        self.target: Array = shown
        self.mean: Array = self.temperature
        self._ripple = np.zeros(self._n)

    def set_target(self, target: Array | float) -> None:
        """Set the target of the thermostat, degC, scalar or shape (N,); nan keeps the present target."""
        wanted = np.broadcast_to(np.asarray(target, dtype=np.float64), (self._n,))
        self.target = np.where(np.isnan(wanted), self.target, wanted)

    def new_minute(self, z: Array) -> None:
        """Set the random draw of the new minute: standard normal, shape (N,)."""
        self._ripple = z

    def advance(self, minutes: float, kept: Array) -> None:
        """Mix in the fresh medium, cool passively, and heat towards the target without overshoot.

        Args: kept: fraction of the old content after dilution by fresh medium, shape (N,).
        """
        t = self.config
        mixed = t.medium_c + (self.temperature - t.medium_c) * kept
        cooled = t.ambient_c + (mixed - t.ambient_c) * np.exp(-minutes / t.cooling_min)
        heated = np.minimum(self.target - self.offset, cooled + t.heating_c_per_min * minutes)
        self.temperature = np.maximum(cooled, heated)
        # A vial that reaches its target early heats only until then.
        rise = self.temperature - mixed
        share = np.where(rise > 0.0, np.minimum(rise / (t.heating_c_per_min * minutes), 1.0), 1.0)
        self.mean = self.temperature - 0.5 * rise * share

    def read(self) -> Array:
        """Read the thermometer, degC, shape (N,); its noise changes every minute."""
        return np.asarray(self.temperature + self.offset + self.config.ripple_c * self._ripple)
