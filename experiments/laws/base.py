"""What a controller is: N reactors in, N pump rates out, once per sample. Structural; nothing has to inherit."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting

__all__ = ["Accounts", "Array", "Controller", "ControllerConfig", "Explains", "Mask", "Watches", "usable"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ControllerConfig:
    """What the config of every controller has."""

    kind: str = setting("", "controller")

    def __post_init__(self) -> None:
        check(self, "controller")


class Controller(Protocol):
    """Decides one pump rate per reactor and sample.

    The same controller serves one reactor on the bench and 64 replicates in simulation. Reactors are independent:
    row i of a batch does exactly what the controller would do for that reactor alone. One with a memory declares
    `remembers`, everything that `reset` forgets, for a resumed run (`hardware/memory.py`).
    """

    def reset(self, n: int) -> None:
        """Forget everything; from here on there are n reactors, at the start of a run."""

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Pump rates for the coming control period, mL/s, shape (N,).

        Args:
          od: newest reading, shape (N,); nan where there is none, or none that is believed.
          setpoint: OD to hold, shape (N,), > 0.
          minute: when the reading was taken, min since the run began, shape (N,).
          rows: True where the reading is new and believed, shape (N,). Only these rows' internal state advances; what
            is returned elsewhere is ignored.
        Raises: nothing for readings of any value.
        """


@runtime_checkable
class Explains(Protocol):
    """A controller that can say how it came to its last decision."""

    def explain(self) -> dict[str, Array]:
        """Name -> value of the last decision, each with leading axis N."""


@runtime_checkable
class Accounts(Protocol):
    """A controller that goes by what was really dosed, which may differ from what it decided."""

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in, or was put off to the next dose, since this was last called, mL, shape (N,)."""


class Speeds(Protocol):
    """What an estimator knows of how fast a culture goes up and down (`experiments/laws/density/estimators.py`)."""

    @property
    def full_pump(self) -> Array:
        """What one period of full pump takes off ln OD, (N,)."""

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return error and growth share, (N,) each."""


@runtime_checkable
class Estimates(Protocol):
    """A controller that estimates growth and pump."""

    @property
    def estimator(self) -> Speeds: ...


@runtime_checkable
class Watches(Protocol):
    """A controller that learns from every believed reading, also before the schedule begins, and from temperature."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Watch a sample before each `act`; arguments as there, also in recovery; temperature: degC, nan if unknown."""


def usable(od: Array, rows: Mask) -> Mask:
    """Rows with a new reading that is a number."""
    return np.asarray(rows & np.isfinite(od))
