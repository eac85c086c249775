"""The closed loop for simulation, emulator and device: measure, decide, check, actuate.

It yields a record of each step. The reactors own clocks and connections; the caller owns files and screen.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.plant.plant import Plant
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.laws.base import Array, Controller, Estimates, Mask
from experiments.laws.density.estimators import WithEstimator
from experiments.loop.progress import Progress
from experiments.loop.signals import AIM, Answer, Count, Counted, Density, Knows, Sample, Signal, fitting, shaped
from experiments.loop.supply import Supply
from hardware import memory
from hardware.actuator import FEED, SPARE, THERMOSTAT, Actuator
from hardware.memory import Remembers
from hardware.reactor import Command, KeepsLevels, Reactor, Receipt
from hardware.safety.config import RAW_MAX, Response
from hardware.safety.interlock import Interlock, Ruling

OURS = (THERMOSTAT, *SPARE.values())  # actuators with own fields in a Command; others are in it by name


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """Record of one pass through the loop; arrays (N,).

    rows: reactors with a new sample; the other attributes are valid only for these. now_s: run time, s.
    minute: time of the OD measurement, min since the run began. elapsed: min since the schedule began, nan in recovery.
    phase: step of the schedule, -1 in recovery. proposed, rate: pump rate before and after the interlock, mL/s.
    volume_ml: volume requested from the pump, plus volumes that the device repeated since the last row; nan until the
    dose has begun. reasons: alarms of the interlock and warnings of signals, one text or None per reactor.
    response: the interlock's response. notes: texts of the reactors. explanation: values that explain the decision.
    done: whether the schedule is over. columns: further columns of the recording, from signals.
    raw, blank: sensor counts of the OD reading and of clear medium; nan where unknown.
    pump: pump of the dose: 1 (feed), 3 or 4. believed: rows whose OD the interlock accepts as valid.
    position: each reactor's position in its schedule, as `ClosedLoop.position` returns it. ended: rows whose sample
      met the condition that ends a step.
    """

    now_s: float
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
    reasons: Sequence[str | None]
    response: NDArray[np.int64]
    notes: Sequence[str]
    explanation: dict[str, Array]
    done: Mask
    columns: dict[str, Array] = field(default_factory=dict)
    position: Sequence[dict[str, Any]] = ()
    ended: Mask | None = None
    raw: Array | None = None
    blank: Array | None = None
    pump: NDArray[np.intp] | None = None
    believed: Mask | None = None


class ClosedLoop:
    """Closed loop of N reactors with signals, interlock and schedules. Reactors may be sampled at different times.

    Each reactor first recovers: it grows to `recovery_od`, or beyond and is diluted to it. Then the schedule begins.
    A reading that the interlock rejects starts no schedule and is not shown to the controller.

    Args:
      reactors, interlock: for N reactors. controller: decides the feed pump's rate.
      schedules: one per reactor, or one for all.
      at_end: what a reactor does when its schedule is over and others are not; one per reactor, or one for all: "hold"
        (keep the last setpoint), "stop" (no more doses) or "regulate" (hand over to the device's own regulation).
      before_dose: function that receives each decided step before any dose; it writes the journal.
      scale: volume of each culture divided by that of the controller's model, as in `Density`.
      further: signals other than the density. The command of a signal replaces that of the schedule.
      actuators: all actuators of the reactors.
      model: growth model of an estimator that is added if changes are announced and the controller has no estimator.
    Raises: ValueError if the numbers of schedules and reactors differ, if two signals use the same actuator, or if a
      signal needs an actuator that the reactors do not have.
    """

    remembers = ("began", "done", "stopped")

    def __init__(
        self,
        reactors: Reactor,
        controller: Controller,
        interlock: Interlock,
        schedules: Sequence[Scenario] | Scenario,
        before_dose: Callable[[Step], None] | None = None,
        at_end: Sequence[str] | str = "stop",
        further: Sequence[Signal] = (),
        scale: Array | float = 1.0,
        actuators: Sequence[Actuator] = (FEED, THERMOSTAT),
        model: EnvConfig = EnvConfig(),  # noqa: B008 (frozen)
    ) -> None:
        n = len(reactors.names)
        self.reactors, self.interlock = reactors, interlock
        self.schedules = [schedules] * n if isinstance(schedules, Scenario) else list(schedules)
        if len(self.schedules) != n:
            raise ValueError(f"{len(self.schedules)} schedules: allowed one for each of the {n} reactors")
        self.progress = Progress(self.schedules)
        if self.progress.announced and not isinstance(controller, Estimates):
            controller = WithEstimator(controller, model)
        self.density = Density(controller, scale, interlock.bench.max_rate, interlock.bench.control_min)
        self.signals = fitting([self.density, *further], actuators)
        by_name = {actuator.name: actuator for actuator in actuators}
        self._commanded = [(signal, by_name[signal.actuator]) for signal in further if signal.actuator]
        self._before_dose = before_dose
        self._at_end = np.array([at_end] * n if isinstance(at_end, str) else list(at_end))
        asked = [actuator.pump for _, actuator in self._commanded if actuator.pump]
        self.supply = Supply(self.schedules, interlock.bench.max_rate * interlock.bench.period_s, asked)
        self.began = np.full(n, np.nan)  # minute at which each reactor's schedule began
        self.done = np.zeros(n, dtype=np.bool_)
        self.stopped = np.zeros(n, dtype=np.bool_)  # given up by the interlock, with pumps verified off
        self.repeated_ml = np.zeros(n)  # volumes that devices repeated and no step contains yet
        self.gone = np.zeros(n, dtype=np.bool_)  # given up and absent, so its pumps cannot be verified off
        controller.reset(n)

    def known(self, plant: Plant, flow_ml_s: float) -> None:
        """Give the signals access to the simulated vials. Args: flow_ml_s: pump flow that the driver assumes, mL/s."""
        for signal in self.signals:
            if isinstance(signal, Knows):
                signal.known(plant, flow_ml_s, self.interlock.bench)

    def run(self) -> Iterator[Step]:
        """Yield steps until every reactor's schedule is over or the reactor was given up. Raises: ReactorError."""
        while not self.over:
            yield self.step()

    @property
    def over(self) -> bool:
        """Whether every reactor's schedule is over, or the reactor was given up."""
        return bool((self.done | self.stopped | self.gone).all())

    def step(self) -> Step:
        """Wait for a sample of at least one reactor, decide, dose, and return the step. Raises: ReactorError."""
        m = self.reactors.measure()
        now = self.reactors.elapsed()
        self._book_repeats()
        rows = m.fresh & ~(self.done & (self._at_end == "stop")) & ~self.stopped
        minute = m.time_s / 60.0
        believed = rows & self.interlock.believes(m)
        recovered, dilutes = self.progress.recover(minute, m.od, believed)
        self.began = np.where(rows & np.isnan(self.began) & recovered, minute, self.began)
        elapsed = minute - self.began
        ended = self.progress.watch(elapsed, m.od, believed)
        phase, setpoint, temperature = self.progress.asked(elapsed)
        self.done = self.done | (rows & (elapsed >= self.progress.totals - 1e-6))

        ahead = self.progress.following(elapsed) if self.progress.announced else None
        sample = Sample.of(m, self.interlock, rows, believed, elapsed, phase, setpoint, temperature, ahead)
        decided, commands = self.density.decide(sample), self._commands(sample)
        temperature = commands.get(THERMOSTAT.name, temperature)
        steered = believed & (phase >= 0)
        proposed = np.where(steered & ~(self.done & (self._at_end != "hold")), decided, 0.0)
        proposed = np.where(dilutes & np.isnan(self.began), self.interlock.bench.max_rate, proposed)
        pump, extra_ml = self.supply.due(elapsed, phase, steered & ~self.done)
        proposed = np.where(pump == 1, proposed, extra_ml / self.interlock.bench.period_s)
        verdict = self.interlock.check(m, proposed, self.density.aim, temperature, now)
        sound = rows & (verdict.response == Response.PASS)  # the device's regulation uses the same sensor
        left = self.done & (self._at_end == "regulate") & sound
        self.interlock.latch(Response.REGULATE, left)
        columns, explanation, reasons = self._findings(sample, commands, verdict)
        decision = Step(
            now_s=now,
            rows=rows,
            minute=minute,
            elapsed=elapsed,
            phase=phase,
            od=m.od,
            temperature=m.temperature,
            setpoint=setpoint,
            proposed=proposed,
            rate=verdict.rate,
            volume_ml=np.full(len(self.done), np.nan),
            reasons=reasons,
            response=verdict.response,
            notes=(),
            explanation=explanation,
            done=self.done.copy(),
            columns=columns,
            position=[self.position(n) for n in range(len(self.done))],
            ended=ended,
            raw=None if m.vitals is None else m.vitals.raw,
            blank=None if m.vitals is None else m.vitals.blank,
            pump=pump,
            believed=believed,
        )
        if self._before_dose is not None:
            self._before_dose(decision)
        faults = m.vitals.faults if m.vitals is not None else (None,) * len(self.done)
        absent = np.array([fault is not None and fault.kind == "absent" for fault in faults])
        self.gone = absent & (verdict.response == Response.STOP)
        failures = self._respond(verdict, left)
        heat = np.where(verdict.heat_off, np.nan, temperature)
        own = {actuator.name: commands[actuator.name] for _, actuator in self._commanded if actuator not in OURS}
        receipt = self.reactors.actuate(Command(rows, verdict.rate, heat, pump, own))
        self.supply.given(pump, receipt.volume_ml)
        self.book(receipt, now, pump)
        volume = receipt.volume_ml + np.where(rows, self.repeated_ml, 0.0)
        self.repeated_ml = np.where(rows, 0.0, self.repeated_ml)
        return replace(decision, volume_ml=volume, notes=(*failures, *receipt.notes))

    def _commands(self, sample: Sample) -> dict[str, Array]:
        """Let all signals except the density decide; return actuator -> command within the interlock's limits."""
        commands: dict[str, Array] = {}
        for signal, actuator in self._commanded:
            asked = shaped(signal.decide(sample), len(self.done), f"signal {signal.name}: what decide returns")
            command = self.interlock.command(actuator, asked)
            if actuator == THERMOSTAT:
                command = np.where(np.isfinite(command), command, sample.temperature)
            elif actuator.pump:
                self.supply.ask(actuator.pump, command)
            commands[actuator.name] = command
        return commands

    def _findings(
        self, sample: Sample, commands: Mapping[str, Array], verdict: Ruling
    ) -> tuple[dict[str, Array], dict[str, Array], Sequence[str | None]]:
        """Collect the signals' findings on a sample: columns, explanations, and warnings joined to the alarms."""
        columns: dict[str, Array] = {AIM: self.density.aim} if self.progress.announced else {}
        why: dict[str, Array] = {}
        reasons: Sequence[str | None] = verdict.reasons
        for signal in self.signals:
            found = signal.find(sample, commands.get(signal.actuator, verdict.rate))
            for name, values in found.columns.items():
                shaped(values, len(self.done), f"signal {signal.name}: {name}")
            columns, why = columns | dict(found.columns), why | dict(found.why)
            if found.warnings:
                reasons = [" | ".join(filter(None, both)) or None for both in zip(reasons, found.warnings, strict=True)]
        return columns, why, reasons

    def _book_repeats(self) -> None:
        """Book doses that the devices repeated by themselves, at their own times, before the sample is judged."""
        for at_s, receipt in self.reactors.repeated():
            pump = np.full(len(self.done), receipt.pump or FEED.pump)
            self.book(receipt, at_s, pump)
            self.supply.given(pump, receipt.volume_ml)
            self.repeated_ml = self.repeated_ml + receipt.volume_ml

    def book(self, receipt: Receipt, at_s: float, pump: NDArray[np.intp]) -> None:
        """Report a dose to the interlock and every signal. Args: at_s: run time, s. pump: number of the pump, (N,)."""
        self.interlock.confirm(receipt, at_s)
        kept_ml = np.zeros(len(self.done)) if receipt.kept_ml is None else receipt.kept_ml
        for signal in self.signals:
            signal.dosed(receipt.volume_ml, kept_ml, pump)

    def set_level(self, name: str, level_ml: float) -> float:
        """Set a vial's level, mL, in the ledger of interlock and device to a measured value; return the old level."""
        n, ledger = self.reactors.names.index(name), self.interlock.budget.volume_ml
        before, ledger[n] = float(ledger[n]), level_ml
        if isinstance(self.reactors, KeepsLevels):
            self.reactors.set_level(n, level_ml)
        return before

    def refilled(self, name: str, bottle_ml: float) -> None:
        """Set the volume, mL, of a reactor's bottle after a refill."""
        self.interlock.refilled(self.reactors.names.index(name), bottle_ml)

    def counted(self, name: str, value: float, sd: float, minute: float) -> Answer:
        """Pass a counted sample to the signal that uses it; return the outcome. Args: minute: when it was drawn."""
        for signal in self.signals:
            if isinstance(signal, Counted):
                return signal.counted(self.reactors.names.index(name), value, sd, minute)
        return "ignored: no estimator uses this measurement", True

    def retell(self, rows: Sequence[Mapping[str, Sequence[float]]], counted: Sequence[Count]) -> None:
        """Replay earlier recordings and counted samples to every signal that uses them, after a resume."""
        for signal in self.signals:
            if isinstance(signal, Counted):
                signal.retell(rows, counted, (self.interlock.config.light_min, RAW_MAX))

    def _respond(self, verdict: Ruling, left: Mask) -> list[str]:
        """Carry out the interlock's responses, such as pumps off or heat off; return the failures, which are retried.

        Args: left: reactors to hand over to the device's own regulation now, (N,).
        """
        failed: list[str] = []
        off = verdict.response == Response.PUMPS_OFF
        stop = (verdict.response == Response.STOP) & ~self.stopped
        if off.any():
            failed += self.reactors.pumps_off(off)
        if stop.any():
            failed += self.reactors.give_up(stop)
            unsure = [any(line.startswith(f"{name}:") for line in failed) for name in self.reactors.names]
            self.stopped = self.stopped | (stop & ~np.array(unsure))
        regulate = (left | (verdict.response == Response.REGULATE)) & ~self.reactors.handed_over
        if regulate.any():
            failed += self.reactors.regulate(regulate, verdict.setpoint)
        if verdict.heat_off.any():
            failed += self.reactors.heat_off(verdict.heat_off)
        return failed

    def position(self, n: int) -> dict[str, Any]:
        """Return reactor n's position in its schedule, as plain numbers for the journal."""
        return {"began": float(self.began[n]), **memory.row(self.progress, n), **memory.row(self.supply, n)}

    def state(self) -> dict[str, Any]:
        """Return the state of schedules, interlock and signals, as plain numbers and lists to save."""
        state = memory.save(self) | {"interlock": self.interlock.state()}
        state |= {key: found for key, part in self._rows.items() if (found := memory.rows(part))}
        kept = {signal.name: signal.memory for signal in self.signals}
        return state | {name: memory.save(one) for name, one in kept.items() if one is not None}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a saved state; None stands for nan. Raises: ValueError for a part that is missing or does not fit."""
        memory.restore(self, state, "loop")
        for key, part in self._rows.items():
            memory.restore_rows(part, state.get(key, "missing"), key)
        self.interlock.restore(state.get("interlock", "missing"))
        for signal in self.signals:
            if signal.memory is not None:
                memory.restore(signal.memory, state.get(signal.name, "missing"), signal.name)

    @property
    def _rows(self) -> dict[str, Remembers]:
        return {"steps": self.progress, "supply": self.supply}
