"""Pioreactors as a `Reactor`: one dose per fresh sample by the vendor's own pump jobs, one to many units."""

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hardware.clock import Clock
from hardware.errors import DeviceStateError, LinkError, ReactorError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.logbook import Log, no_log
from hardware.pioreactor.mailbox import Mailbox, Mqtt
from hardware.pioreactor.resume import History
from hardware.pioreactor.station import Station
from hardware.reactor import Array, Command, Mask, Measurement, Receipt, Vitals

__all__ = ["PioreactorReactors"]

LOOK_S, FIRST_S = 0.05, 30.0  # real seconds: between two looks; until retained messages and first readings are there


class PioreactorReactors:
    """Units of one cluster (implements `hardware.reactor.Reactor`).

    Use: `begin` (or `begin(replay(rows), elapsed_s)` after a crash), then `measure` and `actuate` in turn, `stop` in
    any case, `close`.

    Args: config: units and how to reach them. clock: device time. log: takes samples, intents, doses, faults and notes;
      an intent is written before its dose. run: of this run, part of every dose's id; the same after a resume.
    Raises: LinkError if the broker does not answer.
    """

    def __init__(self, config: PioreactorConfig, clock: Clock, log: Log = no_log, run: str = "") -> None:
        self.config, self._clock, self._log = config, clock, log
        self._zero = clock.now()
        run = run or format(int(time.time()), "x")
        boxes = {u: Mailbox(u, config.experiment, config.channel, clock) for u in config.reactors}
        login = (config.username, config.password)
        name = f"turbidostat-{run}-{config.reactors[0]}"
        self._mqtt = Mqtt(config.broker, config.broker_port, login, boxes, clock, name)
        self.stations = tuple(
            Station(u, config, self._mqtt, box, clock, log, self.elapsed, run) for u, box in boxes.items()
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the units."""
        return tuple(s.name for s in self.stations)

    @property
    def handed_over(self) -> Mask:
        """Units whose own turbidostat was started for good, shape (N,)."""
        return np.isfinite([s.handed_over for s in self.stations])

    def elapsed(self) -> float:
        """Run time, s, with what had passed before a resume."""
        return self._clock.now() - self._zero

    def begin(self, histories: Mapping[str, History] | None = None, elapsed_s: float = 0.0) -> None:
        """Every unit into its running state. Args: histories: of a resumed run. elapsed_s: run time before it.

        Raises: ReactorError for a unit that cannot be brought there.
        """
        self._zero = self._clock.now() - elapsed_s
        deadline = self._clock.now() + FIRST_S * self.config.speed
        while not self._mqtt.connected:
            if self._clock.now() > deadline:
                raise LinkError(f"MQTT broker {self.config.broker}: no answer; check user name and password")
            self._clock.sleep(LOOK_S * self.config.speed)
        self._mqtt.hold()
        self._clock.sleep(1.0 * self.config.speed)  # retained messages: which jobs are there, and who else is
        if others := [other for unit in self.names if (other := self._mqtt.holder(unit))]:
            raise DeviceStateError(others[0])
        for station in self.stations:
            station.bring_up((histories or {}).get(station.name, History()))

    def measure(self) -> Measurement:
        """The newest samples; waits for one.

        Returns with none fresh when a fault comes or goes, and when no unit has had one for `stale_s` (again every
        20 s). Raises: what the log raised.
        """
        last = max(s.sampling.arrived_s for s in self.stations)
        deadline = max(last + self.config.stale_s, self._clock.now() + 20.0)
        while True:
            fresh = np.array([station.poll() for station in self.stations])
            for station in self.stations:
                if station.book.error is not None:
                    error, station.book.error = station.book.error, None
                    raise error
            if fresh.any() or self._clock.now() >= deadline or any(s.news for s in self.stations):
                return self._measurement(fresh)
            self._clock.sleep(LOOK_S * self.config.speed)

    def holder(self, unit: str) -> str:
        """Who else controls a unit, on whatever computer, "" if nobody does."""
        return self._mqtt.holder(unit)

    def _measurement(self, fresh: Mask) -> Measurement:
        now = self._clock.now()
        for station in self.stations:
            station.news = False
        newest = [s.sampling.newest for s in self.stations]
        age = np.array([now - s.sampling.arrived_s for s in self.stations])
        vitals = Vitals(age, np.array([n.raw for n in newest]), tuple(s.fault for s in self.stations))
        time_s = np.array([n.at for n in newest]) - self._zero
        temperature = np.array([s.temperature for s in self.stations])
        return Measurement(time_s, np.array([n.od for n in newest]), temperature, fresh, vitals)

    def actuate(self, command: Command) -> Receipt:
        """Begin one dose per row of `command.rows`; its course is followed by `measure`.

        Raises: what the log raises when an intent cannot be written (then nothing is dosed); ValueError for a rate that
          is negative or not finite. Trouble with units or network becomes a note.
        """
        volume, waste, kept = (np.zeros(len(self.stations)) for _ in range(3))
        for i, station in enumerate(self.stations):
            if command.rows[i]:
                station.set_temperature(float(command.temperature[i]))
                before = station.doses.carry_ml
                plan = station.dose(float(command.pump_rate[i]))
                volume[i], waste[i] = plan.feed_ml, plan.waste_ml
                kept[i] = station.doses.carry_ml - before
        notes = tuple(f"{s.name}: {note}" for s in self.stations for note in s.book.notes)
        for station in self.stations:
            station.book.notes.clear()
        return Receipt(volume, notes, waste, kept)

    def repeated(self) -> list[tuple[float, Receipt]]:
        """What was dosed without a command of this run, by whomever, not told before."""
        found = []
        for i, station in enumerate(self.stations):
            mine = np.arange(len(self.stations)) == i
            extra, station.doses.extra = station.doses.extra, []
            found += [(at_s, Receipt(mine * feed, (), mine * waste)) for at_s, feed, waste in extra]
        return sorted(found, key=lambda one: one[0])

    def pumps_off(self, rows: Mask) -> list[str]:
        """Every pump of `rows` off, verified; returns what failed, one line per unit."""
        return self._each(rows, lambda s: s.pumps_off(3.0))

    def give_up(self, rows: Mask) -> list[str]:
        """`pumps_off` for the rest of the run, the vendor's turbidostat too."""
        return self._each(rows, lambda s: s.give_up())

    def heat_off(self, rows: Mask) -> list[str]:
        """The thermostat of `rows` off for the rest of the run."""
        return self._each(rows, lambda s: s.heat_off())

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand `rows` over to the vendor's turbidostat at `setpoint` (OD, (N,)); returns what failed."""
        targets = dict(zip(self.names, setpoint, strict=True))
        return self._each(rows, lambda s: s.regulate(float(targets[s.name])))

    def _each(self, rows: Mask, action: Callable[[Station], None]) -> list[str]:
        failed = []
        for station, wanted in zip(self.stations, rows, strict=True):
            if wanted:
                try:
                    action(station)
                except ReactorError as error:
                    failed.append(f"{station.name}: {error}")
        return failed

    def stop(self) -> None:
        """All pumps off, verified; readings, stirring and heating go on. Idempotent.

        Raises: DeviceStateError naming every unit that could not be verified, and what to do.
        """
        failed = self._each(~self.handed_over, lambda s: s.pumps_off(self.config.stop_s))
        self._note({"reactors": self.names, "not_verified": failed})
        if failed:
            raise DeviceStateError("; ".join(failed))

    def _note(self, fields: Mapping[str, Any]) -> None:
        with contextlib.suppress(OSError, ReactorError):
            self._log("stop", {"time_s": round(self.elapsed(), 3), **fields})

    def close(self) -> None:
        """Leave the broker. Idempotent."""
        self._mqtt.close()
