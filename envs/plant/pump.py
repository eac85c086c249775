"""Peristaltic pump head: converts seconds at full power into millilitres of fresh medium."""

from dataclasses import dataclass

import numpy as np

from conf.schema import check, require, setting
from envs.plant.course import along, check_knots
from envs.plant.noise import Array, Streams, spread

PRIME_IDLE_MIN = 10.0  # pause, min, after which the line must be primed


@dataclass(frozen=True)
class PumpConfig:
    """Flow of a pump; the defaults are a perfect pump of 1 mL/s.

    `pulse`: the whole dose flows at the start of the interval, as on the device. `continuous`: the dose flows evenly
    over the interval, as in the training model. tau = 20 mL / (60 s * gain).
    """

    dosing: str = setting("continuous", "when the dose of an interval flows", choices=("continuous", "pulse"))
    gain_ml_s: float = setting(1.0, "mean flow at full power (vendor: up to 1)", "mL/s", within=(0.05, 5))
    gain_cv: float = setting(0.0, "relative spread of the flow between pump heads", within=(0, 0.3))
    gain_drift_per_h: float = setting(0.0, "relative drift of the flow (tube wear)", "1/h", within=(-0.2, 0.2))
    knots_min: tuple[float, ...] = setting(
        (), "pump ages at which `knots_ml_s` gives the flow; empty: constant", "min", at_least=0.0
    )
    knots_ml_s: tuple[float, ...] = setting(
        (),
        "mean flow at full power at `knots_min`, linear between them, constant after the last; replaces `gain_ml_s`",
        "mL/s",
        within=(0.05, 5),
    )
    pulse_cv: float = setting(0.0, "relative spread of a minute's dose", within=(0, 1))
    pulse_ar: float = setting(0.0, "correlation of dose errors from minute to minute", within=(0, 0.95))
    dead_time_s: float = setting(0.0, "initial part of each pulse that delivers nothing", "s", within=(0, 0.5))
    min_pulse_s: float = setting(0.0, "shorter pulses deliver nothing", "s", within=(0, 1))
    timing_error_s: float = setting(
        0.0, "extra duration of a pulse, drawn uniformly from 0 to this", "s", within=(0, 0.5)
    )
    prime_low: float = setting(1.0, "smallest fraction that the first pulse after a pause delivers", within=(0, 1))
    prime_high: float = setting(1.0, "largest fraction that the first pulse after a pause delivers", within=(0, 1))
    waste_ml_s: float = setting(1.0, "flow of the waste pump at full power (vendor)", "mL/s", within=(0.05, 5))
    overflow_ml_s: float = setting(
        1.0, "flow of the overflow pump at full power, if present (vendor)", "mL/s", within=(0.05, 5)
    )
    back_leak_ml: float = setting(
        0.0, "volume that flows back after each pulse; leaking head: 0.02 to 0.2", "mL", within=(0, 1)
    )

    def __post_init__(self) -> None:
        check(self, "plant.pump")
        check_knots("plant.pump.knots_ml_s", self.knots_min, self.knots_ml_s)
        highest = f"0 to prime_high = {self.prime_high}"
        require(self.prime_low <= self.prime_high, "plant.pump.prime_low", self.prime_low, highest)
        per_pulse = self.dead_time_s + self.min_pulse_s + self.timing_error_s + self.back_leak_ml
        require(
            self.dosing == "pulse" or (per_pulse == 0.0 and self.prime_low == 1.0),
            "plant.pump.dosing",
            self.dosing,
            "continuous only with dead_time_s, min_pulse_s, timing_error_s and back_leak_ml 0 and prime_low 1, because "
            "these describe pulses; set dosing=pulse",
        )


class FeedPump:
    """N feed pump heads with individual flows.

    Dose of a pulse of t s:  max(0, g (1 + cv z) p max(0, t + e - t0) - leak), or 0 for t < min_pulse_s, with flow g,
    random draw z of the minute, prime fraction p, timing error e and dead time t0 (docs/biology.md, Pumps).

    Calls without a pause between them form one pulse, with one dead time, one timing error and one back-leak.

    Args:
      config: flow and errors; rngs: one stream per vial.
    Fault switches, (N,): `gain_factor`, `back_leak_ml`. State, (N,): `media_left_ml`, volume left in the bottle;
    `delivered_ml`, volume delivered since reset.
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
        """Reset the pumps: primed, stopped, nothing delivered."""
        n = self.gain_factor.size
        self.delivered_ml: Array = np.zeros(n)
        self._idle_min = np.zeros(n)
        self._noise = np.zeros(n)
        self._timing, self._prime, self._pulse_prime = np.zeros(n), np.ones(n), np.ones(n)
        self._running = np.zeros(n, dtype=bool)
        self._on_s, self._moved_ml, self._dosed_ml = np.zeros(n), np.zeros(n), np.zeros(n)

    def new_minute(self, z: Array, u_timing: Array, u_prime: Array) -> None:
        """Set the random draws of the new minute: standard normal z and two uniforms, shape (N,)."""
        c = self.config
        self._noise = c.pulse_ar * self._noise + np.sqrt(1.0 - c.pulse_ar**2) * z
        self._timing = c.timing_error_s * u_timing
        self._prime = c.prime_low + (c.prime_high - c.prime_low) * u_prime

    def _effective(self, on_s: Array, longer_s: Array | float) -> Array:
        """Return the seconds that move liquid in a pulse of `on_s` s which lasts `longer_s` s too long."""
        c = self.config
        moves = (on_s > 0.0) & (on_s >= c.min_pulse_s)
        return np.where(moves, np.maximum(on_s + longer_s - c.dead_time_s, 0.0), 0.0)

    def _flow(self, age_min: Array) -> Array:
        """Return the mean flow at full power, mL/s, of heads of age `age_min`, min; both shape (N,)."""
        c = self.config
        drift = (1.0 + c.gain_drift_per_h * age_min / 60.0) * along(c.knots_min, c.knots_ml_s, c.gain_ml_s, age_min)
        return self.draws["pump_gain_ml_s"] * self.gain_factor * drift

    def expected(self, on_s: Array, age_min: Array) -> Array:
        """Return the mean dose of one pulse of `on_s` s by a primed head, mL, (..., N); no side effects.

        Args: as in `deliver`.
        """
        moving = self._effective(on_s, 0.5 * self.config.timing_error_s)
        return np.asarray(np.clip(self._flow(age_min) * moving - self.back_leak_ml, 0.0, self.media_left_ml))

    def deliver(self, on_s: Array, minutes: float, age_min: Array) -> Array:
        """Run forward for `on_s` s at the start of an interval; return the volume delivered, mL, shape (N,).

        Args:
          on_s: seconds at full power, shape (N,), >= 0.
          minutes: length of the interval, min; if on_s fills it, the pulse continues in the next call.
          age_min: age of the head, min, for its drift, shape (N,).
        """
        pulsing = on_s > 0.0
        start = pulsing & ~self._running
        primed = np.where(self._idle_min > PRIME_IDLE_MIN, self._prime, 1.0)
        self._pulse_prime = np.where(start, primed, self._pulse_prime)
        for store in (self._on_s, self._moved_ml, self._dosed_ml):
            store[start] = 0.0
        flow = np.maximum(self._flow(age_min) * (1.0 + self.config.pulse_cv * self._noise), 0.0) * self._pulse_prime
        before, self._on_s = self._effective(self._on_s, self._timing), self._on_s + on_s
        self._moved_ml += flow * np.maximum(self._effective(self._on_s, self._timing) - before, 0.0)
        dose = np.maximum(self._moved_ml - self.back_leak_ml, 0.0) - self._dosed_ml
        dose = np.where(pulsing, np.clip(dose, 0.0, self.media_left_ml), 0.0)
        self._dosed_ml = self._dosed_ml + dose
        self.media_left_ml -= dose
        self.delivered_ml = self.delivered_ml + dose
        self._idle_min = np.where(pulsing, 0.0, self._idle_min + minutes)
        self._running = pulsing & (on_s >= 60.0 * minutes - 1e-9)
        return np.asarray(dose)

    def drawn_back(self, on_s: Array) -> Array:
        """Return the volume that a backward run of `on_s` s removes from the vial, mL, shape (N,)."""
        return np.asarray(self.draws["pump_gain_ml_s"] * self.gain_factor * on_s)
