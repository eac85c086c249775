"""Checks of single samples: age, plausibility of the OD, temperature."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hardware.messages import Fault
from hardware.reactor import Array, Mask, Measurement
from hardware.safety import messages
from hardware.safety.config import RAW_MAX, RAW_MIN, SafetyConfig

FROZEN_SAMPLES = 3  # equal readings in a row that no noisy sensor gives
HOT_EXCESS_C = 2.0  # above the thermostat's target, in three samples
MAX_TEMPERATURE_C = 42.0  # the device's own limit, in two samples


@dataclass(frozen=True)
class Finding:
    """A fault, and the rows of the reactors that have it, shape (N,).

    seen: values for the fault's sentence, each a scalar or of shape (N,). cool: reactors that get a pause without
    doses, unless the fault is only reported; None: no reactor.
    """

    fault: type[Fault]
    rows: Mask
    seen: dict[str, Any]
    cool: Mask | None = None

    def of(self, n: int) -> Fault:
        return self.fault(**{k: float(v[n]) if isinstance(v, np.ndarray) else v for k, v in self.seen.items()})


class Readings:
    """Plausibility and age of the newest sample of N reactors. Args: stale_s, lost_s: age of a stale or lost sample."""

    remembers = ("_fresh_s", "_seen", "_repeats")

    def __init__(self, n: int, config: SafetyConfig, stale_s: float, lost_s: float) -> None:
        self._config, self._stale_s, self._lost_s = config, stale_s, lost_s
        self._fresh_s = np.full(n, math.nan)  # when the newest sample came
        self._seen = np.full(n, math.nan)  # its reading, valid or not
        self._repeats = np.zeros(n)  # samples in a row that were equal to the one before

    def check(self, m: Measurement, fresh: Mask, now: float) -> tuple[Mask, list[Finding]]:
        """Find the fresh rows whose reading may be used, and what is wrong with the others."""
        findings = self._ages(m, fresh, now)
        c, od, raw = self._config, m.od, self._raw(m)
        believed, broken, impossible, frozen, repeats = self._judge(m, fresh)
        self._seen, self._repeats = np.where(fresh, od, self._seen), repeats
        findings += [
            Finding(messages.SpectrometerFault, broken, {"od": od, "raw": raw}),
            Finding(messages.ImpossibleFault, impossible, {"od": od, "raw": raw, "low": c.od_min, "high": c.od_max}),
            Finding(messages.FrozenFault, frozen, {"od": od, "samples": repeats + 1.0}),
        ]
        return believed, findings

    def believed(self, m: Measurement, fresh: Mask) -> Mask:
        """Find the fresh rows whose reading `check` would accept; changes nothing."""
        return self._judge(m, fresh)[0]

    def _raw(self, m: Measurement) -> Array:
        """Return the counts; without a device, counts that pass the checks."""
        return m.vitals.raw if m.vitals is not None else np.full(len(m.od), RAW_MIN)

    def _judge(self, m: Measurement, fresh: Mask) -> tuple[Mask, Mask, Mask, Mask, Array]:
        """Return fresh rows: valid, of a failed sensor, impossible, frozen; of all rows: equal samples in a row."""
        c, od, raw = self._config, m.od, self._raw(m)
        with np.errstate(invalid="ignore"):
            broken = fresh & ((od > 10.0) | (raw < RAW_MIN))
            impossible = fresh & ~broken & ~((od > c.od_min) & (od < c.od_max) & (raw <= RAW_MAX))  # also nan
            repeats = np.where(fresh, np.where(od == self._seen, self._repeats + 1, 0), self._repeats)
        frozen = fresh & ~broken & ~impossible & (repeats >= FROZEN_SAMPLES - 1)
        believed = np.asarray(fresh & ~broken & ~impossible & ~frozen, dtype=np.bool_)
        return believed, broken, impossible, frozen, repeats

    def _ages(self, m: Measurement, fresh: Mask, now: float) -> list[Finding]:
        """Find samples that are too old, by this computer's clock or by the driver, whichever age is larger."""
        self._fresh_s = np.where(fresh | np.isnan(self._fresh_s), now, self._fresh_s)
        age = now - self._fresh_s
        if m.vitals is not None:
            age = np.maximum(age, np.where(fresh, 0.0, m.vitals.age_s))
        silent = age > 60.0 * self._config.silent
        lost = (age > self._lost_s) & ~silent
        stale = (age > self._stale_s) & ~lost & ~silent
        rows = {messages.StaleFault: stale, messages.LostFault: lost, messages.SilentFault: silent}
        return [Finding(fault, mask, {"age_s": age}) for fault, mask in rows.items()]

    def resumed(self) -> None:
        """Restart the age of the newest sample at zero: no sample could be taken while the program was stopped."""
        self._fresh_s = np.full_like(self._fresh_s, math.nan)


class Heat:
    """Temperatures of N reactors compared with their targets; heating that must be off stays off.

    A vial that still cools down to a lower target is not too hot. Impossible readings end the heating, too.
    """

    remembers = ("_target_c", "_relief_c", "_thermo_s", "_hot", "_too_hot", "_nonsense", "_heat_off")

    def __init__(self, n: int, config: SafetyConfig) -> None:
        self._config = config
        self._target_c = np.full(n, math.nan)
        self._relief_c = np.zeros(n)  # excess over the target that cooling down explains
        self._thermo_s = np.full(n, math.nan)  # when the temperature was last known
        self._hot, self._too_hot, self._nonsense = np.zeros(n), np.zeros(n), np.zeros(n)  # samples in a row
        self._heat_off = np.zeros(n)

    @property
    def off(self) -> Mask:
        """Reactors whose heating must be off, shape (N,)."""
        return np.asarray(self._heat_off > 0.0)

    def check(self, reading_c: Array, fresh: Mask, target_c: Array, now: float) -> list[Finding]:
        """Judge the temperatures of the `fresh` rows that have a target (finite `target_c`), degC, shape (N,)."""
        asked = fresh & np.isfinite(target_c)
        known = asked & np.isfinite(reading_c)
        temperature, target = np.where(known, reading_c, 37.0), np.where(known, target_c, 37.0)
        seen = np.isfinite(self._target_c)
        self._relieve(temperature, target, known, now)
        in_range = known & (temperature > 5.0) & (temperature < 70.0)
        nonsense = asked & ~in_range & (seen | known)  # also nan after a valid reading
        hot = in_range & (temperature > target + HOT_EXCESS_C + self._relief_c)
        too_hot = in_range & (temperature > MAX_TEMPERATURE_C)
        scalding = too_hot & (temperature > MAX_TEMPERATURE_C + 3.0)
        self._hot = np.where(known, np.where(hot, self._hot + 1, 0), self._hot)
        self._too_hot = np.where(known, np.where(too_hot, self._too_hot + 1, 0), self._too_hot)
        self._nonsense = np.where(asked, np.where(nonsense, self._nonsense + 1, 0), self._nonsense)
        trip = known & ((self._hot >= 3) | (self._too_hot >= 2) | scalding)
        blind = asked & (self._nonsense >= 3)
        self._heat_off = np.where(trip | blind, 1.0, self._heat_off)
        return [
            Finding(messages.HotFault, trip, {"temperature": temperature, "target": target}),
            Finding(messages.ThermometerFault, blind, {"temperature": reading_c}),
        ]

    def _relieve(self, temperature: Array, target: Array, known: Mask, now: float) -> None:
        """Raise the limit after a drop of the target, or at a run's start; the rise decays as a vial cools."""
        seen = np.isfinite(self._target_c)
        minutes = np.where(known & seen, (now - self._thermo_s) / 60.0, 0.0)
        drop = np.where(known & seen, np.maximum(self._target_c - target, 0.0), 0.0)
        relief = self._relief_c * np.exp(-minutes / self._config.cooling) + drop
        relief = np.where(seen, relief, np.maximum(temperature - target, 0.0))
        self._relief_c = np.where(known, relief, self._relief_c)
        self._target_c, self._thermo_s = np.where(known, target, self._target_c), np.where(known, now, self._thermo_s)
