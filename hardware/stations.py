"""Reactors that are commanded one by one: measuring, dosing and stopping, as all families with a device share them.

A family gives a `Station` per reactor, and a subclass of `Stations` with its work between two stations and in a wait.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from hardware.clock import Clock
from hardware.errors import ReactorError
from hardware.logbook import Log, Logbook
from hardware.messages import PumpsNotOff
from hardware.reactor import Array, Command, Mask, Measurement, Receipt, Vitals, left_off
from hardware.storage.history import History

AGAIN_S = 20.0  # between two returns of `measure` while no samples come


class Newest:
    """The newest sample of one reactor; nan where there is none.

    Attributes: at: clock time at which it was taken, s. od. temperature: degC. raw, blank: counts; blank is None if the
      device has none. fluorescence: counts, None if it is not measured. arrived_s: clock time from which its age
      counts. next_look: clock time of the next look at the reactor.
    """

    def __init__(self, now: float) -> None:
        self.at = self.od = self.temperature = self.raw = math.nan
        self.blank: float | None = None
        self.fluorescence: float | None = None
        self.arrived_s, self.next_look = now, -math.inf


@dataclass(frozen=True)
class Plan:
    """A planned dose, mL. carry_ml: requested volume kept for the next dose, as the pump cannot deliver so little."""

    feed_ml: float = 0.0
    waste_ml: float = 0.0
    carry_ml: float = 0.0


class Station(Protocol):
    """One reactor. A method that switches off or hands over may return a generator, whose steps the family then runs.

    Attributes: doses: has carry_ml, volume kept for the next dose, and extra, volumes given beyond those booked when
      doses began. sampling: the newest sample. regulated_od: OD at which the reactor was handed over to the device's
      own regulation, nan while this program controls.
    """

    name: str
    book: Logbook
    doses: Any
    sampling: Any
    regulated_od: float = math.nan

    @property
    def handed_over(self) -> bool:
        """Whether the device's own regulation controls the reactor for the rest of the run."""
        return math.isfinite(self.regulated_od)

    def poll(self) -> bool: ...

    def set_temperature(self, target_c: float, /) -> None: ...

    def dose(self, rate: float, number: int, /) -> Plan: ...

    def pumps_off(self) -> Any: ...

    def give_up(self) -> Any: ...

    def heat_off(self) -> Any: ...

    def regulate(self, setpoint: float, /) -> Any: ...


S = TypeVar("S", bound=Station)
H = TypeVar("H", bound=History)


class Stations(Generic[S, H]):
    """N reactors, each at its station (implements `hardware.reactor.Reactor`).

    Use: `begin` (or `begin(replay(rows), elapsed_s)` after a crash), then `measure` and `actuate` in turn, `stop` in
    any case.

    Args: clock: the run's clock. stale_s: time without a sample after which `measure` returns, s. log: takes samples,
      intents, doses, commands, faults and notes, e.g. `Journal.append`. An intent is written before its dose, so an
      error of the log prevents the dose; any other error of the log is kept, and raised by `raise_late`.
    """

    stations: Sequence[S]

    def __init__(self, clock: Clock, stale_s: float, log: Log) -> None:
        self._clock, self._stale_s, self._log, self._zero = clock, stale_s, log, clock.now()
        self._log_error: Exception | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(station.name for station in self.stations)

    @property
    def handed_over(self) -> Mask:
        return np.array([station.handed_over for station in self.stations])

    def elapsed(self) -> float:
        return self._clock.now() - self._zero

    def begin(self, histories: Mapping[str, H] | None = None, elapsed_s: float = 0.0) -> None:
        """Start every reactor; if this fails or is stopped, switch all pumps off, or report those that may be on.

        Args: histories: `replay` of the resumed run's journal. elapsed_s: run time since the run began, s.
        Raises: ReactorError if a reactor cannot be started. A resumed run raises it only if no reactor can be started:
          it reports a failed reactor and tries it again.
        """
        self._zero = self._clock.now() - elapsed_s
        with left_off(self):
            self._take_over(histories or {})

    def _take_over(self, histories: Mapping[str, H]) -> None:
        """Restore every reactor, then start it. Raises: as `begin`."""
        raise NotImplementedError

    def measure(self) -> Measurement:
        """Wait for a new sample, run the tasks that are due meanwhile, and return the newest samples.

        Returns without a fresh sample if a fault appears or disappears, or if no reactor had a sample for `stale_s`
        (then every 20 s); the faults are in `vitals`.
        Raises: what the log raised; nothing for errors of device or link.
        """
        last = max(station.sampling.arrived_s for station in self.stations)
        deadline = max(last + self._stale_s, self._clock.now() + AGAIN_S)
        fresh = np.zeros(len(self.stations), dtype=np.bool_)
        while True:
            self._between()
            for i, station in enumerate(self.stations):
                if self._clock.now() >= station.sampling.next_look:
                    fresh[i] = station.poll()
                    self._between()
            self.raise_late()
            now = self._clock.now()
            if fresh.any() or now >= deadline or any(station.book.news for station in self.stations):
                return self._measurement(fresh)
            self._wait(min([deadline, *(station.sampling.next_look for station in self.stations)]) - now)

    def _between(self) -> None: ...

    def _wait(self, longest_s: float) -> None:
        raise NotImplementedError

    def _measurement(self, fresh: Mask) -> Measurement:
        newest: list[Newest] = [station.sampling for station in self.stations]

        def column(key: str) -> Array:
            return np.array([getattr(one, key) for one in newest], dtype=np.float64)

        def column_or_none(key: str) -> Array | None:
            return None if any(getattr(one, key) is None for one in newest) else column(key)

        for station in self.stations:
            station.book.news = False
        faults = tuple(station.book.fault for station in self.stations)
        vitals = Vitals(self._clock.now() - column("arrived_s"), column("raw"), faults, column_or_none("blank"))
        time_s, light = column("at") - self._zero, column_or_none("fluorescence")
        return Measurement(time_s, column("od"), column("temperature"), fresh, vitals, light)

    def actuate(self, command: Command) -> Receipt:
        """Set the targets of `command.rows` and begin one dose for each row; `measure` ends the doses.

        Raises: what the log raises when an intent cannot be written (then nothing is dosed); ValueError for a rate
          that is negative or not finite. An error of device or link becomes a note.
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

    def repeated(self) -> list[tuple[float, Receipt]]:
        """Return volumes given beyond those booked when doses began, each once: run time, s, and receipt."""
        found = []
        for i, station in enumerate(self.stations):
            mine = np.arange(len(self.stations)) == i
            extra, station.doses.extra = station.doses.extra, []
            found += [
                (g.at_s, Receipt(mine * g.feed_ml, (), mine * g.waste_ml, pump=g.pump, low_ml=mine * g.low_ml))
                for g in extra
            ]
        return sorted(found, key=lambda one: one[0])

    def pumps_off(self, rows: Mask) -> list[str]:
        """Switch off, verified, all pumps of `rows` that a run switches; return the failures, one line per reactor."""
        return self._each(rows, lambda station: station.pumps_off())

    def give_up(self, rows: Mask) -> list[str]:
        return self._each(rows, lambda station: station.give_up())

    def heat_off(self, rows: Mask) -> list[str]:
        return self._each(rows, lambda station: station.heat_off())

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand `rows` over to the device's own regulation at `setpoint`, OD, (N,); return the failures."""
        targets = dict(zip(self.names, setpoint, strict=True))
        return self._each(rows, lambda station: station.regulate(float(targets[station.name])))

    def _each(self, rows: Mask, action: Callable[[S], Any]) -> list[str]:
        chosen = [station for station, wanted in zip(self.stations, rows, strict=True) if wanted]
        return self._lines(self._all(chosen, action))

    def _lines(self, failed: Mapping[S, ReactorError]) -> list[str]:
        return [f"{station.name}: {failed[station]}" for station in self.stations if station in failed]

    def _all(self, stations: Sequence[S], action: Callable[[S], Any]) -> dict[S, ReactorError]:
        failed: dict[S, ReactorError] = {}
        for station in stations:
            try:
                action(station)
            except ReactorError as error:
                failed[station] = error
        return failed

    def stop(self) -> None:
        """Switch all pumps off, verified, except in reactors that were handed over. Idempotent. Raises: PumpsNotOff."""
        failed = self._lines(self._silence([station for station in self.stations if not station.handed_over]))
        self.note_down("stop", {"reactors": self.names, "not_verified": failed})
        if failed:
            raise PumpsNotOff(failed="; ".join(failed))

    def _silence(self, stations: Sequence[S]) -> dict[S, ReactorError]:
        """Switch all pumps of `stations` off; return the errors of those that failed."""
        raise NotImplementedError

    def raise_late(self) -> None:
        """Raise, once, the error of the log that `note_down` kept."""
        error, self._log_error = self._log_error, None
        if error is not None:
            raise error

    def write(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Write a row. Raises: what the log raises."""
        self._log(kind, {"time_s": round(self.elapsed(), 3), **fields})

    def note_down(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Write a row; keep an error of the log for `raise_late`, so that it never prevents a pump-off."""
        try:
            Stations.write(self, kind, fields)
        except (OSError, ReactorError) as error:
            self._log_error = error
