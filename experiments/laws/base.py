"""Interface of a controller: N pump rates for N reactors, once per sample. A structural type without inheritance."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ControllerConfig:
    """Common config of every controller."""

    kind: str = setting("", "controller")

    def __post_init__(self) -> None:
        check(self, "controller")


class Controller(Protocol):
    """Controller of one pump rate per reactor and sample.

    The same controller serves one reactor on the bench and 64 replicates in simulation. Reactors are independent:
    row i of a batch gives the same result as that reactor alone. A controller with a memory declares it in `remembers`,
    for a resumed run (`hardware/memory.py`).
    """

    def reset(self, n: int) -> None:
        """Forget everything; start a run with n reactors."""

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Return the pump rates for the next control period, mL/s, shape (N,).

        Args:
          od: newest reading, shape (N,); nan without a valid one.
          setpoint: OD to hold, shape (N,), > 0.
          minute: when the reading was taken, min since the run began, shape (N,).
          rows: True for a new and valid reading, shape (N,). Only these rows' internal state advances; other returned
          values are ignored.
        Raises: nothing for readings of any value.
        """


@runtime_checkable
class Explains(Protocol):
    """A controller that can explain its last decision."""

    def explain(self) -> dict[str, Array]:
        """Return name -> value of the last decision, each with leading axis N."""


@runtime_checkable
class Accounts(Protocol):
    """A controller that uses the volume delivered, which may differ from its decision."""

    def dosed(self, volume_ml: Array) -> None:
        """Take the volume delivered, or carried over to the next dose, since the last call, mL, shape (N,)."""


class Speeds(Protocol):
    """Estimates of how fast the OD of a culture can rise and fall (`experiments/laws/density/estimators.py`)."""

    @property
    def full_pump(self) -> Array:
        """Decrease of ln OD in one period at full pump rate, (N,)."""

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return error and growth share, (N,) each."""


@runtime_checkable
class Estimates(Protocol):
    """A controller that estimates growth and pump."""

    @property
    def estimator(self) -> Speeds: ...


@runtime_checkable
class Watches(Protocol):
    """A controller that uses every valid reading, also before the schedule begins, and temperatures."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Watch a sample before each `act`; arguments as there, also in recovery; temperature: degC, nan if unknown."""


def usable(od: Array, rows: Mask) -> Mask:
    """Rows with a new reading that is a number."""
    return np.asarray(rows & np.isfinite(od))
