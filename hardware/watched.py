"""Reactors that are only read, and their interlock, which only reports."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from hardware.messages import Fault
from hardware.reactor import Array, Command, Mask, Measurement, Reactor, Receipt
from hardware.safety.config import Response, SafetyConfig
from hardware.safety.interlock import Interlock, Ruling, kinds_of

LASTING = 3  # samples in a row until a fault is reported


@dataclass(frozen=True)
class WatchedSafety(SafetyConfig):
    """Limits for a device that the interlock cannot stop: no response is more severe than HOLD."""

    def response(self, fault: Fault | type[Fault]) -> Response:
        return min(super().response(fault), Response.HOLD)


class WatchedInterlock(Interlock):
    """Interlock of a device that is only read: reports faults that last, expects no doses. Args: as in `Interlock`."""

    def __init__(self, n: int, config: SafetyConfig, *args: Any) -> None:
        super().__init__(n, WatchedSafety(**{f.name: getattr(config, f.name) for f in fields(config)}), *args)
        self._stood: list[dict[str, int]] = [{} for _ in range(n)]

    def check(
        self, measurement: Measurement, rate: Array, setpoint: Array, temperature_target: Array, now: float
    ) -> Ruling:
        ruling = super().check(measurement, rate, setpoint, temperature_target, now)
        self.budget.grant(-ruling.rate)
        reasons = list(ruling.reasons)
        for n in np.flatnonzero(measurement.fresh):
            stood = self._stood[n] = {kind: 1 + self._stood[n].get(kind, 0) for kind in ruling.kinds[n]}
            told = [part for part in (reasons[n] or "").split(" | ") if part and stood[kinds_of(part)[0]] >= LASTING]
            reasons[n] = " | ".join(told) or None
        return replace(ruling, reasons=reasons)


class Watched(Reactor):
    """N reactors that another program regulates; `repeated` returns the doses that were seen."""

    names: tuple[str, ...] = ()

    def __init__(self, names: Sequence[str]) -> None:
        self.names, self._seen = tuple(names), list[tuple[float, Receipt]]()

    def seen(self, at_s: float, volume_ml: Array) -> None:
        """Book the volumes of doses that were seen, mL, (N,), at the run time `at_s`."""
        if (volume_ml != 0.0).any():
            self._seen.append((at_s, Receipt(volume_ml)))

    def repeated(self) -> list[tuple[float, Receipt]]:
        seen, self._seen = self._seen, []
        return seen

    def actuate(self, command: Command) -> Receipt:
        return Receipt(np.zeros(len(self.names)))

    def pumps_off(self, rows: Mask) -> list[str]:
        return []

    give_up = heat_off = pumps_off

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        return []

    def stop(self) -> None:
        """Leave everything as it is."""
