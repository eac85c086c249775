"""Whether a sample came in time, and whether a working sensor can have given it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hardware.reactor import Array, Mask, Measurement
from hardware.safety.config import SafetyConfig
from hardware.safety.finding import Finding

__all__ = ["Readings"]


class Readings:
    """Age and plausibility of the newest sample of N reactors, each by itself."""

    def __init__(self, n: int, config: SafetyConfig) -> None:
        self._config = config
        self._fresh_s = np.full(n, math.nan)  # when the newest sample came
        self._seen = np.full(n, math.nan)  # its reading, believed or not
        self._repeats = np.zeros(n)  # samples in a row that were equal to the one before

    def check(self, m: Measurement, fresh: Mask, now: float) -> tuple[Mask, list[Finding]]:
        """The fresh rows whose reading may be believed, and what is wrong with the others."""
        findings = self._ages(m, fresh, now)
        c, od = self._config, m.od
        raw = m.vitals.raw if m.vitals is not None else np.full(len(fresh), math.nan)
        with np.errstate(invalid="ignore"):
            broken = fresh & ((od > 10.0) | (raw < c.raw_min))
            impossible = fresh & ~broken & ~((od > c.od_min) & (od < c.od_max) & ~(raw > c.raw_max))
            repeats = np.where(fresh, np.where(od == self._seen, self._repeats + 1, 0), self._repeats)
        self._seen, self._repeats = np.where(fresh, od, self._seen), repeats
        frozen = fresh & ~broken & ~impossible & (repeats >= c.frozen_samples - 1)
        findings += [
            Finding("spectrometer", broken, lambda i: f"OD {od[i]:.2f}, raw {raw[i]:.0f}: the light sensor failed"),
            Finding("impossible", impossible, lambda i: f"OD {od[i]:.3f}, raw {raw[i]:.0f}: outside what can be"),
            Finding("frozen", frozen, lambda i: f"OD exactly {od[i]:.6f} in {repeats[i] + 1:.0f} samples"),
        ]
        return np.asarray(fresh & ~broken & ~impossible & ~frozen, dtype=np.bool_), findings

    def _ages(self, m: Measurement, fresh: Mask, now: float) -> list[Finding]:
        """How old the newest sample is, on this computer's clock or by what the driver says, whichever is more."""
        c = self._config
        self._fresh_s = np.where(fresh | np.isnan(self._fresh_s), now, self._fresh_s)
        age = now - self._fresh_s
        if m.vitals is not None:
            age = np.maximum(age, np.where(fresh, 0.0, m.vitals.age_s))
        silent = age > 60.0 * c.silent
        lost = (age > c.lost_s) & ~silent
        stale = (age > c.stale_s) & ~lost & ~silent
        rows = {"stale": stale, "lost": lost, "silent": silent}
        return [Finding(kind, mask, lambda i: f"no new sample for {age[i]:.0f} s") for kind, mask in rows.items()]

    def state(self) -> dict[str, Array]:
        """What it remembers."""
        return {"_fresh_s": self._fresh_s, "_seen": self._seen, "_repeats": self._repeats}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Continue as saved, but for the age of the newest sample, which begins anew.

        While the program was gone nobody could have seen a sample: a reactor is stale, lost or silent only once it
        had its chance.
        """
        self._fresh_s = np.full_like(state["_fresh_s"], math.nan)
        self._seen, self._repeats = state["_seen"], state["_repeats"]
