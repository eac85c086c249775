"""How the electronics of an emulated reactor work, and what of it is broken."""

from __future__ import annotations

from dataclasses import dataclass

from conf.schema import check, require, setting

__all__ = ["FEED", "SPARE", "WASTE", "VialConfig", "VialFaults"]

FEED, WASTE = "Pump1", "Pump2"
SPARE = ("Pump3", "Pump4")


@dataclass(frozen=True)
class VialConfig:
    """Optics and electronics of a reactor.

    The blank is drawn once per reactor (docs/device.md, OD measurement). With the default noise the mean of four
    readings has sd 0.0036 at OD 0.5 (docs/biology.md, Sensor). A motor's start is what the thread's register writes
    take on the bus: 0.2 to 0.7 s is what the device's own software took on simulated electronics with bus time.
    """

    blank_low: float = setting(11600.0, "least counts of clear medium", within=(3000, 60000))
    blank_high: float = setting(15800.0, "and most", at_most=60000.0)
    noise_fraction: float = setting(0.003, "sd of one reading, as a fraction of raw", within=(0, 0.2))
    common_fraction: float = setting(
        0.004, "sd that all readings of one measurement share, as a fraction of raw", within=(0, 0.2)
    )
    outlier_rate: float = setting(0.006, "per measurement: an isolated jump of more than 0.04 OD", within=(0, 1))
    stir_factor: float = setting(0.4, "raw while stirring, relative to still", within=(0.05, 1))
    stir_noise: float = setting(0.05, "its spread", within=(0, 0.5))
    on_time_bias_low_s: float = setting(
        0.02, "a pump runs at least so much longer than asked (docs/device.md, Pumps)", "s", within=(0, 1)
    )
    on_time_bias_high_s: float = setting(0.2, "and at most", "s", at_most=1.0)
    pump_start_low_s: float = setting(
        0.2, "least time from the answer to a pump command until the motor turns", "s", within=(0, 5)
    )
    pump_start_high_s: float = setting(0.7, "and most", "s", at_most=5.0)
    air_c: float = setting(24.0, "air outside", "degC", within=(0, 45))
    overflow_pump: str = setting("", "pump whose tube ends a little above the waste tube", choices=(*SPARE, ""))

    def __post_init__(self) -> None:
        check(self, "vial")
        for key, low, high in (
            ("blank_high", self.blank_low, 60000.0),
            ("on_time_bias_high_s", self.on_time_bias_low_s, 1.0),
            ("pump_start_high_s", self.pump_start_low_s, 5.0),
        ):
            require(low <= getattr(self, key), f"vial.{key}", getattr(self, key), f"{low:g} to {high:g}")


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
