"""A peristaltic pump head: seconds at full power in, millilitres of fresh medium out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.plant.noise import Streams, check_ranges, spread

__all__ = ["FeedPump", "PumpConfig"]

Array = NDArray[np.float64]

RANGES = {
    "gain_ml_s": (0.05, 5.0, "mL/s"),
    "gain_cv": (0.0, 0.3, ""),
    "gain_drift_per_h": (-0.2, 0.2, "1/h"),
    "pulse_cv": (0.0, 0.5, ""),
    "pulse_ar": (0.0, 0.95, ""),
    "dead_time_s": (0.0, 0.5, "s"),
    "min_pulse_s": (0.0, 1.0, "s"),
    "timing_error_s": (0.0, 0.5, "s"),
    "prime_idle_min": (0.0, 1440.0, "min"),
    "prime_low": (0.0, 1.0, ""),
    "prime_high": (0.0, 1.0, ""),
    "waste_ml_s": (0.05, 5.0, "mL/s"),
    "overflow_ml_s": (0.05, 5.0, "mL/s"),
    "back_leak_ml": (0.0, 1.0, "mL"),
}


@dataclass(frozen=True)
class PumpConfig:
    """How a pump turns on-time into volume; the defaults are a perfect pump of 1 mL/s.

    dosing: `pulse` (the whole dose at the start of the interval, as the device does) or `continuous` (spread evenly
      over the interval, as the training model assumes).
    gain_ml_s, gain_cv: flow at full power, mean and spread between heads.
    gain_drift_per_h: relative change of the flow per hour (tube wear).
    pulse_cv, pulse_ar: spread of a minute's dose and its correlation with the minute before.
    dead_time_s: on-time that delivers nothing at the start of each pulse.
    min_pulse_s: pulses shorter than this deliver nothing.
    timing_error_s: each pulse lasts longer by a uniform draw from 0 to this.
    prime_idle_min, prime_low, prime_high: after more idle minutes than this, a pulse delivers only a fraction between.
    waste_ml_s, overflow_ml_s: flow of the waste pump and of the overflow pump at full power.
    back_leak_ml: volume that siphons back after each pulse.
    """

    dosing: str = "continuous"
    gain_ml_s: float = 1.0
    gain_cv: float = 0.0
    gain_drift_per_h: float = 0.0
    pulse_cv: float = 0.0
    pulse_ar: float = 0.0
    dead_time_s: float = 0.0
    min_pulse_s: float = 0.0
    timing_error_s: float = 0.0
    prime_idle_min: float = 10.0
    prime_low: float = 1.0
    prime_high: float = 1.0
    waste_ml_s: float = 1.0
    overflow_ml_s: float = 1.0
    back_leak_ml: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(self, "plant.pump", RANGES)
        if self.dosing not in ("pulse", "continuous"):
            raise ValueError(f"plant.pump.dosing = {self.dosing}: allowed continuous, pulse")
        if self.prime_low > self.prime_high:
            raise ValueError(
                f"plant.pump.prime_low = {self.prime_low}: allowed 0 to prime_high = {self.prime_high}; lower it"
            )
        per_pulse = self.dead_time_s + self.min_pulse_s + self.timing_error_s + self.back_leak_ml
        if self.dosing == "continuous" and (per_pulse > 0.0 or self.prime_low < 1.0):
            raise ValueError(
                "plant.pump.dosing = continuous: allowed only with dead_time_s, min_pulse_s, timing_error_s and "
                "back_leak_ml 0 and prime_low 1, which are properties of a pulse; set dosing=pulse"
            )


class FeedPump:
    """N feed pump heads, each with its own flow.

    Dose of a pulse of t s:  max(0, g (1 + cv z) p max(0, t + e - t0) - leak), and 0 for t < min_pulse_s, with flow g,
    this minute's draw z, prime fraction p, timing error e and dead time t0 (docs/biology.md, Pumps).

    A pulse may be asked for in pieces: while the pump does not pause between calls it is one pulse, with one dead
    time, one timing error and one back-leak.

    Args:
      config: what is wrong with them; rngs: one stream per vial.
    `gain_factor` and `back_leak_ml`, shape (N,), are fault switches; `media_left_ml` is what the bottle still
    holds, `delivered_ml` the fresh medium delivered since reset.
    """

    def __init__(self, config: PumpConfig, rngs: Streams) -> None:
        self.config = config
        self.draws: dict[str, Array] = {"pump_gain_ml_s": spread(rngs, config.gain_ml_s, config.gain_cv)}
        n = len(rngs)
        self.gain_factor: Array = np.ones(n)
        self.back_leak_ml: Array = np.full(n, config.back_leak_ml)
        self.media_left_ml: Array = np.full(n, np.inf)
        self.reset()

    def reset(self) -> None:
        """Primed and at rest."""
        n = self.gain_factor.size
        self.delivered_ml: Array = np.zeros(n)
        self._idle_min = np.zeros(n)
        self._noise = np.zeros(n)
        self._timing, self._prime, self._pulse_prime = np.zeros(n), np.ones(n), np.ones(n)
        self._running = np.zeros(n, dtype=bool)
        self._on_s, self._moved_ml, self._dosed_ml = np.zeros(n), np.zeros(n), np.zeros(n)

    def new_minute(self, z: Array, u_timing: Array, u_prime: Array) -> None:
        """Take this minute's draws: standard normal z and two uniforms, shape (N,)."""
        c = self.config
        self._noise = c.pulse_ar * self._noise + np.sqrt(1.0 - c.pulse_ar**2) * z
        self._timing = c.timing_error_s * u_timing
        self._prime = c.prime_low + (c.prime_high - c.prime_low) * u_prime

    def _effective(self, on_s: Array) -> Array:
        """Seconds of a pulse of `on_s` s that move liquid."""
        c = self.config
        moves = (on_s > 0.0) & (on_s >= c.min_pulse_s)
        return np.where(moves, np.maximum(on_s + self._timing - c.dead_time_s, 0.0), 0.0)

    def expected(self, on_s: Array, clock_min: float) -> Array:
        """Mean dose of one pulse of `on_s` s by a primed head, mL; on_s and the result end in (N,). Changes nothing.

        Args: as `deliver`.
        """
        c = self.config
        moves = (on_s > 0.0) & (on_s >= c.min_pulse_s)
        moving = np.where(moves, np.maximum(on_s + 0.5 * c.timing_error_s - c.dead_time_s, 0.0), 0.0)
        flow = self.draws["pump_gain_ml_s"] * self.gain_factor * (1.0 + c.gain_drift_per_h * clock_min / 60.0)
        return np.asarray(np.clip(flow * moving - self.back_leak_ml, 0.0, self.media_left_ml))

    def deliver(self, on_s: Array, minutes: float, clock_min: float) -> Array:
        """Run forward for `on_s` s at the start of an interval; volume of fresh medium delivered, mL, shape (N,).

        Args:
          on_s: seconds at full power, shape (N,), >= 0.
          minutes: length of the interval, min; on_s that fills it leaves the pulse open.
          clock_min: age of the head, min, for its drift.
        """
        c = self.config
        pulsing = on_s > 0.0
        start = pulsing & ~self._running
        primed = np.where(self._idle_min > c.prime_idle_min, self._prime, 1.0)
        self._pulse_prime = np.where(start, primed, self._pulse_prime)
        for store in (self._on_s, self._moved_ml, self._dosed_ml):
            store[start] = 0.0
        flow = self.draws["pump_gain_ml_s"] * self.gain_factor * (1.0 + c.gain_drift_per_h * clock_min / 60.0)
        flow = np.maximum(flow * (1.0 + c.pulse_cv * self._noise), 0.0) * self._pulse_prime
        before, self._on_s = self._effective(self._on_s), self._on_s + on_s
        self._moved_ml += flow * np.maximum(self._effective(self._on_s) - before, 0.0)
        dose = np.maximum(self._moved_ml - self.back_leak_ml, 0.0) - self._dosed_ml
        dose = np.where(pulsing, np.clip(dose, 0.0, self.media_left_ml), 0.0)
        self._dosed_ml = self._dosed_ml + dose
        self.media_left_ml -= dose
        self.delivered_ml = self.delivered_ml + dose
        self._idle_min = np.where(pulsing, 0.0, self._idle_min + minutes)
        self._running = pulsing & (on_s >= 60.0 * minutes - 1e-9)
        return np.asarray(dose)

    def drawn_back(self, on_s: Array) -> Array:
        """Volume that running backward for `on_s` s, shape (N,), draws out of the vial, mL."""
        return np.asarray(self.draws["pump_gain_ml_s"] * self.gain_factor * on_s)
