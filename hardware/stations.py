"""Reactors that are commanded one by one: what every such family does alike with rows, doses and receipts."""

from collections.abc import Mapping, Sequence
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from hardware.clock import Clock
from hardware.errors import ReactorError
from hardware.logbook import Log, Logbook
from hardware.reactor import Command, Receipt
from hardware.storage.doses import Given

__all__ = ["Stations"]


class Plan(Protocol):
    """What was begun, mL."""

    @property
    def feed_ml(self) -> float: ...
    @property
    def waste_ml(self) -> float: ...


class Doses(Protocol):
    """carry_ml: put off to the next dose. extra: what was given beyond what was booked when doses began."""

    extra: list[Given]

    @property
    def carry_ml(self) -> float: ...


class Station(Protocol):
    """One reactor."""

    book: Logbook

    @property
    def name(self) -> str: ...
    @property
    def doses(self) -> Doses: ...

    def set_temperature(self, target_c: float, /) -> None: ...

    def dose(self, rate: float, number: int, /) -> Plan: ...


S = TypeVar("S", bound=Station)


class Stations(Generic[S]):
    """N reactors, each at its station.

    Args: clock: of the run. log: takes rows, e.g. `Journal.append`. What must be on the disk before it is done is
      written first, so a log that raises there prevents it; elsewhere its error is kept, and raised by `raise_late`.
    """

    stations: Sequence[S]

    def __init__(self, clock: Clock, log: Log) -> None:
        self._clock, self._log, self._zero = clock, log, clock.now()
        self._log_error: Exception | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """One per reactor, e.g. ("M0", "M1")."""
        return tuple(station.name for station in self.stations)

    def elapsed(self) -> float:
        """Run time, s: counted from `begin`, together with what had passed before."""
        return self._clock.now() - self._zero

    def actuate(self, command: Command) -> Receipt:
        """Begin one dose per row of `command.rows`, targets first; its end is carried out by `measure`.

        Raises: what the log raises when an intent cannot be written (then nothing is dosed); ValueError for a rate
          that is negative or not finite. Trouble with device or link becomes a note.
        """
        volume, waste, kept = (np.zeros(len(self.stations)) for _ in range(3))
        for i, station in enumerate(self.stations):
            if command.rows[i]:
                station.set_temperature(float(command.temperature[i]))
                before_ml = station.doses.carry_ml
                plan = station.dose(float(command.pump_rate[i]), 1 if command.pump is None else int(command.pump[i]))
                volume[i], waste[i] = plan.feed_ml, plan.waste_ml
                kept[i] = station.doses.carry_ml - before_ml
                self._between()
        notes = tuple(f"{station.name}: {note}" for station in self.stations for note in station.book.notes)
        for station in self.stations:
            station.book.notes.clear()
        return Receipt(volume, notes, waste, kept)

    def _between(self) -> None:
        """What is due between two reactors."""

    def repeated(self) -> list[tuple[float, Receipt]]:
        """What was given beyond what was booked when doses began, not told before: run time, s, and volumes."""
        found = []
        for i, station in enumerate(self.stations):
            mine = np.arange(len(self.stations)) == i
            extra, station.doses.extra = station.doses.extra, []
            found += [
                (g.at_s, Receipt(mine * g.feed_ml, (), mine * g.waste_ml, pump=g.pump, low_ml=mine * g.low_ml))
                for g in extra
            ]
        return sorted(found, key=lambda one: one[0])

    def raise_late(self) -> None:
        """Raises: what the log raised where it must not stand in the way of a pump-off; once."""
        error, self._log_error = self._log_error, None
        if error is not None:
            raise error

    def write(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Write a row. Raises: what the log raises."""
        self._log(kind, {"time_s": round(self.elapsed(), 3), **fields})

    def note_down(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Write a row without ever standing in the way of a pump-off."""
        try:
            Stations.write(self, kind, fields)
        except (OSError, ReactorError) as error:
            self._log_error = error
