"""The hardware behind the device's chips: one vial with its pumps, heater, stirrer, light path and faults.

Seconds are device seconds. The culture is a `Plant` with one vial. The optics (blank, counts, noise) and the
electronics (power, motors, faults) are here, because the device reads counts, not OD.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from conf.schema import check, setting
from envs.plant.plant import Plant
from envs.plant.sensor import density
from hardware.emulator.faults import Switches

FEED, WASTE = "Pump1", "Pump2"
SPARE = ("Pump3", "Pump4")

FULL_SCALE = 65535
AIR_C = 24.0  # outside the reactor
DARK_COUNTS = 3.0  # of the spectrometer without light
LONGEST_STEP_S = 60.0
SENSOR_STEP_S = 2.0
STIR_FACTOR = 0.4  # raw counts while stirring, relative to still medium
STIR_SETTLE_S = 2.0  # readings less than this after a stop of the stirrer are disturbed
STIR_STOPPED_S = 90.0  # cells settle if the stirrer is off for longer
DOSES_KEPT = 5_000  # per reactor; a day of single-shot dosing is 2880
READS_KEPT = 30_000  # per reactor; a day of the driver's reads is 12000


class Dose(NamedTuple):
    """One run of a motor: start and duration, device s, direction 1 or -1, fresh medium delivered, mL."""

    pump: str
    start_s: float
    seconds: float
    direction: int
    feed_ml: float


class StoredSample(NamedTuple):
    """One record of the experiment: time when it was stored, recorded time and OD, and the culture's true OD."""

    stored_s: float
    sample_s: float
    od: float
    culture_od: float


@dataclass(frozen=True)
class VialConfig:
    """Optics and electronics of a reactor.

    The blank is drawn once per reactor (docs/device.md, OD measurement). With the default noise the mean of four
    readings has sd 0.0036 at OD 0.5 (docs/biology.md, Sensor). A motor starts after the register writes of its thread:
    0.2 to 0.7 s in runs of the device's software with simulated electronics and bus times.
    """

    blank: tuple[float, float] = setting(
        (11600.0, 15800.0), "range of the counts of clear medium", within=(3000, 60000), interval=True
    )
    noise_fraction: float = setting(0.003, "sd of one reading relative to the raw counts", within=(0, 0.2))
    common_fraction: float = setting(
        0.004, "sd common to all readings of one measurement, relative to the raw counts", within=(0, 0.2)
    )
    outlier_rate: float = setting(0.006, "probability of an isolated jump of more than 0.04 OD", within=(0, 1))
    stir_noise: float = setting(0.05, "relative spread of the raw counts while stirring", within=(0, 0.5))
    on_time_bias_s: tuple[float, float] = setting(
        (0.02, 0.2), "range of a pump's extra on-time (docs/device.md, Pumps)", "s", within=(0, 1), interval=True
    )
    pump_start_s: tuple[float, float] = setting(
        (0.2, 0.7), "time from the reply to a pump command until the motor turns", "s", within=(0, 5), interval=True
    )
    pump3_ml_s: float = setting(0.0, "flow of Pump3 if it supplies a second fluid", "mL/s", within=(0, 5))
    pump4_ml_s: float = setting(0.0, "flow of Pump4 if it supplies a second fluid", "mL/s", within=(0, 5))
    overflow_pump: str = setting("", "pump whose tube ends slightly above the waste tube", choices=(*SPARE, ""))

    def __post_init__(self) -> None:
        check(self, "vial")


class Spectrometer:
    """A laser and the chip that counts its light. `blank`: counts of clear medium. Args: rng: source of its noise."""

    def __init__(self, config: VialConfig, faults: Switches, rng: np.random.Generator) -> None:
        self._config, self._faults, self._rng = config, faults, rng
        self.blank = float(rng.uniform(*config.blank))
        self._lit, self._lit_before, self._laser_since = 0.0, 0.0, np.nan
        self._common, self._jump, self._measured_at, self._last_raw = 0.0, 0.0, -np.inf, 0

    def set_laser(self, on: bool, at: float) -> None:
        if not np.isnan(self._laser_since):
            self._lit += at - self._laser_since
        self._laser_since = at if on else np.nan

    def begin_exposure(self, at: float) -> None:
        """Start to integrate light; this discards an integration that another thread has begun."""
        self._lit_before = self._lit_s(at)

    def _lit_s(self, at: float) -> float:
        return self._lit + (0.0 if np.isnan(self._laser_since) else at - self._laser_since)

    def counts(self, at: float, exposure_s: float, od: float, moving: bool) -> int:
        """Return one reading of the laser's light, 16-bit counts, at device second `at`.

        raw = blank 10^-R, where LINEAR R + QUADRATIC R^2 is the noise-free OD. Readings are lower while stirring
        (moving), or if the laser was on for less than exposure_s since `begin_exposure`.
        """
        f, c, rng = self._faults, self._config, self._rng
        if at - self._measured_at > 10.0:  # a new measurement draws its common noise
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
            light *= max(STIR_FACTOR * (1.0 + rng.normal(0.0, c.stir_noise)), 0.01)
        light *= 1.0 + self._common + rng.normal(0.0, c.noise_fraction)
        lit = min((self._lit_s(at) - self._lit_before) / exposure_s, 1.0)
        self._last_raw = int(np.clip(round(DARK_COUNTS + light * lit), 0, FULL_SCALE))
        return self._last_raw


class Vial:
    """Hardware of one reactor around a plant of one vial.

    doses: runs of the motors. samples: records of the software. reads: device times at which a client received the
    newest sample. All three survive restarts. on_s: total on-time of each motor. peak_ml: highest volume so far.
    """

    def __init__(self, plant: Plant, config: VialConfig, rng: np.random.Generator, start: float = 0.0) -> None:
        self.plant, self.config, self.faults = plant, config, Switches("vial")
        self._rng, self._at = rng, start
        self.spectrometer = Spectrometer(config, self.faults, rng)
        self.doses: deque[Dose] = deque(maxlen=DOSES_KEPT)
        self.samples: deque[StoredSample] = deque(maxlen=DOSES_KEPT)
        self.reads: deque[float] = deque(maxlen=READS_KEPT)
        self.on_s = dict.fromkeys((FEED, WASTE, *SPARE), 0.0)
        self.supplied_ml = dict.fromkeys(SPARE, 0.0)
        self.peak_ml = float(plant.vessel.volume_ml[0])
        self.powered = True
        self.heat, self.stir = 0.0, 0.0
        self._settled_at = start - STIR_SETTLE_S
        self._stirred_at = start
        self._motors = dict.fromkeys(self.on_s, 0)
        self._since: dict[str, tuple[float, float]] = {}

    def motor(self, pump: str) -> int:
        """Return the motor's true direction: 1, -1 or 0."""
        if not self.powered or self.faults.unplugged:
            return 0
        stuck = {FEED: self.faults.feed_stuck_open, WASTE: self.faults.waste_stuck_open}
        return 1 if stuck.get(pump) else self._motors[pump]

    def drive(self, pump: str, direction: int, at: float) -> None:
        """Write the pump's two registers: 1 forward, -1 backward, 0 off."""
        if direction != self._motors[pump]:
            before = self._running(at)
            self._motors[pump] = direction
            self._book(before, at)

    def set_power(self, on: bool, at: float) -> None:
        """Set the watchdog's power latch: without power every output goes off, and stays off until written again."""
        before = self._running(at)
        self.powered = on
        if not on:
            self._motors = dict.fromkeys(self._motors, 0)
            self.heat = 0.0
            self.set_stirrer(0.0, at)
            self.spectrometer.set_laser(False, at)
        self._book(before, at)

    def set_fault(self, name: str, value: bool | float, at: float) -> None:
        """Set one field of `faults`; a dead stirrer stops at once."""
        before = self._running(at)
        setattr(self.faults, name, value)
        if self.faults.stirrer_dead:
            self.set_stirrer(0.0, at)
        self._book(before, at)

    def _running(self, at: float) -> dict[str, int]:
        """Bring the plant up to date before the motors change; return their directions until now."""
        self.sync(at)
        return {pump: self.motor(pump) for pump in self._motors}

    def _book(self, before: dict[str, int], at: float) -> None:
        """Close and open dose records for the motors that changed from `before`."""
        for pump, direction in before.items():
            media = self._delivered(pump)
            now = self.motor(pump)
            if now == direction:
                continue
            if direction != 0:
                start, had = self._since.pop(pump)
                self.doses.append(Dose(pump, start, at - start, direction, media - had))
            if now != 0:
                self._since[pump] = (at, media)

    def _delivered(self, pump: str) -> float:
        return float(self.plant.feed.delivered_ml[0]) if pump == FEED else self.supplied_ml.get(pump, 0.0)

    def _supply(self, seconds: float) -> float:
        """Return the volume that the spare pumps supply in `seconds`, mL; backwards they supply nothing."""
        flows = dict(zip(SPARE, (self.config.pump3_ml_s, self.config.pump4_ml_s), strict=True))
        fluid = {pump: flow * max(self.motor(pump), 0) * seconds for pump, flow in flows.items()}
        self.supplied_ml = {pump: self.supplied_ml[pump] + ml for pump, ml in fluid.items()}
        return sum(fluid.values())

    def set_heat(self, duty: float, at: float) -> None:
        if duty != self.heat:
            self.sync(at)
            self.heat = duty

    def set_stirrer(self, power: float, at: float) -> None:
        if self.stir > 0.0 and power == 0.0:
            self._settled_at = at + STIR_SETTLE_S
            self._stirred_at = at
        self.stir = power if self.powered and not self.faults.stirrer_dead else 0.0

    def sync(self, at: float) -> None:
        while at - self._at > 1e-9:
            self._step(min(at - self._at, LONGEST_STEP_S))

    def _nearly_sync(self, at: float) -> None:
        """Bring the plant up to date for a sensor: up to 2 s late if no pump runs, as a culture changes slowly."""
        if self._since or at - self._at > SENSOR_STEP_S:
            self.sync(at)

    def _step(self, seconds: float) -> None:
        feed, waste = (np.array([self.motor(pump) * seconds]) for pump in (FEED, WASTE))
        pump = self.config.overflow_pump
        overflow = self.motor(pump) * seconds if pump else 0.0
        for pump in self._motors:
            self.on_s[pump] += abs(self.motor(pump)) * seconds
        thermal, plant = self.plant.config.thermal, self.plant
        heat = 1.0 if self.faults.heater_runaway and self.powered else self.heat
        minutes = seconds / 60.0
        kept = np.exp(-minutes / thermal.cooling_min)
        cooled = thermal.ambient_c + (plant.thermal.temperature - thermal.ambient_c) * kept
        still = self.stir == 0.0 and self._at + seconds - self._stirred_at > STIR_STOPPED_S
        plant.culture.stir_factor[:] = 0.0 if still else 1.0
        heated = cooled + heat * thermal.heating_c_per_min * minutes + plant.thermal.offset  # as thermometers show it
        plant.advance(minutes, feed, waste, heated, overflow, self._supply(seconds))
        self._at += seconds
        self.peak_ml = max(self.peak_ml, float(plant.vessel.volume_ml[0]))

    def temperature(self, which: str, at: float) -> float:
        """Read a thermometer, degC: IR (culture, 0.02 degC steps), Internal or External (air, 1/16 degC)."""
        self._nearly_sync(at)
        if which == "IR":
            value = float(self.plant.thermal.read()[0]) + self._rng.normal(0.0, 0.05)
            return round(value / 0.02) * 0.02
        warmed = 0.15 * (float(self.plant.thermal.temperature[0]) - AIR_C) if which == "Internal" else 0.0
        return round((AIR_C + warmed + self._rng.normal(0.0, 0.05)) * 16.0) / 16.0

    def counts(self, at: float, exposure_s: float) -> int:
        self._nearly_sync(at)
        moving = self.stir > 0.0 or at < self._settled_at
        return self.spectrometer.counts(at, exposure_s, float(self.plant.apparent_od[0]), moving)

    def fluorescence(self, at: float) -> float:
        """Return one reading of the fluorescence band, whole counts; nan if the culture does not fluoresce."""
        self._nearly_sync(at)
        return float(np.round(self.plant.read_fluorescence()[0]))

    def truth(self, at: float) -> dict[str, Any]:
        """Return the true state of the reactor at device time `at`."""
        self.sync(at)
        plant, vessel = self.plant, self.plant.vessel
        return {
            "od": float(plant.culture.od[0]), "apparent_od": float(plant.apparent_od[0]),
            "temperature": float(plant.thermal.temperature[0]), "volume_ml": float(vessel.volume_ml[0]),
            "peak_ml": self.peak_ml, "overflowed": bool(vessel.overflowed[0]),
            "feed_ml": float(plant.feed.delivered_ml[0]), "media_left_ml": float(plant.feed.media_left_ml[0]),
            "on_s": dict(self.on_s), "motors": {pump: self.motor(pump) for pump in self.on_s},
            "share": None if plant.fluorescence is None else float(plant.culture.share[0]),
            "heat": self.heat, "stir": self.stir, "powered": self.powered, "blank": self.spectrometer.blank,
        }  # fmt: skip
