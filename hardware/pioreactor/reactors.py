"""Pioreactors as a `Reactor`: one dose per fresh sample by the vendor's own pump jobs, one to many units."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from hardware.clock import Clock, ScaledClock
from hardware.errors import DeviceStateError, LinkError, ReactorError
from hardware.logbook import Log, Logbook, no_log
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.resume import History
from hardware.pioreactor.station import Station
from hardware.reactor import Array, Mask, Measurement, Vitals, left_off
from hardware.stations import Stations

__all__ = ["PioreactorReactors"]

LOOK_S, FIRST_S = 0.05, 30.0  # real seconds between two looks; until the broker answered
PUMPS_S = 10.0  # real seconds in which pumps are verified off while a run goes on

screen = logging.getLogger(__name__)


class PioreactorReactors(Stations[Station]):
    """Units of one cluster (implements `hardware.reactor.Reactor`).

    Use: `begin` (or `begin(replay(rows), elapsed_s)` after a crash), then `measure` and `actuate` in turn, `stop` in
    any case, `close`.

    Args: config: units and how to reach them. real: clock of messages and jobs; the run's is `config.speed` times as
      fast. log: takes samples, intents, doses, faults and notes; an intent is written before its dose. run: of this
      run, part of every dose's id; the same after a resume.
    Raises: LinkError if the broker does not answer.
    """

    def __init__(self, config: PioreactorConfig, real: Clock, log: Log = no_log, run: str = "") -> None:
        super().__init__(ScaledClock(real, config.speed), log)
        self.config, self._real = config, real
        run = run or format(int(time.time()), "x")
        boxes = {u: Mailbox(u, config, real) for u in config.reactors}
        self.mqtt = Cluster(config, boxes, f"turbidostat-{run}-{config.reactors[0]}", real)
        books = (Logbook(u, self.note_down, self.write, self.elapsed) for u in config.reactors)
        self.stations = tuple(
            Station(config.of(book.name), self.mqtt, boxes[book.name], real, book, run) for book in books
        )

    @property
    def handed_over(self) -> Mask:
        """Units whose own turbidostat was started for good, shape (N,)."""
        return np.isfinite([s.handed_over for s in self.stations])

    def begin(self, histories: Mapping[str, History] | None = None, elapsed_s: float = 0.0) -> None:
        """Every unit into its running state. Args: histories: of a resumed run. elapsed_s: run time before it.

        Raises: ReactorError for a unit that cannot be brought there; of a run that is resumed only if none can: the
          others do not wait for one in trouble, which is told and tried again.
        """
        self._zero, known = self._clock.now() - elapsed_s, histories or {}
        with left_off(self):
            self.connect()
            self.mqtt.hold()
            if others := [other for unit in self.names if (other := self.mqtt.holder(unit))]:
                raise DeviceStateError(others[0])
            past = {station: known.get(station.name, History()) for station in self.stations}
            failed = self._all({station: station.bring_up(history) for station, history in past.items()})
            for station, error in failed.items():
                if not known or len(failed) == len(past):
                    raise type(error)(f"{station.name}: {error}")
                screen.warning("%s: not taken over, the others go on: %s", station.name, error)
                station.lie_down(error, past[station])

    def connect(self) -> None:
        """Wait for the broker to let us in, and for what it retains. Raises: LinkError."""
        deadline = self._real.now() + FIRST_S
        while not self.mqtt.connected:
            if self._real.now() > deadline or self.mqtt.refusal:
                why = self.mqtt.refusal or f"no answer in {FIRST_S:.0f} s"
                remedy = "check backend.username, and its password in backend.password_file or the environment"
                raise LinkError(f"MQTT broker {self.config.broker}:{self.config.broker_port}: {why}; {remedy}")
            self._real.sleep(LOOK_S)
        self._real.sleep(1.0)

    def _all(self, courses: dict[Station, Iterator[float]]) -> dict[Station, ReactorError]:
        """Go through courses side by side, while the other units go on; what failed."""
        failed: dict[Station, ReactorError] = {}
        while courses:
            for station, course in list(courses.items()):
                try:
                    next(course)
                except StopIteration:
                    del courses[station]
                except ReactorError as error:
                    failed[station] = error
                    del courses[station]
            for station in self.stations:
                if station not in courses:
                    station.go_on()
            self._real.sleep(LOOK_S)
        return failed

    def measure(self) -> Measurement:
        """The newest samples; waits for one.

        Returns with none fresh when a fault comes or goes, and when no unit has had one for `stale_s` (again every
        20 s). Raises: what the log raised.
        """
        last = max(s.sampling.arrived_s for s in self.stations)
        deadline = max(last + self.config.stale_s, self._clock.now() + 20.0)
        while True:
            fresh = np.array([station.poll() for station in self.stations])
            self.raise_late()
            if fresh.any() or self._clock.now() >= deadline or any(s.book.news for s in self.stations):
                return self._measurement(fresh)
            self._real.sleep(LOOK_S)

    def _measurement(self, fresh: Mask) -> Measurement:
        for station in self.stations:
            station.book.news = False
        newest = [s.sampling.newest for s in self.stations]
        age = self._clock.now() - np.array([s.sampling.arrived_s for s in self.stations])
        vitals = Vitals(age, np.array([n.raw for n in newest]), tuple(s.book.fault for s in self.stations))
        time_s = np.array([n.at for n in newest]) - self._zero
        temperature = np.array([s.temperature for s in self.stations])
        return Measurement(time_s, np.array([n.od for n in newest]), temperature, fresh, vitals)

    def pumps_off(self, rows: Mask) -> list[str]:
        """Every pump of `rows` off, verified; returns what failed, one line per unit.

        What drains a vial that a media pump is filling goes on.
        """
        return self._each(rows, lambda s: s.pumps_off(PUMPS_S))

    def give_up(self, rows: Mask) -> list[str]:
        """`pumps_off` for the rest of the run, the vendor's turbidostat too."""
        return self._each(rows, Station.give_up)

    def heat_off(self, rows: Mask) -> list[str]:
        """The thermostat of `rows` off for the rest of the run."""
        return self._each(rows, Station.heat_off)

    def set_level(self, n: int, level_ml: float) -> None:
        """Put the unit's own ledger, where it keeps one, to a volume, as soon as it answers."""
        self.stations[n].level_ml = level_ml

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand `rows` over to the vendor's turbidostat at `setpoint` (OD, (N,)); returns what failed."""
        targets = dict(zip(self.names, setpoint, strict=True))
        return self._each(rows, lambda s: s.regulate(float(targets[s.name])))

    def _each(self, rows: Mask, action: Callable[[Station], Iterator[float]]) -> list[str]:
        chosen = [station for station, wanted in zip(self.stations, rows, strict=True) if wanted]
        failed = self._all({station: action(station) for station in chosen})
        return [f"{station.name}: {failed[station]}" for station in chosen if station in failed]

    def stop(self) -> None:
        """All pumps off, verified; readings, stirring and heating go on. Idempotent.

        Raises: DeviceStateError naming every unit that could not be verified, and what to do.
        """
        failed = self._each(~self.handed_over, lambda s: s.pumps_off(self.config.stop_s, final=True))
        self.note_down("stop", {"reactors": self.names, "not_verified": failed})
        if failed:
            raise DeviceStateError("; ".join(failed))

    def close(self) -> None:
        """Leave the broker and the units. Idempotent."""
        self.mqtt.close()
        for station in self.stations:
            station.web.close()
