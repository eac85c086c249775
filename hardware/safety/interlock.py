"""The interlock between every controller and every pump: what may be dosed, and what to do when something is wrong.

Pure numerics on arrays with a leading axis of N reactors and explicit times; it touches no device. A control step is
`check` (before the dose), then `confirm` (what was really dosed). Sources: docs/device.md for limits and
signatures, docs/biology.md for what a culture, a pump and a sensor can do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.bench import Bench
from hardware import memory
from hardware.actuator import THERMOSTAT, Actuator
from hardware.messages import Fault
from hardware.reactor import Array, Mask, Measurement, Receipt
from hardware.safety import messages
from hardware.safety.budget import FeedBudget
from hardware.safety.config import DONE, MAX_SETPOINT, Response, SafetyConfig
from hardware.safety.fluorescence import Light
from hardware.safety.messages import PAUSES
from hardware.safety.readings import Finding, Heat, Readings
from hardware.safety.unexplained_change import UnexplainedChange


@dataclass(frozen=True)
class Ruling:
    """The interlock's decision on one step.

    rate: allowed feed rate, mL/s, shape (N,); 0 for every row that is not fresh or is held.
    response: a `Response` per reactor, shape (N,).
    reasons: per reactor one line with reasons, actions and remedies, or None.
    faults: per reactor the faults that were found.
    heat_off: reactors whose heating must be off, shape (N,).
    setpoint: valid target for the on-board regulation, OD, shape (N,).
    """

    rate: Array
    response: NDArray[np.int64]
    reasons: list[str | None]
    faults: tuple[tuple[Fault, ...], ...]
    heat_off: Mask
    setpoint: Array

    @property
    def kinds(self) -> tuple[tuple[str, ...], ...]:
        return tuple(tuple(fault.kind for fault in faults) for faults in self.faults)


class Interlock:
    """Interlock between controllers and pumps of N reactors: collects the findings of its five parts, then decides.

    Args: bench: volume, period and largest rate. tube_ml: volume at each waste tube, mL, (N,); None: the bench's
      volume. rim_ml: capacity of a vial, mL, one value or (N,).
    Attributes: budget: the ledger of feed and level.
    """

    remembers = ("_hold_until_s", "_hold_kind", "_latched")

    def __init__(
        self,
        n: int,
        config: SafetyConfig | None = None,
        bench: Bench | None = None,
        tube_ml: Array | None = None,
        rim_ml: Array | float = math.inf,
    ) -> None:
        self.bench = bench or Bench()
        self.n, self.config = n, config or SafetyConfig()
        tube = np.full(n, self.bench.volume_ml) if tube_ml is None else tube_ml
        self.budget = FeedBudget(self.config, self.bench, tube, np.minimum(tube + self.config.overflow_ml, rim_ml))
        self._readings = Readings(n, self.config, *self.config.ages_s(self.bench))
        self._change = UnexplainedChange(self.config, self.bench.max_rate, tube)
        self._heat = Heat(n, self.config)
        self._light = Light(n, self.config)
        self._parts = (self.budget, self._readings, self._change, self._heat, self._light)
        self._cut: dict[str, Finding] = {}  # commands out of range, until `check` reports them
        self._hold_until_s = np.full(n, -math.inf)
        self._hold_kind = np.full(n, -1.0)  # index into PAUSES
        self._latched = np.zeros(n)  # least `Response` for the rest of the run

    def check(
        self, measurement: Measurement, rate: Array, setpoint: Array, temperature_target: Array, now: float
    ) -> Ruling:
        """Judge the newest samples and the proposed feed rates. Raises: nothing; the faults are in the ruling.

        Args: measurement: newest samples. rate: proposed feed rate, mL/s, shape (N,); only rows with a fresh sample
          count. setpoint: OD, (N,). temperature_target: degC, (N,), nan without a thermostat. now: monotonic time, s.
        """
        rate, setpoint = np.array(rate, dtype=np.float64), np.array(setpoint, dtype=np.float64)
        target_c = np.asarray(temperature_target, dtype=np.float64)
        fresh = np.asarray(measurement.fresh, dtype=np.bool_)
        believed, of_readings = self._readings.check(measurement, fresh, now)
        of_changes = self._change.check(measurement.od, measurement.time_s, believed, setpoint)
        of_heat = self._heat.check(measurement.temperature, fresh, target_c, now)
        sound = (setpoint > 0.0) & (setpoint <= MAX_SETPOINT)
        of_setpoint = Finding(messages.SetpointFault, ~sound, {"setpoint": setpoint, "most": MAX_SETPOINT})
        allowed, of_rates = self.budget.check(rate, fresh, now)
        found = self._reported(measurement)
        of_light = self._light.check(measurement, now)
        findings = [*of_readings, *of_changes, *of_heat, of_setpoint, *of_rates, *of_light, *self._cut.values()]
        self._cut = {}
        self._collect(found, findings, now)
        self._add_holds(found, fresh, now)
        return self._conclude(found, allowed, np.where(sound, np.clip(setpoint, 0.05, None), 0.5))

    def believes(self, measurement: Measurement) -> Mask:
        """Return rows whose fresh reading is valid for control, shape (N,); called before `check`, changes nothing.

        A reading after an unexplained step is valid only if the response to `jump` is report.
        """
        believed = self._readings.believed(measurement, np.asarray(measurement.fresh, dtype=np.bool_))
        if self.config.response(messages.JumpFault) is Response.PASS:
            return believed
        return believed & self._change.takes(measurement.od, measurement.time_s, believed)

    def fluorescence(self, measurement: Measurement) -> Array | None:
        """Return valid fresh counts, else nan, shape (N,), or None; called before `check`, changes nothing."""
        return self._light.believed(measurement)

    def command(self, actuator: Actuator, asked: Array) -> Array:
        """Cut a signal's commands, (N,), to the limits of an actuator; nan stays. The next `check` reports a cut."""
        low, high = actuator.low, actuator.high
        if actuator.pump:
            low, high = 0.0, self.bench.max_rate
        elif actuator == THERMOSTAT:
            low, high = self.config.targets
        asked = np.asarray(asked, dtype=np.float64)
        allowed = np.clip(asked, low, high)
        seen = {"actuator": actuator.name, "asked": asked, "unit": actuator.unit, "low": low, "high": high}
        cut = ~np.isnan(asked) & (allowed != asked)
        self._cut[actuator.name] = Finding(messages.CommandLimitFault, cut, seen)
        return np.asarray(allowed)

    def _reported(self, m: Measurement) -> list[list[Fault]]:
        faults = m.vitals.faults if m.vitals is not None else (None,) * self.n
        return [[fault] if fault is not None else [] for fault in faults]

    def _collect(self, found: list[list[Fault]], findings: Sequence[Finding], now: float) -> None:
        """Add the findings to each reactor's faults; some findings start a pause without doses."""
        told = [[fault.kind for fault in faults] for faults in found]  # by the reactor, with more detail
        for finding in findings:
            for i in np.flatnonzero(finding.rows):
                found[i] += [finding.of(int(i))] if finding.fault.kind not in told[i] else []
            if finding.cool is not None and self.config.response(finding.fault) is not Response.PASS:
                pause = next(k for k, pause in enumerate(PAUSES) if pause.kind == finding.fault.kind)
                self._hold_until_s = np.where(finding.cool, now + 60.0 * self.config.cooldown, self._hold_until_s)
                self._hold_kind = np.where(finding.cool, float(pause), self._hold_kind)

    def _add_holds(self, found: list[list[Fault]], fresh: Mask, now: float) -> None:
        for i in np.flatnonzero(fresh & (now < self._hold_until_s)):
            pause = PAUSES[int(self._hold_kind[i])]
            if pause.kind not in [fault.kind for fault in found[i]]:
                found[i].append(pause(minutes=float(self._hold_until_s[i] - now) / 60.0))

    def _conclude(self, found: list[list[Fault]], allowed: Array, setpoint: Array) -> Ruling:
        """Choose the most severe response per reactor, at least the latched one."""
        response = np.array([max(map(self._response, faults), default=0) for faults in found], dtype=np.int64)
        self._latched = np.where(response >= Response.REGULATE, np.maximum(self._latched, response), self._latched)
        response = np.maximum(response, self._latched.astype(np.int64))
        lines: list[str | None] = []
        for faults, code in zip(found, response, strict=True):
            texts = [fault.line(DONE[self._response(fault)]) for fault in faults]
            if not texts and code >= Response.REGULATE:
                texts = [f"{DONE[Response(code)]} earlier in this run"]
            lines.append(" | ".join(texts) or None)
        rate = np.where(response == Response.PASS, allowed, 0.0)
        self.budget.grant(rate)
        return Ruling(rate, response, lines, tuple(map(tuple, found)), self._heat.off, setpoint)

    def _response(self, fault: Fault) -> Response:
        """Return the response to a fault; the pause after a fault only holds."""
        return Response.HOLD if isinstance(fault, PAUSES) else self.config.response(fault)

    def confirm(self, receipt: Receipt, now: float) -> None:
        """Book the receipt of a command at `now`, s; without a waste volume the level is taken to stay at the tube."""
        feed = np.asarray(receipt.volume_ml, dtype=np.float64)
        waste = np.full(self.n, math.inf) if receipt.waste_ml is None else np.asarray(receipt.waste_ml)
        self.budget.book(feed, waste, now)
        self._change.dosed(feed, feed if receipt.low_ml is None else np.asarray(receipt.low_ml))

    def refilled(self, row: int, bottle_ml: float) -> None:
        """Set the bottle's volume after a refill and end the pause that an empty bottle caused."""
        self.budget.bottle_ml[row] = self.budget.fed_ml[row] + bottle_ml
        self._change.refilled(row)
        if self._hold_kind[row] == PAUSES.index(messages.NoDilutionPause):
            self._hold_until_s[row] = -math.inf

    def latch(self, response: Response, rows: Mask) -> None:
        """Respond with at least `response` to `rows`, shape (N,), for the rest of the run."""
        self._latched = np.where(rows, np.maximum(self._latched, float(response)), self._latched)

    def state(self) -> dict[str, Any]:
        """Return the interlock's state as plain lists. Its times are those given to `check`: pass run time there."""
        return {key: value for part in (*self._parts, self) for key, value in memory.save(part).items()}

    def restore(self, state: Any) -> None:
        """Restore the output of `state` into an unused interlock. Raises: ValueError for what does not fit."""
        if isinstance(state, dict) and (other := set(state) ^ set(self.state())):
            raise ValueError(f"interlock: its saved state has other fields: {', '.join(sorted(other))[:80]}")
        for part in (*self._parts, self):
            memory.restore(part, state, "interlock")
        for key, codes in (("_latched", list(Response)), ("_hold_kind", range(-1, len(PAUSES)))):
            if not np.isin(getattr(self, key), np.array(codes)).all():
                raise ValueError(f"interlock.{key}: {state[key]}, no such code")


def kinds_of(text: str) -> list[str]:
    """List the fault kinds in a line of the interlock."""
    return [kind for kind, colon, _ in (part.partition(": ") for part in text.split(" | ")) if colon]
