"""Interface of the control loop to a set of reactors: a simulation, an emulator or the bench.

All arrays have a leading axis of N reactors. A loop step is: `measure` (waits until at least one reactor has a new
sample), decide for the rows that are `fresh`, `actuate` those rows. `stop` is idempotent and always allowed.
"""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hardware.errors import ReactorError
from hardware.messages import Fault, NotLeftOff

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Vitals:
    """State of a device, apart from the sample.

    age_s: time since the newest sample arrived, by this computer's monotonic clock, shape (N,).
    raw: spectrometer counts of the newest sample, shape (N,); nan is an invalid reading.
    faults: the fault of each reactor, or None; N entries.
    blank: counts that read as OD 0 when that sample was taken, shape (N,); None where the device has none.
    """

    age_s: Array
    raw: Array
    faults: tuple[Fault | None, ...]
    blank: Array | None = None


@dataclass(frozen=True)
class Measurement:
    """The newest sample of every reactor.

    time_s: when the OD was taken, seconds since the run began, shape (N,).
    od: optical density, shape (N,); nan where there is none.
    temperature: culture temperature, degC, shape (N,); nan where there is none.
    fresh: True where this sample was not delivered before, shape (N,).
    vitals: state of the device; None for a backend that cannot fail.
    fluorescence: counts of one band, on the Chi.Bio the base times the first emission of a slot, shape (N,); nan where
      there is none; None where it is not measured.
    """

    time_s: Array
    od: Array
    temperature: Array
    fresh: Mask
    vitals: Vitals | None = None
    fluorescence: Array | None = None


@dataclass(frozen=True)
class Command:
    """Commands to the reactors of `rows`.

    rows: True for the reactors to act on (the fresh ones), shape (N,).
    pump_rate: mean feed rate over the coming control period, mL/s, shape (N,), >= 0.
    temperature: thermostat target, degC, shape (N,); nan leaves a target unchanged.
    pump: number of the pump that gives the dose, 1 (the feed), 3 or 4, shape (N,); None: the feed everywhere.
    targets: commands to a family's own actuators, by name, each (N,); nan leaves a target unchanged.
    """

    rows: Mask
    pump_rate: Array
    temperature: Array
    pump: NDArray[np.intp] | None = None
    targets: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Receipt:
    """Volumes that a command, or a repetition of its dose, gave.

    volume_ml: fresh medium requested from the pumps, mL, shape (N,); 0 outside `rows`. It is less than commanded where
      a limit cut the dose or a small dose is kept for the next.
    notes: differences from the command, one line each.
    waste_ml: volume that the waste pump can remove in its time, mL, shape (N,); None if waste is not modelled.
    pump: number of the spare pump that gave a repetition; 0: the feed pump, or the pump of the command.
    kept_ml: change of the volume that is kept for the next dose, mL, shape (N,), negative where it was given or lost;
      None if no volume is kept.
    low_ml: smallest volume that may have been given, mL, shape (N,); None: volume_ml.
    """

    volume_ml: Array
    notes: tuple[str, ...] = field(default=())
    waste_ml: Array | None = None
    kept_ml: Array | None = None
    pump: int = 0
    low_ml: Array | None = None


class Reactor(Protocol):
    """A set of N reactors that are sampled and dosed once per control period."""

    @property
    def names(self) -> tuple[str, ...]:
        """One name per reactor, e.g. ("M0", "M1")."""

    @property
    def handed_over(self) -> Mask:
        """Reactors that were handed over to the device's own regulation, shape (N,); by default none."""
        return np.zeros(len(self.names), dtype=np.bool_)

    def measure(self) -> Measurement:
        """Wait for a new sample of at least one reactor; if no sample comes in time, return without a fresh one.

        Faults of single reactors are in `vitals`, so that the others continue.
        Raises: ReactorError for a permanent error.
        """

    def actuate(self, command: Command) -> Receipt:
        """Carry out a command. Raises: as `measure`."""

    def repeated(self) -> list[tuple[float, Receipt]]:
        """Return volumes given beyond the receipts, negative if less was given, with run times, s, in order."""
        return []

    def elapsed(self) -> float:
        """Return the run time, s, on the monotonic clock of `Measurement.time_s`."""

    def pumps_off(self, rows: Mask) -> list[str]:
        """Switch all feed and waste pumps of `rows` off, verified; return failures, a line per reactor, name first."""

    def give_up(self, rows: Mask) -> list[str]:
        """End all dosing of `rows` for this run, also by the device's regulation; return failures as `pumps_off`."""
        return self.pumps_off(rows)

    def heat_off(self, rows: Mask) -> list[str]:
        """Switch the heating of `rows` off for the rest of the run; return failures as `pumps_off`."""

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand `rows` over to the device's own regulation at `setpoint` (OD, (N,)); return failures as `pumps_off`."""

    def stop(self) -> None:
        """Switch all pumps off, verified. Idempotent. Raises: ReactorError if they could not be verified off."""


@runtime_checkable
class KeepsLevels(Protocol):
    """Reactors that keep their own ledger of the vials and refuse doses by it."""

    def set_level(self, n: int, level_ml: float) -> None:
        """Set the ledger of reactor n to a volume as soon as the reactor answers."""


@contextmanager
def left_off(reactors: Reactor) -> Iterator[None]:
    """Switch all pumps off, verified, if this context ends by an error or a stop. Raises: that error; NotLeftOff."""
    try:
        yield
    except BaseException as error:
        try:
            reactors.stop()
        except ReactorError as failed:
            raise NotLeftOff(why=str(error) or "stopped", failed=failed) from error
        log.info("ended before the run began: pumps verified off")
        raise
