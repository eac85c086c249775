"""What stands behind the device's chips: one vial with its pumps, heater, stirrer and light path, and what can break.

Seconds are device seconds. The culture is `envs.plant.Plant` with one vial; the optics (blank, counts, noise) and the
electronics (power, motors, faults) are here, because the device sees counts, not OD.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from envs.plant import Plant

__all__ = ["Bench", "BenchConfig", "Dose", "VialFaults"]

FEED, WASTE = "Pump1", "Pump2"
LINEAR, QUADRATIC = 1.833, 0.226  # OD = LINEAR R + QUADRATIC R^2, R = log10(zero / raw) (chibio.md section 4)
FULL_SCALE = 65535
DARK_COUNTS = 3.0  # what the spectrometer counts without light
LONGEST_STEP_S = 60.0
STIR_SETTLE_S = 2.0  # readings sooner after the stirrer stopped are still disturbed
STIR_STOPPED_S = 90.0  # a stirrer off for longer than any still phase has failed: cells settle
DOSES_KEPT = 50_000


@dataclass(frozen=True)
class BenchConfig:
    """Optics and electronics of a reactor.

    blank_low, blank_high: range of the counts of clear medium, drawn once per reactor (chibio.md section 4).
    noise_fraction: sd of one reading, as a fraction of raw.
    common_fraction: sd that all readings of one measurement share, as a fraction of raw; with the defaults the mean of
      four readings has sd 0.0036 at OD 0.5 (biology.md section 4).
    outlier_rate: probability per measurement of an isolated jump of more than 0.04 OD.
    stir_factor, stir_noise: raw while stirring, relative to still, mean and spread.
    on_time_bias_low_s, on_time_bias_high_s: how much longer than asked a pump runs (chibio.md section 5.1).
    air_c: air outside.
    """

    blank_low: float = 11600.0
    blank_high: float = 15800.0
    noise_fraction: float = 0.003
    common_fraction: float = 0.004
    outlier_rate: float = 0.006
    stir_factor: float = 0.4
    stir_noise: float = 0.05
    on_time_bias_low_s: float = 0.02
    on_time_bias_high_s: float = 0.2
    air_c: float = 24.0

    def __post_init__(self) -> None:
        ranges = {
            "blank_low": (3000.0, 60000.0),
            "blank_high": (self.blank_low, 60000.0),
            "noise_fraction": (0.0, 0.2),
            "common_fraction": (0.0, 0.2),
            "outlier_rate": (0.0, 1.0),
            "stir_factor": (0.05, 1.0),
            "stir_noise": (0.0, 0.5),
            "on_time_bias_low_s": (0.0, 1.0),
            "on_time_bias_high_s": (self.on_time_bias_low_s, 1.0),
            "air_c": (0.0, 45.0),
        }
        for key, (low, high) in ranges.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise ValueError(f"bench.{key} = {value}: allowed {low:g} to {high:g}; change it")


@dataclass
class VialFaults:
    """What is broken at one reactor; may be set at any time.

    unplugged: cable out. od_frozen: the spectrometer repeats its last count. od_offset: OD added to every reading.
    od_jump: OD added to the next measurement only. spectrometer: "" sound, "dead" raw = 1, "dark" raw = 0.
    spectrometer_glitch: probability that a single reading fails (raw = 1). stuck_open: pumps that run whatever they are
    told. heater_runaway: heater at full power whatever it is told. stirrer_dead: does not turn.
    """

    unplugged: bool = False
    od_frozen: bool = False
    od_offset: float = 0.0
    od_jump: float = 0.0
    spectrometer: str = ""
    spectrometer_glitch: float = 0.0
    stuck_open: set[str] = field(default_factory=set)
    heater_runaway: bool = False
    stirrer_dead: bool = False


class Dose(NamedTuple):
    """One run of a motor: start and length in device seconds, direction 1 or -1, fresh medium delivered in mL."""

    pump: str
    start_s: float
    seconds: float
    direction: int
    feed_ml: float


class Bench:
    """One reactor as the chips see it.

    Args:
      plant: a plant of one vial; config: optics and electronics; rng: noise of this reactor; start: device s.
    `doses` holds what the motors did, `on_s` their total on-time, `peak_ml` the highest volume.
    """

    def __init__(self, plant: Plant, config: BenchConfig, rng: np.random.Generator, start: float = 0.0) -> None:
        self.plant, self.config, self.faults = plant, config, VialFaults()
        self._rng, self._at = rng, start
        self.blank = float(rng.uniform(config.blank_low, config.blank_high))
        self.doses: deque[Dose] = deque(maxlen=DOSES_KEPT)
        self.on_s = dict.fromkeys((FEED, WASTE, "Pump3", "Pump4"), 0.0)
        self.peak_ml = float(plant.volume_ml[0])
        self.powered = True
        self.heat, self.stir = 0.0, 0.0
        self.settled_at = start - STIR_SETTLE_S
        self._stirred_at = start
        self._motors = dict.fromkeys(self.on_s, 0)
        self._since: dict[str, tuple[float, float]] = {}
        self._feed_s = self._waste_s = 0.0
        self._lit, self._laser_since = 0.0, np.nan
        self._common, self._measured_at, self._last_raw = 0.0, -np.inf, 0

    # -- motors, heater, stirrer, laser ----------------------------------------------------------------------------

    def motor(self, pump: str) -> int:
        """What the motor really does: 1, -1 or 0."""
        if not self.powered:
            return 0
        return 1 if pump in self.faults.stuck_open else self._motors[pump]

    def drive(self, pump: str, direction: int, at: float) -> None:
        """Write the pump's two registers: 1 forward, -1 backward, 0 off."""
        before = self.motor(pump)
        self._motors[pump] = direction
        self._switched(pump, before, at)

    def set_power(self, on: bool, at: float) -> None:
        """Watchdog latch: without it every output is off."""
        before = {pump: self.motor(pump) for pump in self._motors}
        self.sync(at)
        self.powered = on
        if not on:
            self._motors = dict.fromkeys(self._motors, 0)
            self.heat = 0.0
            self.set_stirrer(0.0, at)
            self.set_laser(False, at)
        for pump, direction in before.items():
            self._switched(pump, direction, at)

    def set_stuck_open(self, pump: str, stuck: bool, at: float) -> None:
        """Fault: the pump runs forward at full power whatever it is told."""
        before = self.motor(pump)
        (self.faults.stuck_open.add if stuck else self.faults.stuck_open.discard)(pump)
        self._switched(pump, before, at)

    def _switched(self, pump: str, before: int, at: float) -> None:
        """Account for a motor that changed from `before` to what it does now."""
        now = self.motor(pump)
        if now == before:
            return
        self._settle_dose(pump, at)
        if before == 0 and not self._since:
            self.sync(at)  # a pulse starts at the start of a plant interval
        if now != 0:
            self._since[pump] = (at, float(self.plant.media_ml[0]))
        else:
            start, media = self._since.pop(pump)
            self.sync(at)
            delivered = float(self.plant.media_ml[0]) - media if pump == FEED else 0.0
            self.doses.append(Dose(pump, start, at - start, before, delivered))

    def set_heat(self, duty: float, at: float) -> None:
        """Heater power, 0 to 1."""
        self.sync(at)
        self.heat = duty

    def set_stirrer(self, power: float, at: float) -> None:
        """Stirrer power, 0 to 1."""
        if self.stir > 0.0 and power == 0.0:
            self.settled_at = at + STIR_SETTLE_S
            self._stirred_at = at
        self.stir = power if self.powered and not self.faults.stirrer_dead else 0.0

    def set_laser(self, on: bool, at: float) -> None:
        """Laser on or off; readings see the share of their exposure during which it was on."""
        if not np.isnan(self._laser_since):
            self._lit += at - self._laser_since
        self._laser_since = at if on else np.nan

    def lit_s(self, at: float) -> float:
        """Total time the laser has been on."""
        return self._lit + (0.0 if np.isnan(self._laser_since) else at - self._laser_since)

    # -- the culture -----------------------------------------------------------------------------------------------

    def _settle_dose(self, pump: str, at: float) -> None:
        """Book the on-time up to `at` of every running motor into the plant interval in progress."""

    def sync(self, at: float) -> None:
        """Bring the plant up to device time `at`."""
        while at - self._at > 1e-9:
            self._step(min(at - self._at, LONGEST_STEP_S))

    def _step(self, seconds: float) -> None:
        feed, waste = (self.motor(pump) * seconds for pump in (FEED, WASTE))
        for pump in self._motors:
            self.on_s[pump] += abs(self.motor(pump)) * seconds
        thermal, plant = self.plant.config.thermal, self.plant
        heat = 1.0 if self.faults.heater_runaway and self.powered else self.heat
        minutes = seconds / 60.0
        cooled = thermal.ambient_c + (plant.temperature - thermal.ambient_c) * np.exp(-minutes / thermal.cooling_min)
        still = self.stir == 0.0 and self._at + seconds - self._stirred_at > STIR_STOPPED_S
        plant.stir_factor[:] = 0.0 if still else 1.0
        plant.advance(minutes, feed, waste, cooled + heat * thermal.heating_c_per_min * minutes)
        self._at += seconds
        self.peak_ml = max(self.peak_ml, float(plant.volume_ml[0]))
