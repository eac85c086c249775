"""The laser and the spectrometer of an emulated reactor: light into counts."""

from __future__ import annotations

import numpy as np

from envs.plant.sensor import density
from hardware.emulator.vial_config import VialConfig, VialFaults

__all__ = ["Spectrometer"]

FULL_SCALE = 65535
DARK_COUNTS = 3.0  # what the spectrometer counts without light


class Spectrometer:
    """One laser and the chip that counts its light.

    Args: config: optics; faults: what is broken, may change at any time; rng: noise of this reactor.
    `blank` is the count of clear medium.
    """

    def __init__(self, config: VialConfig, faults: VialFaults, rng: np.random.Generator) -> None:
        self._config, self._faults, self._rng = config, faults, rng
        self.blank = float(rng.uniform(config.blank_low, config.blank_high))
        self._lit, self._lit_before, self._laser_since = 0.0, 0.0, np.nan
        self._common, self._jump, self._measured_at, self._last_raw = 0.0, 0.0, -np.inf, 0

    def set_laser(self, on: bool, at: float) -> None:
        """Laser on or off."""
        if not np.isnan(self._laser_since):
            self._lit += at - self._laser_since
        self._laser_since = at if on else np.nan

    def begin_exposure(self, at: float) -> None:
        """The spectrometer starts integrating, and forgets what another thread had begun to integrate."""
        self._lit_before = self._lit_s(at)

    def _lit_s(self, at: float) -> float:
        """Total time the laser has been on."""
        return self._lit + (0.0 if np.isnan(self._laser_since) else at - self._laser_since)

    def counts(self, at: float, exposure_s: float, od: float, moving: bool) -> int:
        """One spectrometer reading of the laser, 16-bit counts.

        raw = blank 10^-R with LINEAR R + QUADRATIC R^2 = what a noise-free sensor would show; stirred or half-lit
        readings are lower.
        Args:
          at: device s; exposure_s: how long it should have been lit since `begin_exposure`.
          od: what a noise-free sensor would show, OD; moving: whether the vial's content is in motion.
        """
        f, c, rng = self._faults, self._config, self._rng
        if at - self._measured_at > 10.0:  # a new measurement: what its readings share is drawn again
            self._common, self._jump = rng.normal(0.0, c.common_fraction), f.od_jump
            f.od_jump = 0.0
            if rng.random() < c.outlier_rate:
                self._jump += (0.04 + rng.exponential(0.05)) * (1.0 if rng.random() < 0.54 else -1.0)
        self._measured_at = at
        if f.spectrometer_dark:
            return 0
        if f.spectrometer_dead or rng.random() < f.spectrometer_glitch:
            return 1
        if f.od_frozen and self._last_raw > 0:
            return self._last_raw
        light = self.blank * 10.0 ** -float(density(od + f.od_offset + self._jump))
        if moving:
            light *= max(c.stir_factor * (1.0 + rng.normal(0.0, c.stir_noise)), 0.01)
        light *= 1.0 + self._common + rng.normal(0.0, c.noise_fraction)
        self._last_raw = int(
            np.clip(
                round(DARK_COUNTS + light * min((self._lit_s(at) - self._lit_before) / exposure_s, 1.0)), 0, FULL_SCALE
            )
        )
        return self._last_raw
