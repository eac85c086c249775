"""Optical-density sensors of the vials: optics, noise, outliers, bubbles, drift and freezing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.plant.noise import Array, Streams, Tape, spread, uniform

Mask = NDArray[np.bool_]

LINEAR, QUADRATIC = 1.833, 0.226  # OD = 1.833 R + 0.226 R^2, R = log10(blank / raw) (docs/device.md, OD measurement)
FULL_SCALE = 65535.0  # counts of the 16-bit converter


@dataclass(frozen=True)
class SensorConfig:
    """Errors of a reading, the average of one minute; the defaults are a perfect sensor."""

    noise_floor: float = setting(
        0.0, "sd of a reading = hypot(noise_floor, noise_relative * OD)", "OD", within=(0, 0.1)
    )
    noise_relative: float = setting(0.0, "relative noise; see noise_floor", within=(0, 0.1))
    noise_factor_sd: float = setting(0.0, "sd of the logarithm of a reactor's noise factor (median 1)", within=(0, 1))
    noise_swing_sd: float = setting(
        0.0, "sd of the logarithm of a slowly varying noise factor (median 1)", within=(0, 1)
    )
    noise_swing_min: float = setting(
        180.0, "correlation time of the slow noise factor, with a reading each minute", "min", within=(1, 10_000)
    )
    lag1: float = setting(0.0, "correlation of the noise of successive readings", within=(0, 0.95))
    gain_cv: float = setting(0.0, "spread between reactors of the slope k in y = k (x + c x^2)", within=(0, 0.3))
    curvature: float = setting(0.0, "c in y = k (x + c x^2), drawn uniformly from this to 0", "1/OD", within=(-0.3, 0))
    blank_error: float = setting(0.0, "offset, drawn uniformly within +- this", "OD", within=(0, 0.2))
    drift_per_h: float = setting(0.0, "drift of the offset", "OD/h", within=(-0.05, 0.05))
    shift_od: float = setting(0.0, "step of the offset at `shift_min`", "OD", within=(-0.2, 0.2))
    shift_min: float = setting(0.0, "age of the blank at the step", "min", at_least=0.0)
    wall_gain: float = setting(0.0, "rise of the reading per OD-equivalent on the wall", within=(0, 1))
    outlier_rate: float = setting(0.0, "probability of an outlier of 0.04 OD or more, 54 % upward", within=(0, 0.2))
    bubble_rate: float = setting(0.0, "probability of a bubble: +0.05 to 0.3 OD for 1 to 5 readings", within=(0, 0.2))
    zero_rate: float = setting(0.0, "probability that a reading is exactly 0", within=(0, 0.2))
    freeze_rate: float = setting(0.0, "probability that the next 5 to 30 readings are equal", within=(0, 0.2))
    quantised: bool = setting(False, "round to whole counts of the 16-bit converter")
    blank_counts: float = setting(
        14000.0, "mean counts of clear medium, 10 to 25 thousand in public logs", "counts", within=(3000, 60000)
    )
    blank_cv: float = setting(0.0, "relative spread of blank_counts between reactors", within=(0, 0.25))

    def __post_init__(self) -> None:
        check(self, "plant.sensor")


def density(od: Array | float) -> Array:
    """Solve LINEAR R + QUADRATIC R^2 = OD for R; R < 0 for OD < 0. Without a root, return the smallest R."""
    half = LINEAR / (2.0 * QUADRATIC)
    return np.asarray(np.sqrt(np.maximum(np.asarray(od) / QUADRATIC + half * half, 0.0)) - half)


def counts_from_od(od: Array, blank: Array | float) -> Array:
    """Return raw counts by the device's inverted OD formula; not rounded, >= 1 (docs/device.md, OD measurement).

    Args:
      od: OD by the device's formula; blank: counts of clear medium; both broadcastable.
    """
    return np.clip(blank * 10.0 ** -density(od), 1.0, FULL_SCALE)


def od_from_counts(raw: Array, blank: Array | float) -> Array:
    """Convert counts to OD by the device's formula, OD = 1.833 R + 0.226 R^2 with R = log10(blank / raw), raw > 0."""
    ratio = np.log10(blank / raw)
    return np.asarray(LINEAR * ratio + QUADRATIC * ratio * ratio)


class OdSensor:
    """OD sensors of N vials: y = k (x + c x^2) + wall_gain w + offset + drift t, then noise and misreadings.

    Args:
      config: errors of the readings.
      rngs: one stream per vial for its constants (slope, curvature, offset, noise factor, blank).
      noise_rngs: one stream per vial for its readings; each reading draws the same number of values.
    `frozen` (bool) and `extra_offset` (OD), shape (N,), are fault switches that may be set at any time.
    """

    def __init__(self, config: SensorConfig, rngs: Streams, noise_rngs: Streams) -> None:
        n = len(rngs)
        self.config = config
        self.draws: dict[str, Array] = {
            "sensor_gain": spread(rngs, 1.0, config.gain_cv),
            "sensor_curvature": uniform(rngs, config.curvature, 0.0),
            "sensor_offset": uniform(rngs, -config.blank_error, config.blank_error),
            "sensor_noise_factor": np.exp(spread(rngs, 1.0, config.noise_factor_sd) - 1.0),
            "sensor_blank_counts": spread(rngs, config.blank_counts, config.blank_cv),
            "sensor_noise_swing": spread(rngs, 1.0, config.noise_swing_sd) - 1.0,
        }
        self.frozen: Mask = np.zeros(n, dtype=bool)
        self.extra_offset: Array = np.zeros(n)
        self._tape = Tape(noise_rngs, normals=1 + (config.noise_swing_sd > 0.0), uniforms=9)
        self.reset()

    def reset(self) -> None:
        """Clear the effects of past readings: bubbles, frozen readings, correlated noise."""
        n = self.frozen.size
        self._noise, self._swing = np.zeros(n), self.draws["sensor_noise_swing"]
        self._bubble, self._bubble_left, self._freeze_left = np.zeros(n), np.zeros(n), np.zeros(n)
        self._last = np.full(n, np.nan)

    def apparent(self, od: Array, wall: Array, minutes: float) -> Array:
        """Compute the reading of a noise-free sensor, OD, shape (N,).

        Args:
          od: suspended biomass in the light path, shape (N,); wall: biomass on the wall, OD-equivalent, shape (N,).
          minutes: age of the blank, min.
        """
        d = self.draws
        optical = d["sensor_gain"] * (od + d["sensor_curvature"] * od * od)
        shift = self.config.shift_od * (minutes >= self.config.shift_min)
        offset = d["sensor_offset"] + self.config.drift_per_h * minutes / 60.0 + shift + self.extra_offset
        return np.asarray(optical + self.config.wall_gain * wall + offset)

    def read(self, od: Array, wall: Array, minutes: float) -> Array:
        """Take one averaged reading with all errors, OD, shape (N,). Args: as in `apparent`."""
        c = self.config
        (z, *swing), u = self._tape.next()
        clean = self.apparent(od, wall, minutes)
        self._noise = c.lag1 * self._noise + np.sqrt(1.0 - c.lag1**2) * z
        sd = np.hypot(c.noise_floor, c.noise_relative * clean) * self.draws["sensor_noise_factor"]
        for z in swing:
            kept = np.exp(-1.0 / c.noise_swing_min)
            self._swing = kept * self._swing + np.sqrt(1.0 - kept**2) * c.noise_swing_sd * z
            sd = sd * np.exp(self._swing)
        value = clean + sd * self._noise + self._misreading(u)
        if c.quantised:
            blank = np.round(self.draws["sensor_blank_counts"])
            value = od_from_counts(np.round(counts_from_od(value, blank)), blank)
        value = np.where(u[6] < c.zero_rate, 0.0, value)
        repeats = (self.frozen | (self._freeze_left > 0)) & ~np.isnan(self._last)
        starts = (self._freeze_left <= 0) & (u[7] < c.freeze_rate)
        self._freeze_left = np.where(starts, 5.0 + np.floor(26.0 * u[8]), np.maximum(self._freeze_left - 1.0, 0.0))
        self._last = np.where(repeats, self._last, value)
        return self._last.copy()

    def _misreading(self, u: Array) -> Array:
        """Draw the error of this reading by outliers and bubbles, OD, shape (N,)."""
        c = self.config
        # jumps start at 0.04 (the threshold of their count), with an exponential tail of 0.05 OD
        jump = (0.04 - 0.05 * np.log1p(-u[1])) * np.where(u[2] < 0.54, 1.0, -1.0)
        outlier = np.where(u[0] < c.outlier_rate, jump, 0.0)
        starts = (self._bubble_left <= 0) & (u[3] < c.bubble_rate)
        self._bubble = np.where(starts, 0.05 + 0.25 * u[4], self._bubble)
        self._bubble_left = np.where(starts, 1.0 + np.floor(5.0 * u[5]), self._bubble_left)
        bubble = np.where(self._bubble_left > 0, self._bubble, 0.0)
        self._bubble_left = np.maximum(self._bubble_left - 1.0, 0.0)
        return np.asarray(outlier + bubble)
