"""The closed loop, the same for simulation, emulator and bench: measure, decide, guard, actuate, record.

It is a generator of what happened; clocks and wires are the reactors', files and screens are the caller's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from envs.setpoints import Schedule
from experiments.controllers.base import Array, Controller, Explains, Mask
from hardware.reactor import Command, Measurement, Reactor, Receipt

__all__ = ["ClosedLoop", "Guard", "RateLimit", "Step", "Verdict"]


@dataclass(frozen=True)
class Verdict:
    """What the guard allows.

    rate: mL/s, shape (N,). reasons: why it differs from what was proposed, or None; N entries.
    """

    rate: Array
    reasons: tuple[str | None, ...]


class Guard(Protocol):
    """Stands between every controller and every pump."""

    def check(self, measurement: Measurement, setpoint: Array, proposed: Array) -> Verdict:
        """The allowed pump rates. Raises: SafetyTrip where the run must end."""
        ...

    def confirm(self, receipt: Receipt) -> None:
        """Account for what was really dosed."""
        ...


class RateLimit:
    """The smallest guard: rates within [0, maximum], nothing on a reading that is no number.

    Args: maximum: mL/s.
    """

    def __init__(self, maximum: float) -> None:
        self.maximum = maximum

    def check(self, measurement: Measurement, setpoint: Array, proposed: Array) -> Verdict:
        """Clamp, and say so. Raises: nothing."""
        rate = np.where(np.isfinite(measurement.od) & np.isfinite(proposed), np.clip(proposed, 0.0, self.maximum), 0.0)
        changed = rate != proposed
        reasons = tuple(
            f"pump rate {p:.4f} mL/s limited to {r:.4f}" if c else None
            for p, r, c in zip(proposed, rate, changed, strict=True)
        )
        return Verdict(rate, reasons)

    def confirm(self, receipt: Receipt) -> None:
        """Nothing to account for."""


@dataclass(frozen=True, eq=False)
class Step:
    """One pass through the loop; arrays (N,), to be read where `rows` is True.

    minute: when the OD was measured, since the run began. elapsed: since the schedule began, nan in recovery.
    phase: of the schedule, -1 in recovery. proposed and rate: before and after the guard, mL/s.
    volume_ml: asked of the pump. reasons: of the guard. explanation: of the controller. done: schedule over.
    """

    rows: Mask
    minute: Array
    elapsed: Array
    phase: NDArray[np.intp]
    od: Array
    temperature: Array
    setpoint: Array
    proposed: Array
    rate: Array
    volume_ml: Array
    reasons: tuple[str | None, ...]
    explanation: dict[str, Array]
    done: Mask


@dataclass
class ClosedLoop:
    """Controller x guard x reactors over a schedule, for N reactors that may be sampled at different moments.

    Each reactor first recovers (grows undiluted until `schedule.recovery_od`), then runs the schedule on its own time.
    """

    reactors: Reactor
    controller: Controller
    guard: Guard
    schedule: Schedule
    began: Array = field(init=False)  # minute at which each reactor's schedule began; nan while it recovers
    done: Mask = field(init=False)

    def __post_init__(self) -> None:
        """Start everywhere in recovery."""
        n = len(self.reactors.names)
        self.began = np.full(n, np.nan)
        self.done = np.zeros(n, dtype=np.bool_)
        self.controller.reset(n)

    def run(self) -> Iterator[Step]:
        """Go on until every reactor's schedule is over. Raises: ReactorError."""
        while not self.done.all():
            yield self.step()

    def step(self) -> Step:
        """One measurement of at least one reactor, and the commands that follow from it."""
        m = self.reactors.measure()
        rows = m.fresh & ~self.done
        minute = m.time_s / 60.0
        recovered = (m.od >= self.schedule.recovery_od) | (minute >= self.schedule.recovery_limit_min)
        self.began = np.where(rows & np.isnan(self.began) & recovered, minute, self.began)
        elapsed = minute - self.began
        phase = self.schedule.phase(elapsed)
        setpoint, temperature = self.schedule.at(elapsed)
        self.done = self.done | (rows & (elapsed >= self.schedule.total_min - 1e-6))

        decided = self.controller.act(m.od, setpoint, minute, rows & (phase >= 0))
        proposed = np.where((phase >= 0) & ~self.done, decided, 0.0)
        verdict = self.guard.check(m, setpoint, proposed)
        receipt = self.reactors.actuate(Command(rows, verdict.rate, temperature))
        self.guard.confirm(receipt)
        explanation = self.controller.explain() if isinstance(self.controller, Explains) else {}
        return Step(
            rows, minute, elapsed, phase, m.od, m.temperature, setpoint, proposed, verdict.rate, receipt.volume_ml,
            verdict.reasons, explanation, self.done.copy(),
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Where each reactor's schedule stands; plain numbers."""
        return {"began": self.began.tolist(), "done": self.done.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue as saved."""
        self.began[:] = state["began"]
        self.done[:] = state["done"]
