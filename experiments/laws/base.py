"""Interface of controllers: N pump rates for N reactors, once per sample. Controllers need not inherit from it."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ControllerConfig:
    """Base class of the configs of controllers. kind: name of the controller."""

    kind: str = setting("", "controller")

    def __post_init__(self) -> None:
        check(self, "controller")


class Controller(Protocol):
    """Controller that decides one pump rate per reactor and sample.

    The same controller serves one reactor on the bench and 64 replicates in simulation. Reactors are independent:
    row i of a batch gives the same result as that reactor alone. A controller with a state lists the attributes that a
    resumed run restores in `remembers` (`hardware/memory.py`).
    """

    def reset(self, n: int) -> None:
        """Reset the state for a new run with n reactors."""

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Return the pump rates for the next control period, mL/s, shape (N,).

        Args:
          od: newest reading, shape (N,); nan without a valid reading.
          setpoint: OD to hold, shape (N,), > 0.
          minute: when the reading was taken, min since the run began, shape (N,).
          rows: True for a new and valid reading, shape (N,). Only the state of these rows may change; the returned
          values of other rows are ignored.
        It must not raise, whatever the readings.
        """


@runtime_checkable
class Explains(Protocol):
    """Controller that can explain its last decision."""

    def explain(self) -> dict[str, Array]:
        """Return the values behind the last decision, name -> array with leading axis N."""


@runtime_checkable
class Accounts(Protocol):
    """Controller that uses the volume delivered, which may differ from its decision."""

    def dosed(self, volume_ml: Array) -> None:
        """Process the volume that was delivered since the last call or deferred to the next dose, mL, shape (N,)."""


class Speeds(Protocol):
    """Estimator of how fast the OD of a culture can rise and fall (`experiments/laws/density/estimators.py`)."""

    @property
    def full_pump(self) -> Array:
        """Decrease of ln OD in one period at full pump rate, (N,)."""

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return error and growth share, (N,) each."""


@runtime_checkable
class Estimates(Protocol):
    """Controller with an estimator of growth and pump."""

    @property
    def estimator(self) -> Speeds: ...


@runtime_checkable
class Watches(Protocol):
    """Controller that uses temperatures, and every valid reading, also before the schedule begins."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Process a sample: before each `act`, with the same arguments, and in recovery. temperature: degC, or nan."""


def usable(od: Array, rows: Mask) -> Mask:
    """Return whether each row has a new reading that is not nan, (N,)."""
    return np.asarray(rows & np.isfinite(od))
