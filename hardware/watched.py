"""Reactors that are read and cannot act: nothing that is decided here reaches them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from hardware.reactor import Array, Command, Mask, Measurement, Receipt

__all__ = ["Watched"]


class Watched(ABC):
    """N reactors that somebody else regulates, as a `Reactor`. What goes in is evidence, told by `repeated`."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.handed_over = np.zeros(len(self.names), dtype=np.bool_)
        self._seen: list[tuple[float, Receipt]] = []

    @abstractmethod
    def measure(self) -> Measurement:
        """See `Reactor.measure`."""

    @abstractmethod
    def elapsed(self) -> float:
        """See `Reactor.elapsed`."""

    def seen(self, at_s: float, volume_ml: Array) -> None:
        """Tell of doses that were seen, mL, (N,), at a run time, s."""
        if (volume_ml != 0.0).any():
            self._seen.append((at_s, Receipt(volume_ml)))

    def repeated(self) -> list[tuple[float, Receipt]]:
        """Return the doses that were seen since this was last called."""
        seen, self._seen = self._seen, []
        return seen

    def actuate(self, command: Command) -> Receipt:
        """Give nothing."""
        return Receipt(np.zeros(len(self.names)))

    def pumps_off(self, rows: Mask) -> list[str]:
        """Switch nothing."""
        return []

    give_up = heat_off = pumps_off

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand nothing over."""
        return []

    def stop(self) -> None:  # noqa: B027 (there is nothing to stop)
        """Leave everything as it is."""
