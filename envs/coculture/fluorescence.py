"""Fluorescent pigment of the second species (pyoverdine of P. putida) and the sensor of its light.

Source of the equations and numbers: Lee, Morlock, Allan, Steel, Cell Reports Methods 5:101009 (2025); its public model
Janmorlock/CompEst3000 (MIT). A reading is the device's base times its first emission: the counts of one band.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.coculture.pair import PairConfig
from envs.plant.noise import Streams, Tape, uniform
from envs.plant.sensor import FULL_SCALE

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DAY_MIN = 1440.0


@dataclass(frozen=True)
class FluorescenceConfig:
    """Sensor y = k (f + od_term OD) + offset with pigment f; the defaults describe a calibrated sensor with noise.

    Seventeen real reactors had k from 0.75 to 1.19 (mean 0.99) and offsets from 151 to 339 (mean 214).
    """

    factor: tuple[float, float] = setting(
        (1.0, 1.0), "range of k, drawn uniformly per reactor", within=(0.1, 10), interval=True
    )
    offset: tuple[float, float] = setting(
        (214.0, 214.0), "range of the offset, drawn uniformly per reactor", "counts", within=(0, 5000), interval=True
    )
    od_term: float = setting(150.0, "light that cells scatter into the band, per OD", "counts/OD", within=(0, 5000))
    noise_sd: float = setting(30.0, "standard deviation of a reading", "counts", within=(0, 1000))
    drift_per_day: float = setting(
        0.0, "relative drift of k is drawn uniformly within +- this", "1/day", within=(0, 0.5)
    )
    ageing_per_day: float = setting(0.0, "relative loss of lamp light", "1/day", within=(0, 0.5))
    saturation: float = setting(
        FULL_SCALE, "highest reading, full scale of the converter", "counts", within=(100, FULL_SCALE)
    )

    def __post_init__(self) -> None:
        check(self, "plant.fluorescence")


class FluorescenceSensor:
    """Pigment and fluorescence sensors of N vials.

      f' = g p - D f          pigment; p is the OD of the second species, D the dilution rate
      g' = follow (g_ss(T) - g(t - delay)),  g >= least    production rate, a damped oscillation about g_ss

    g is integrated with one step per minute. f is exact for constant p and D over the interval.

    Args:
      config: the sensor; rngs: one stream per vial, for its constants and its readings.
      pair: the two species.
    State, shape (N,): `pigment` (counts), `production` (counts per hour and OD). Fault switches, bool, shape (N,):
    `dead` (reads 0), `saturated` (overrides dead), `frozen` (overrides both).
    """

    strain = 1

    def __init__(self, config: FluorescenceConfig, rngs: Streams, pair: PairConfig) -> None:
        self.config, self._pair, n = config, pair, len(rngs)
        parts = [r.spawn(2) for r in rngs]
        once, reading = ([p[k] for p in parts] for k in range(2))
        self.draws: dict[str, Array] = {
            "fluorescence_factor": uniform(once, *config.factor),
            "fluorescence_offset": uniform(once, *config.offset),
            "fluorescence_drift_per_day": uniform(once, -config.drift_per_day, config.drift_per_day),
        }
        self.dead, self.saturated, self.frozen = (np.zeros(n, dtype=bool) for _ in range(3))
        self._tape = Tape(reading, normals=1, uniforms=0)

    def reset(self, producers: Array, growth: Array, temperature: Array) -> None:
        """Set pigment and production to the balance of undiluted growth: f = g_ss p / mu.

        Args: producers: OD of the second species; growth: its rate, 1/min (0: no pigment); temperature: degC; (N,).
        """
        self.production: Array = self._pair.production(temperature)
        self._past = np.tile(self.production, (self._pair.pigment.delay_min, 1))
        made = self.production / 60.0 * producers
        self.pigment: Array = np.divide(made, growth, out=np.zeros_like(made), where=growth > 0.0)
        self._last = np.full(producers.size, np.nan)

    def new_minute(self, temperature: Array) -> None:
        """Advance the production by one minute at `temperature`, degC, shape (N,)."""
        pigment = self._pair.pigment
        steady = self._pair.production(temperature)
        wanted = self.production + pigment.follow_per_h / 60.0 * (steady - self._past[0])
        self._past = np.concatenate([self._past[1:], self.production[None]])
        self.production = np.maximum(wanted, pigment.least)

    def advance(self, minutes: float, producers: Array, kept: Array, dilution: Array, concentrated: Array) -> None:
        """Advance the pigment over an interval: production, dilution, evaporation.

        Args:
          minutes: length of the interval, min. producers: mean OD of the second species in the interval.
          kept: fraction left by a dose at the start; dilution: dilution rate, 1/min; concentrated: factor of the
            concentrations by evaporation, applied at the end; all of shape (N,).
        """
        gone = -np.expm1(-dilution * minutes)
        duration = np.divide(gone, dilution, out=np.full_like(gone, minutes), where=dilution > 0.0)
        made = self.production / 60.0 * producers * duration
        self.pigment = (self.pigment * kept * (1.0 - gone) + made) * concentrated

    def apparent(self, od: Array, minutes: float) -> Array:
        """Compute the reading of a noise-free sensor, counts, shape (N,).

        Args: od: total OD of all cells, shape (N,); minutes: age of the calibration, min.
        """
        days, d = minutes / DAY_MIN, self.draws
        factor = d["fluorescence_factor"] * np.maximum(1.0 + d["fluorescence_drift_per_day"] * days, 0.0)
        factor = factor * max(1.0 - self.config.ageing_per_day * days, 0.0)
        return np.asarray(factor * (self.pigment + self.config.od_term * od) + d["fluorescence_offset"])

    def read(self, od: Array, minutes: float) -> Array:
        """Take one reading with all errors and faults, counts, shape (N,). Args: as in `apparent`."""
        c = self.config
        (z,), _ = self._tape.next()
        value = np.clip(self.apparent(od, minutes) + c.noise_sd * z, 0.0, c.saturation)
        value = np.where(self.saturated, c.saturation, np.where(self.dead, 0.0, value))
        self._last = np.where(self.frozen & ~np.isnan(self._last), self._last, value)
        return self._last.copy()
