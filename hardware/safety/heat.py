"""Too hot, where a vial that still cools down to a lower target is not; a thermometer that reads nonsense."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hardware.reactor import Array, Mask
from hardware.safety.config import SafetyConfig
from hardware.safety.finding import Finding

__all__ = ["Heat"]


class Heat:
    """Temperatures of N reactors against their targets; once heating must be off, it stays so."""

    def __init__(self, n: int, config: SafetyConfig) -> None:
        self._config = config
        self._target_c = np.full(n, math.nan)
        self._relief_c = np.zeros(n)  # how far above the target cooling down still explains
        self._thermo_s = np.full(n, math.nan)  # when the temperature was last known
        self._hot, self._too_hot, self._nonsense = np.zeros(n), np.zeros(n), np.zeros(n)  # samples in a row
        self._off = np.zeros(n)

    @property
    def off(self) -> Mask:
        """Reactors whose heating must be off, shape (N,)."""
        return np.asarray(self._off > 0.0)

    def check(self, reading_c: Array, fresh: Mask, target_c: Array, now: float) -> list[Finding]:
        """Judge the temperatures of the `fresh` rows that have a target (finite `target_c`), degC, shape (N,)."""
        c = self._config
        asked = fresh & np.isfinite(target_c)
        known = asked & np.isfinite(reading_c)
        temperature, target = np.where(known, reading_c, 37.0), np.where(known, target_c, 37.0)
        seen = np.isfinite(self._target_c)
        self._relieve(temperature, target, known, now)
        in_range = known & (temperature > 5.0) & (temperature < 70.0)
        nonsense = asked & ~in_range & (seen | known)  # a thermometer that falls silent, too
        hot = in_range & (temperature > target + c.hot_excess + self._relief_c)
        too_hot = in_range & (temperature > c.max_temperature)
        scalding = too_hot & (temperature > c.max_temperature + 3.0)
        self._hot = np.where(known, np.where(hot, self._hot + 1, 0), self._hot)
        self._too_hot = np.where(known, np.where(too_hot, self._too_hot + 1, 0), self._too_hot)
        self._nonsense = np.where(asked, np.where(nonsense, self._nonsense + 1, 0), self._nonsense)
        trip = known & ((self._hot >= 3) | (self._too_hot >= 2) | scalding)
        blind = asked & (self._nonsense >= 3)
        self._off = np.where(trip | blind, 1.0, self._off)
        return [
            Finding("hot", trip, lambda i: f"{temperature[i]:.1f} degC, target {target[i]:.1f}: heating off"),
            Finding("thermometer", blind, lambda i: f"reads {reading_c[i]:.1f} degC: heating off"),
        ]

    def _relieve(self, temperature: Array, target: Array, known: Mask, now: float) -> None:
        """A drop of the target is relief, which decays with the cooling time; so is what a run finds at its start."""
        seen = np.isfinite(self._target_c)
        minutes = np.where(known & seen, (now - self._thermo_s) / 60.0, 0.0)
        drop = np.where(known & seen, np.maximum(self._target_c - target, 0.0), 0.0)
        relief = self._relief_c * np.exp(-minutes / self._config.cooling) + drop
        relief = np.where(seen, relief, np.maximum(temperature - target, 0.0))
        self._relief_c = np.where(known, relief, self._relief_c)
        self._target_c, self._thermo_s = np.where(known, target, self._target_c), np.where(known, now, self._thermo_s)

    def state(self) -> dict[str, Array]:
        """What it remembers."""
        return {
            "_target_c": self._target_c, "_relief_c": self._relief_c, "_thermo_s": self._thermo_s,
            "_hot": self._hot, "_too_hot": self._too_hot, "_nonsense": self._nonsense,
            "_heat_off": self._off,
        }  # fmt: skip

    def restore(self, state: Mapping[str, Array]) -> None:
        """Continue as saved."""
        self._target_c, self._relief_c, self._thermo_s = state["_target_c"], state["_relief_c"], state["_thermo_s"]
        self._hot, self._too_hot, self._nonsense = state["_hot"], state["_too_hot"], state["_nonsense"]
        self._off = state["_heat_off"]
