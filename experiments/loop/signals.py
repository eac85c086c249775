"""Signals: the quantities that the loop controls, each with estimate, controller, actuator, columns and warnings.

The density, controlled by the feed pump, is always one of them (`Density`). A guest or an extension can add others
(`add`, docs/extending.md).
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
AIM = "aim"  # column of a recording: setpoint given to the controller; an announced change alters it in advance
PARTS = ("actuator", "columns", "sees_light", "decide", "find", "dosed", "memory")
TAKEN = ("began", "done", "stopped", "interlock", "steps", "supply", "controller", "journal_row")


@dataclass(frozen=True, eq=False)
class Sample:
    """Sample as every signal receives it; arrays (N,).

    measured: measurement of the reactors. light: valid counts of fluorescence, else nan.
    rows: reactors with a new sample. believed: those whose OD is valid.
    minute: time of the sample, min since the run began. elapsed: min since the schedule began, nan before.
    phase: step of the schedule, -1 before. setpoint: OD. temperature: the schedule's target, degC.
    following, left_min: next setpoint, and minutes until it, inf while it is not announced; both None if the schedules
      announce no change. limits: lowest and highest target of the thermostat, degC.
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
    """Report of a signal on a sample.

    columns: values for the recording, (N,) each. why: further values for the journal. warnings: a text or None for each
    reactor; empty: no warnings.
    """

    columns: Mapping[str, Array] = field(default_factory=dict)
    why: Mapping[str, Array] = field(default_factory=dict)
    warnings: Sequence[str | None] = ()


class Signal(Protocol):
    """Interface of a controlled quantity.

    name: key of its saved state. actuator: name of the actuator that it commands, "" for none. columns: columns that it
    adds to a recording; for a pair NAME and NAME_setpoint the summary has the errors of every window.
    sees_light: whether the device must measure fluorescence for it.
    """

    name: str
    actuator: str
    sees_light: bool

    @property
    def columns(self) -> tuple[str, ...]: ...

    def decide(self, sample: Sample) -> Array:
        """Process a sample; return the command to the actuator in its unit, mL/s or degC, (N,).

        The loop cuts the command to the actuator's limits. For nan the schedule's target stays; a pump then gets 0.
        """

    def find(self, sample: Sample, given: Array) -> Findings:
        """Report on the sample. Args: given: the command after the actuator's limits, in the unit of `decide`, (N,)."""

    def dosed(self, volume_ml: Array, kept_ml: Array, pump: NDArray[np.intp]) -> None:
        """Process the volume delivered since the last call, mL, (N,).

        Args: kept_ml: volume deferred to the next dose, mL, (N,). pump: number of the pump, 1 for the feed, (N,).
        """

    @property
    def memory(self) -> Remembers | None:
        """Object with the saved state, usually the signal itself; None without a state."""


Count = tuple[int, float, float, float]
"""Result of a counted sample: number of the reactor, value, its sd, and minute of the run at which it was drawn."""
Span = tuple[float, float]
Answer = tuple[str, bool]
"""Text on how a counted sample was used, and whether to show it as a warning."""


@runtime_checkable
class Knows(Protocol):
    """Signal that, in a simulation, also records the true value of its estimate."""

    def known(self, plant: Plant, flow_ml_s: float, bench: Bench) -> None:
        """Receive the simulated vials. Args: flow_ml_s: pump flow that the driver assumes, mL/s."""


@runtime_checkable
class Draws(Protocol):
    """Signal that draws figures at the end of a run."""

    def draw(self, table: Any, title: str) -> Mapping[str, Any]:
        """Return name -> figure. Args: table: recordings of the run (`experiments/record/record.py`)."""


@runtime_checkable
class Counted(Protocol):
    """Signal whose estimate uses counted samples."""

    def counted(self, n: int, value: float, sd: float, minute: float) -> Answer:
        """Use a value counted in a sample of reactor n, and its sd; return the outcome. Args: minute: of the sample."""

    def retell(self, rows: Sequence[Mapping[str, Sequence[float]]], counted: Sequence[Count], light: Span) -> None:
        """Replay data from before a resume.

        Args: rows: recorded columns of each reactor. counted: all samples. light: range of valid fluorescence counts.
        """


class Density:
    """Signal of the density, controlled by the feed pump.

    A culture of volume s V responds to the rate s u as a culture of volume V responds to u, since tau = V/60. So a
    controller with a model of volume V works for every volume if its rate is multiplied by s.

    An announced change of the setpoint begins early, so that OD is half-way when the setpoint changes (`half_way`).
    This reduces the integral of the squared error to a quarter. Meanwhile the aim is the next OD on that path, or, if
    OD lags behind the path, the next setpoint. The path uses the growth share and full pump that `law` estimates.

    Args: law: controller of the pump rate. scale: s, (N,) or one for all. max_rate: largest rate, mL/s.
      period_min: control period, min.
    Attributes: aim: setpoint last given to the controller, (N,).
    """

    name, actuator = "controller", FEED.name
    columns: tuple[str, ...] = ()  # every recording has its columns
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
        """Receive simulated vials, to record the true error e = ln(x/r)/B and the true growth share.

        Args: flow_ml_s: pump flow that the driver assumes, mL/s.
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
        for key, then in (("noted", "the policy continues"), ("alarm", "a controller with a second filter decides")):
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
    """Return 1 where the true value is within two sd of its estimate, else 0; nan where either is unknown."""
    found = {}
    for name, true in zip(ESTIMATED, TRUE, strict=True):
        if true in why:
            off = np.abs(why[name] - why[true]) / why[f"{name}_sd"]
            found[name] = np.where(np.isfinite(off), off <= 2.0, np.nan)
    return found


Make = Callable[[Any, Sequence[Scenario]], Signal]
"""Function that builds a new signal from its controller's config and the schedules, one for each reactor."""
MAKERS: dict[str, Make] = {}


def add(name: str, make: Make) -> None:
    """Register a signal for `signals.NAME.kind=KIND` of deploy; register its controllers with `signal=NAME`.

    Raises: ValueError if the name is taken.
    """
    if name in (*TAKEN, *MAKERS):
        raise NameTaken(what="signal", name=name)
    MAKERS[name] = make


def made(name: str, config: Any, schedules: Sequence[Scenario]) -> Signal:
    """Build a signal of an extension. Raises: ValueError for an unknown signal; others from the signal's `make`."""
    if name not in MAKERS:
        raise messages.NoSuchSignal(name=name, known=", ".join(MAKERS) or "those of extend=FILE.py")
    return MAKERS[name](config, schedules)


def shaped(values: Array, n: int, what: str) -> Array:
    """Return values if there is one for each of n reactors. Args: what: their name. Raises: ValueError otherwise."""
    found = np.asarray(values)
    if found.shape != (n,):
        raise messages.WrongShape(what=what, shape=found.shape, n=n)
    return found


def fitting(signals: Sequence[Signal], actuators: Sequence[Actuator]) -> list[Signal]:
    """Check that each signal's actuator exists and that no two signals use the same; return the signals.

    Raises: ValueError naming the signals, also if a signal lacks a part of the interface.
    """
    known = [actuator.name for actuator in actuators]
    for k, signal in enumerate(signals):
        missing = [part for part in PARTS if not hasattr(signal, part)]
        memory: Any = signal.memory if "memory" not in missing else None
        if memory is not None and not hasattr(memory, "remembers"):
            missing.append("memory.remembers")
        if missing:
            raise messages.PartMissing(name=signal.name, parts=", ".join(missing))
        if signal.actuator and signal.actuator not in known:
            raise messages.NoActuator(name=signal.name, actuator=signal.actuator, known=", ".join(known))
        for other in signals[:k]:
            if signal.actuator and signal.actuator == other.actuator:
                raise messages.ActuatorTaken(one=other.name, other=signal.name, actuator=signal.actuator)
    return list(signals)
