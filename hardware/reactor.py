"""What the control loop needs of a set of reactors, whatever stands behind it: simulation, emulator or bench.

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
    """State of a device beside the sample.

    age_s: time since the newest sample arrived, by this computer's monotonic clock, shape (N,).
    raw: spectrometer counts of the newest sample, shape (N,); nan is an invalid reading.
    faults: what is wrong with each reactor, or None; N entries.
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
    """What to do with the reactors of `rows`.

    rows: True for the reactors to act on (the fresh ones), shape (N,).
    pump_rate: mean feed rate over the coming control period, mL/s, shape (N,), >= 0.
    temperature: thermostat target, degC, shape (N,); nan leaves it as it is.
    pump: number of the pump that gives the dose, 1 (the feed), 3 or 4, shape (N,); None: the feed everywhere.
    targets: of actuators of a family's own, by name, each (N,); nan leaves one as it is.
    """

    rows: Mask
    pump_rate: Array
    temperature: Array
    pump: NDArray[np.intp] | None = None
    targets: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Receipt:
    """What was done.

    volume_ml: fresh medium asked of the pumps for this command, mL, shape (N,); 0 outside `rows`. It is what the
      pump was really told: less than the command where a limit cut it or a small dose was put off to the next.
    notes: what differs from the command, one line each.
    waste_ml: what the waste pump was told to be able to remove, mL, shape (N,); None where waste is not modelled.
    pump: number of the spare pump that gave it, of a repetition; 0 for the feed, and where the command says it.
    kept_ml: by how much what is put off to the next dose has grown, mL, shape (N,), negative where that was given or
      lost; None where nothing is put off.
    low_ml: the least that volume_ml can have been, mL, shape (N,); None: exactly that.
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
        """Reactors that the device's own regulation has been given for good, shape (N,); by default none."""
        return np.zeros(len(self.names), dtype=np.bool_)

    def measure(self) -> Measurement:
        """Wait for a new sample of at least one reactor, or, when none comes in time, return with none fresh.

        Trouble with single reactors is told in `vitals`, so that the others go on.
        Raises: ReactorError for what no waiting can mend.
        """

    def actuate(self, command: Command) -> Receipt:
        """Carry out a command. Raises: as `measure`."""

    def repeated(self) -> list[tuple[float, Receipt]]:
        """Return what was given beyond the receipts, or less where negative: run time, s, and volumes, in order."""
        return []

    def elapsed(self) -> float:
        """Run time, s, on a monotonic clock; what `Measurement.time_s` is counted on."""

    def pumps_off(self, rows: Mask) -> list[str]:
        """All pumps that feed or empty `rows` off, verified; returns what failed, one line per reactor, name first."""

    def give_up(self, rows: Mask) -> list[str]:
        """`pumps_off` for the rest of the run, the device's own regulation too; returns what failed, as `pumps_off`."""
        return self.pumps_off(rows)

    def heat_off(self, rows: Mask) -> list[str]:
        """Heating of `rows` off for the rest of the run; returns what failed, as `pumps_off`."""

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand `rows` over to the device's own regulation at `setpoint` (OD, (N,)); returns what failed."""

    def stop(self) -> None:
        """All pumps off, verified. Idempotent. Raises: ReactorError if they could not be verified off."""


@runtime_checkable
class KeepsLevels(Protocol):
    """Reactors that keep a ledger of their own, by which they refuse doses."""

    def set_level(self, n: int, level_ml: float) -> None:
        """Put the ledger of reactor n to a volume, as soon as it answers."""


@contextmanager
def left_off(reactors: Reactor) -> Iterator[None]:
    """Leave all pumps off and verified where this context ends by an error or a stop. Raises: that; NotLeftOff."""
    try:
        yield
    except BaseException as error:
        try:
            reactors.stop()
        except ReactorError as failed:
            raise NotLeftOff(why=str(error) or "stopped", failed=failed) from error
        log.info("ended before the run began: pumps verified off")
        raise
