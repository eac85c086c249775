"""How the electronics of an emulated reactor work, and what of it is broken."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FEED", "SPARE", "WASTE", "VialConfig", "VialFaults"]

FEED, WASTE = "Pump1", "Pump2"
SPARE = ("Pump3", "Pump4")


@dataclass(frozen=True)
class VialConfig:
    """Optics and electronics of a reactor.

    blank_low, blank_high: range of the counts of clear medium, drawn once per reactor (docs/device.md, OD measurement).
    noise_fraction: sd of one reading, as a fraction of raw.
    common_fraction: sd that all readings of one measurement share, as a fraction of raw; with the defaults the mean of
      four readings has sd 0.0036 at OD 0.5 (docs/biology.md, Sensor).
    outlier_rate: probability per measurement of an isolated jump of more than 0.04 OD.
    stir_factor, stir_noise: raw while stirring, relative to still, mean and spread.
    on_time_bias_low_s, on_time_bias_high_s: how much longer than asked a pump runs (docs/device.md, Pumps).
    pump_start_low_s, pump_start_high_s: range of the time from the answer to a pump command until the motor turns,
      drawn per start: what the thread's register writes take on the bus. 0.2 to 0.7 s is what the device's own software
      took on simulated electronics with bus time.
    air_c: air outside.
    overflow_pump: pump whose tube ends a little above the waste tube (docs/chibio.md); "" = the spare pumps have no
      tubes.
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
    pump_start_low_s: float = 0.2
    pump_start_high_s: float = 0.7
    air_c: float = 24.0
    overflow_pump: str = ""

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
            "pump_start_low_s": (0.0, 5.0),
            "pump_start_high_s": (self.pump_start_low_s, 5.0),
            "air_c": (0.0, 45.0),
        }
        for key, (low, high) in ranges.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise ValueError(f"vial.{key} = {value}: allowed {low:g} to {high:g}; change it")
        if self.overflow_pump not in ("", *SPARE):
            raise ValueError(f"vial.overflow_pump = {self.overflow_pump}: allowed {', '.join(SPARE)}, or nothing")


@dataclass
class VialFaults:
    """What is broken at one reactor; may be set at any time.

    unplugged: cable out. od_frozen: the spectrometer repeats its last count. od_offset: OD added to every reading.
    od_jump: OD added to the next measurement only. spectrometer_dead: raw = 1. spectrometer_dark: raw = 0.
    spectrometer_glitch: probability that a single reading fails (raw = 1). feed_stuck_open, waste_stuck_open,
    heater_runaway: at full power whatever is commanded. stirrer_dead: does not turn.
    """

    unplugged: bool = False
    od_frozen: bool = False
    od_offset: float = 0.0
    od_jump: float = 0.0
    spectrometer_dead: bool = False
    spectrometer_dark: bool = False
    spectrometer_glitch: float = 0.0
    feed_stuck_open: bool = False
    waste_stuck_open: bool = False
    heater_runaway: bool = False
    stirrer_dead: bool = False
