"""What a controller is: N reactors in, N pump rates out, once per sample. Structural; nothing has to inherit."""

import math
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

__all__ = ["Accounts", "Array", "Controller", "Explains", "Mask", "Remembers", "Watches", "put_back", "saved", "usable"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Controller(Protocol):
    """Decides one pump rate per reactor and sample.

    The same controller serves one reactor on the bench and 64 replicates in simulation. Reactors are independent:
    row i of a batch does exactly what the controller would do for that reactor alone.
    """

    def reset(self, n: int) -> None:
        """Forget everything; from here on there are n reactors, at the start of a run."""
        ...

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
        ...


@runtime_checkable
class Explains(Protocol):
    """A controller that can say how it came to its last decision."""

    def explain(self) -> dict[str, Array]:
        """Name -> value of the last decision, each with leading axis N."""
        ...


@runtime_checkable
class Accounts(Protocol):
    """A controller that goes by what was really dosed, which may differ from what it decided."""

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in, or was put off to the next dose, since this was last called, mL, shape (N,)."""
        ...


@runtime_checkable
class Watches(Protocol):
    """A controller that learns from every believed reading, also before the schedule begins, and from temperature."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Called before each `act`; arguments as there, `rows` also in recovery; temperature: degC, nan if unknown."""
        ...


@runtime_checkable
class Remembers(Protocol):
    """A controller with a memory, which a resumed run continues."""

    def state(self) -> dict[str, Any]:
        """Everything that `reset` forgets, as plain numbers and lists; None stands for nan."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Continue as saved. Raises: ValueError naming what is missing or does not fit."""
        ...


def saved(owner: object, names: Sequence[str]) -> dict[str, Any]:
    """The named arrays (and flags) of a controller as plain values; None stands for nan."""
    values = {name.lstrip("_"): getattr(owner, name) for name in names}
    return {name: _plain(v.tolist() if isinstance(v, np.ndarray) else v) for name, v in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def put_back(owner: object, names: Sequence[str], state: object) -> None:
    """Set what `saved` read, in the shapes and types that are there. Raises: ValueError naming what does not fit."""
    for name in names:
        key, now = name.lstrip("_"), getattr(owner, name)
        if not isinstance(state, dict) or key not in state:
            raise ValueError(f"controller.{key}: missing")
        try:
            kind = now.dtype if isinstance(now, np.ndarray) else type(now)
            numbers = np.array(state[key], dtype=np.float64)
            if kind != np.float64 and not np.isfinite(numbers).all():
                raise ValueError
            values = numbers.astype(kind)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"controller.{key}: {str(state[key])[:40]}, expected numbers") from None
        if values.shape != np.shape(now):
            raise ValueError(f"controller.{key} has shape {values.shape}, this run needs {np.shape(now)}")
        setattr(owner, name, values if isinstance(now, np.ndarray) else kind(values))


def usable(od: Array, rows: Mask) -> Mask:
    """Rows with a new reading that is a number."""
    return np.asarray(rows & np.isfinite(od))
