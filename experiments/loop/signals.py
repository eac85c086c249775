"""What the loop holds: signals. Each has an estimate, a law that decides, an actuator, columns and warnings of its own.

The density, held by the feed pump, is always one of them (`Density`). Another is brought by a guest, or made known by
`add` (docs/extending.md).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from conf.messages import NameTaken
from envs.bench import Bench
from envs.plant.plant import Plant
from envs.preview import half_way
from envs.scenario import Scenario
from experiments.laws.base import Accounts, Array, Controller, Estimates, Explains, Mask, Watches
from experiments.loop import messages
from hardware.actuator import FEED, Actuator
from hardware.memory import Remembers
from hardware.reactor import Measurement
from hardware.safety.interlock import Interlock

TRUE = ("true_error", "true_growth_share")
ESTIMATED = ("error", "growth_share")
AIM = "aim"  # column of a recording: the setpoint that the controller is given, which an announced change moves ahead
PARTS = ("actuator", "columns", "sees_light", "decide", "find", "dosed", "memory")
TAKEN = ("began", "done", "stopped", "interlock", "steps", "supply", "controller", "journal_row")


@dataclass(frozen=True, eq=False)
class Sample:
    """What every signal is shown of a sample; arrays (N,).

    measured: by the reactors. light: counts of its fluorescence that are believed, nan for all others.
    rows: reactors with a new sample; believed: those whose OD is taken for the culture's.
    minute: when it was taken, min since the run began. elapsed: min since the schedule began, nan before.
    phase: of the schedule, -1 before. setpoint: OD asked for. temperature: the schedule's target, degC.
    following, left_min: the setpoint after it and the minutes until then, inf where it is not known yet; None where no
      change is known ahead.
    limits: lowest and highest target of the thermostat, degC.
    """

    measured: Measurement
    light: Array
    rows: Mask
    believed: Mask
    minute: Array
    elapsed: Array
    phase: NDArray[np.intp]
    setpoint: Array
    temperature: Array
    limits: tuple[float, float]
    following: Array | None = None
    left_min: Array | None = None

    @classmethod
    def of(
        cls, m: Measurement, interlock: Interlock, rows: Mask, believed: Mask, elapsed: Array, phase: NDArray[np.intp],
        setpoint: Array, temperature: Array, ahead: tuple[Array, Array] | None = None,
    ) -> "Sample":  # fmt: skip
        """Build a sample: measurement, its valid fluorescence (else nan) and the interlock's temperature limits."""
        light, safety = interlock.fluorescence(m), interlock.config
        light = np.full(m.od.shape, np.nan) if light is None else light
        limits = safety.targets
        schedule = elapsed, phase, setpoint, temperature, limits, *(ahead or ())
        return cls(m, light, rows, believed, m.time_s / 60.0, *schedule)


@dataclass(frozen=True, eq=False)
class Findings:
    """What a signal reports for a sample.

    columns: of the recording, (N,) each. why: further reasons for the journal. warnings: a line for each reactor that
    has one, None for the others; empty: no warnings.
    """

    columns: Mapping[str, Array] = field(default_factory=dict)
    why: Mapping[str, Array] = field(default_factory=dict)
    warnings: Sequence[str | None] = ()


class Signal(Protocol):
    """A quantity that is held, structurally.

    name: under which its state is saved. actuator: name of what acts on it, "" for nothing. columns: that it adds to a
    recording, behind those of signals before it. Of a column NAME and one NAME_setpoint the summary gives the errors of
    every window. sees_light: whether it needs the fluorescence, which the device then measures.
    """

    name: str
    actuator: str
    sees_light: bool

    @property
    def columns(self) -> tuple[str, ...]: ...

    def decide(self, sample: Sample) -> Array:
        """Watch a sample and decide on a command, (N,), in the unit of the actuator: mL/s, degC.

        It is cut to the actuator's limits; one that is nan leaves the schedule's, and means 0 to a pump.
        """

    def find(self, sample: Sample, given: Array) -> Findings:
        """Report on the sample. Args: given: the command to the actuator as cut, in the unit of `decide`, (N,)."""

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        """Take what went in since this was last called, and what was put off to the next dose, mL, (N,).

        Args: pump: number of the pump that gave it, 1 for the feed, (N,).
        """

    @property
    def memory(self) -> Remembers | None:
        """What a resumed run continues, the signal itself as a rule; None where there is nothing to remember."""


Count = tuple[int, float, float, float]
"""What was counted in a sample: number of the reactor, value, its sd, minute of the run at which it was drawn."""
Span = tuple[float, float]
Answer = tuple[str, bool]
"""The outcome of a sample as text, and whether that is a warning."""


@runtime_checkable
class Knows(Protocol):
    """A signal that, in a simulation, also records the true value of its estimate."""

    def known(self, plant: Plant, flow_ml_s: float, bench: Bench) -> None:
        """Take the vials themselves. Args: flow_ml_s: of a pump as the driver takes it."""


@runtime_checkable
class Draws(Protocol):
    """A signal with its own figures."""

    def draw(self, table: Any, title: str) -> Mapping[str, Any]:
        """Draw them, by name, at the end of a run. Args: table: its recordings (`experiments/record/record.py`)."""


@runtime_checkable
class Counted(Protocol):
    """A signal that learns from counted samples."""

    def counted(self, n: int, value: float, sd: float, minute: float) -> Answer:
        """Take what was counted of reactor n at a minute of the run, with its sd; return what came of it."""

    def retell(self, rows: Sequence[Mapping[str, Sequence[float]]], counted: Sequence[Count], light: Span) -> None:
        """Replay what was recorded before a resume: columns of each reactor, and every sample.

        Args: light: lowest and highest valid counts of fluorescence.
        """


class Density:
    """The density, held by the feed pump.

    A culture of volume s V answers to a rate s u as one of V does to u, since tau = V/60. So a law whose model is of V
    decides for every volume.

    A change of the setpoint that is known ahead is begun so early that OD is half-way when it comes (`half_way`): the
    integral of the squared error is a quarter of what it is without. The aim is the next setpoint where OD lags behind
    that way, else the way's next OD, by growth share and full pump as the law estimates them.

    Args: law: decides on the pump rate; what it can do beyond is asked of it. scale: s, (N,) or one for all.
      max_rate: largest rate, mL/s. period_min: control period.
    Attributes: aim: setpoint that the law was given last, (N,).
    """

    name, actuator = "controller", FEED.name
    columns: tuple[str, ...] = ()  # the recording has them in any case
    sees_light = False

    def __init__(
        self,
        law: Controller,
        scale: Array | float = 1.0,
        max_rate: float = math.inf,
        period_min: float = 1.0,
    ) -> None:
        self.law, self._scale, self._max_rate, self._period_min = law, scale, max_rate, period_min
        self.aim = np.empty(0)
        self.truth: Callable[[Array], tuple[Array, Array]] | None = None

    def known(self, plant: Plant, flow_ml_s: float, bench: Bench) -> None:
        """In a simulation: e = ln(x/r)/B and the share of the full pump at which the culture rests are known.

        Args: flow_ml_s: of a pump as the driver takes it.
        """
        most_s = 60.0 * bench.control_min * bench.max_rate * self._scale / flow_ml_s

        def truth(setpoint: Array) -> tuple[Array, Array]:
            full, share = plant.at_rest(bench.control_min, most_s)
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.log(plant.apparent_od / setpoint) / full, share

        self.truth = truth

    def decide(self, sample: Sample) -> Array:
        m = sample.measured
        if isinstance(self.law, Watches):
            self.law.watch(m.od, m.temperature, sample.minute, sample.believed)
        od, self.aim = np.where(sample.rows & ~sample.believed, np.nan, m.od), self._aim(sample)
        rate = self.law.act(od, self.aim, sample.minute, sample.believed & (sample.phase >= 0))
        return np.where(np.equal(self._scale, 1.0), rate, np.minimum(rate * self._scale, self._max_rate))

    def _aim(self, sample: Sample) -> Array:
        if sample.following is None or sample.left_min is None or not isinstance(self.law, Estimates):
            return sample.setpoint
        full, (error, share) = self.law.estimator.full_pump, self.law.estimator.relative(sample.setpoint)
        now, left = (sample.setpoint, sample.following), sample.left_min / self._period_min
        here, ahead = (half_way(*now, left - later, full, share) for later in (0.0, 1.0))
        behind = np.sign(sample.following - sample.setpoint) * (error * full - np.log(here / sample.setpoint)) < 0.0
        return np.where(behind & (ahead != sample.setpoint), sample.following, ahead)

    def find(self, sample: Sample, given: Array) -> Findings:
        why = self.law.explain() if isinstance(self.law, Explains) else {}
        if self.truth is not None and "growth_share" in why:
            why = {**why, **dict(zip(TRUE, self.truth(self.aim), strict=True))}
        warnings: list[str | None] = [None] * sample.rows.size
        for key, then in (("noted", "the policy goes on"), ("alarm", "the controller on a second filter decides")):
            for n in np.flatnonzero(why.get(key, np.zeros(sample.rows.size)) * (sample.believed & (sample.phase >= 0))):
                warnings[n] = messages.FilterAlarm(then=then).line("reported")
        return Findings(why=why, warnings=warnings if any(warnings) else ())

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        if isinstance(self.law, Accounts):
            self.law.dosed((volume_ml + kept_ml) / self._scale)

    @property
    def memory(self) -> Remembers | None:
        return self.law if isinstance(self.law, Remembers) else None


def within_2sd(why: Mapping[str, Array]) -> dict[str, Array]:
    """Where each estimate lies within two of its own sd of the truth: 1 or 0, nan where either is not known."""
    found = {}
    for name, true in zip(ESTIMATED, TRUE, strict=True):
        if true in why:
            off = np.abs(why[name] - why[true]) / why[f"{name}_sd"]
            found[name] = np.where(np.isfinite(off), off <= 2.0, np.nan)
    return found


Make = Callable[[Any, Sequence[Scenario]], Signal]
"""From a law's config and the schedules, one for each reactor, to a signal that has seen nothing."""
MAKERS: dict[str, Make] = {}


def add(name: str, make: Make) -> None:
    """Make a signal known as `signals.NAME.kind=LAW` of deploy; its laws are registered with `signal=NAME`.

    Raises: ValueError for a name that is taken.
    """
    if name in (*TAKEN, *MAKERS):
        raise NameTaken(what="signal", name=name)
    MAKERS[name] = make


def made(name: str, config: Any, schedules: Sequence[Scenario]) -> Signal:
    """Build a signal of an extension. Raises: ValueError naming the signals there are, or what does not fit."""
    if name not in MAKERS:
        raise messages.NoSuchSignal(name=name, known=", ".join(MAKERS) or "those of extend=FILE.py")
    return MAKERS[name](config, schedules)


def shaped(values: Array, n: int, what: str) -> Array:
    """Check that there is one value for each reactor; return them. Raises: ValueError naming what they are."""
    found = np.asarray(values)
    if found.shape != (n,):
        raise messages.WrongShape(what=what, shape=found.shape, n=n)
    return found


def fitting(signals: Sequence[Signal], actuators: Sequence[Actuator]) -> list[Signal]:
    """Check that each signal acts by something that the reactors have, and no two by the same; return them.

    Raises: ValueError naming the signals, and what there is, or what a signal lacks.
    """
    known = [actuator.name for actuator in actuators]
    for k, signal in enumerate(signals):
        if missing := [part for part in PARTS if not hasattr(signal, part)]:
            raise messages.PartMissing(name=signal.name, parts=", ".join(missing))
        if signal.actuator and signal.actuator not in known:
            raise messages.NoActuator(name=signal.name, actuator=signal.actuator, known=", ".join(known))
        for other in signals[:k]:
            if signal.actuator and signal.actuator == other.actuator:
                raise messages.ActuatorTaken(one=other.name, other=signal.name, actuator=signal.actuator)
    return list(signals)
