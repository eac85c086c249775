"""What the control loop needs of a set of reactors, whatever stands behind it: simulation, emulator or bench.

All arrays have a leading axis of N reactors. A loop step is: `measure` (waits until at least one reactor has a new
sample), decide for the rows that are `fresh`, `actuate` those rows. `stop` is idempotent and always allowed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Command", "Measurement", "Reactor", "Receipt"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Measurement:
    """The newest sample of every reactor.

    time_s: when the OD was taken, seconds since the run began, shape (N,).
    od: optical density, shape (N,); nan where there is none.
    temperature: culture temperature, degC, shape (N,); nan where there is none.
    fresh: True where this sample was not delivered before, shape (N,).
    """

    time_s: Array
    od: Array
    temperature: Array
    fresh: Mask


@dataclass(frozen=True)
class Command:
    """What to do with the reactors of `rows`.

    rows: True for the reactors to act on (the fresh ones), shape (N,).
    pump_rate: mean feed rate over the coming control period, mL/s, shape (N,), >= 0.
    temperature: thermostat target, degC, shape (N,); nan leaves it as it is.
    """

    rows: Mask
    pump_rate: Array
    temperature: Array


@dataclass(frozen=True)
class Receipt:
    """What was done: volume of fresh medium asked of the pump for this command, mL, shape (N,); 0 outside `rows`."""

    volume_ml: Array
    notes: tuple[str, ...] = field(default=())


class Reactor(Protocol):
    """A set of N reactors that are sampled and dosed once per control period."""

    @property
    def names(self) -> tuple[str, ...]:
        """One name per reactor, e.g. ("M0", "M1")."""
        ...

    def measure(self) -> Measurement:
        """Wait for a new sample of at least one reactor.

        Raises: LinkError, ProtocolError, DeviceStateError.
        """
        ...

    def actuate(self, command: Command) -> Receipt:
        """Carry out a command. Raises: as `measure`."""
        ...

    def stop(self) -> None:
        """All pumps off, verified. Idempotent. Raises: ReactorError if they could not be verified off."""
        ...
