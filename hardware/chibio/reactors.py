"""Chi.Bio reactors as a `Reactor`: one verified single-shot dose per fresh sample, one to eight units, one thread.

The device keeps stirring, heating, measuring and logging by itself; its own OD regulation stays off and the pumps are
off except during a dose (docs/device.md, Dosing). Whatever must happen later (pump off, check, restart) is a task on
an agenda that `measure` works through while it waits, so the doses of several reactors overlap and an end of dose is
carried out even when other requests fail.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from hardware.chibio.agenda import Agenda
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.resume import ReactorHistory, remember
from hardware.chibio.station import Station
from hardware.clock import Clock
from hardware.errors import DeviceStateError, ReactorError
from hardware.link.transport import SharedLink, Transport
from hardware.logbook import Log, Logbook, no_log
from hardware.reactor import Array, Mask, Measurement, Vitals, left_off
from hardware.stations import Stations

__all__ = ["ChiBioReactors"]


class ChiBioReactors(Stations[Station]):
    """One to eight Chi.Bio reactors behind one server (implements `hardware.reactor.Reactor`).

    Use: `begin` (or `begin(replay(rows), elapsed_s)` after a crash), then `measure` and `actuate` in turn, `stop` in
    any case, `end` to end the experiments too.

    Args:
      transport: the link; this object is its only user. clock: device time.
      calibrations: one per reactor of `config.reactors`; nominal ones if left out.
      log: takes samples, intents, doses, commands, faults and notes, e.g. `Journal.append`. An intent is written
        before its dose, so a log that raises there prevents the dose; elsewhere its error is raised by `measure`.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        config: ChiBioConfig,
        calibrations: Sequence[ReactorCalibration] | None = None,
        log: Log = no_log,
    ) -> None:
        calibrations = calibrations if calibrations is not None else [ReactorCalibration()] * len(config.reactors)
        if len(calibrations) != len(config.reactors):
            raise ValueError(f"calibrations for {len(calibrations)} reactors, reactors = {list(config.reactors)}")
        super().__init__(clock, log)
        self.config = config
        self._link = SharedLink(transport, clock)
        self._past = dict.fromkeys(config.reactors, ReactorHistory())
        self._agenda = Agenda(clock)
        self.stations = tuple(
            Station(
                Connection(
                    m,
                    config.reactors,
                    self._link,
                    clock,
                    self.note_down,
                    config.overflow_pump.pump,
                    config.fluorescence.command,
                    config.supply.pumps,
                ),
                calibration,
                config,
                self._agenda,
                Logbook(m, self.note_down, self.write, self.elapsed),
                partial(self._past.__getitem__, m),
            )
            for m, calibration in zip(config.reactors, calibrations, strict=True)
        )

    @property
    def handed_over(self) -> Mask:
        """Reactors that were handed over to the on-board regulation, shape (N,)."""
        return np.array([station.regulation.active for station in self.stations])

    def begin(self, histories: Mapping[str, ReactorHistory] | None = None, elapsed_s: float = 0.0) -> None:
        """Sweep the pumps off, pin identities and blanks, start what does not run yet, staggered inside the minute.

        An overflow pump is verified on before the first dose. A start that fails or is stopped leaves all pumps off,
        verified, or says that it could not.

        An experiment that already runs is adopted, never started again (a second start would stop it); its next new
        sample is the first one delivered. So is a reactor that was handed over to the on-board regulation: it stays so.

        Args:
          histories: `replay` of the journal of the run that is resumed.
          elapsed_s: run time that has passed since that run began.
        Raises: ReactorError if a reactor cannot be brought into its running state; of a run that is resumed only if
          none can: the others do not wait for one in trouble, which is told and tried again.
        """
        self._zero = self._clock.now() - elapsed_s
        self._past |= histories or {}
        with left_off(self):
            self._take_over(resumed=bool(histories))

    def _take_over(self, resumed: bool) -> None:
        """Every reactor as an earlier life left it, then into its running state."""
        failed = list[ReactorError]()
        for station in self.stations:
            try:
                station.restore()
            except ReactorError as error:
                failed.append(error)
                if not resumed or len(failed) == len(self.stations):
                    raise
                station.book.say(f"not taken over, the others go on and this one is tried again: {error}")
        self._bring_up([station for station in self.stations if station.restored], resumed)

    def _bring_up(self, stations: Sequence[Station], resumed: bool) -> None:
        """Each into its running state, starts staggered inside the minute; a resumed run goes on meanwhile."""
        slot = 0
        for station in stations:
            running = station.connection.read().running
            station.busy = True
            wait_s = 0.0 if running else slot * 60.0 / len(self.stations)
            if wait_s:
                station.book.say(f"its experiment starts in {wait_s:.0f} s, one reactor after the other")
            self._agenda.add(station.take_over() if resumed else station.bring_up(), wait_s)
            slot += not running
        self._agenda.run_due()
        while any(station.busy for station in stations) and not resumed:
            self._agenda.run_due()
            self._clock.sleep(min(self._agenda.next_due() - self._clock.now(), 1.0))
        for station in stations:
            if not resumed and (trouble := station.overflow_pump.trouble or station.fluorescence.trouble):
                raise DeviceStateError(f"{station.name}: {trouble}; run the preflight")

    def measure(self) -> Measurement:
        """The newest samples; waits for one, working through the agenda.

        Returns with none fresh when a fault appears or disappears, and when no reactor has had a sample for
        `stale_s` (again every 20 s while that lasts): `vitals` then says what is wrong.
        Raises: what the log raised; nothing for trouble with device or link.
        """
        last = max(station.sampling.arrived_s for station in self.stations)
        deadline = max(last + self.config.stale_s, self._clock.now() + 20.0)
        fresh = np.zeros(len(self.stations), dtype=np.bool_)
        while True:
            self._between()
            for i, station in enumerate(self.stations):
                if self._clock.now() >= station.sampling.next_poll:
                    fresh[i] = station.poll()
                    self._between()
            self.raise_late()
            now = self._clock.now()
            if fresh.any() or now >= deadline or any(station.book.news for station in self.stations):
                return self._measurement(fresh)
            due = min([deadline, self._agenda.next_due(), *(station.sampling.next_poll for station in self.stations)])
            self._clock.sleep(max(due - now, 0.01))

    def _measurement(self, fresh: Mask) -> Measurement:
        def column(key: str) -> Array:
            return np.array([getattr(station.sampling, key) for station in self.stations], dtype=np.float64)

        for station in self.stations:
            station.book.news = False
        age = self._clock.now() - column("arrived_s")
        faults = tuple(station.book.fault for station in self.stations)
        vitals = Vitals(age, column("raw"), faults, column("blank"))
        light = column("fluorescence") if self.config.fluorescence.measure else None
        return Measurement(column("time_s"), column("od"), column("temperature"), fresh, vitals, light)

    def _between(self) -> None:
        """Run what is due now. A task that fails costs itself only; on a dead link others are due again by then."""
        now = self._clock.now()
        while self._agenda.next_due() <= now:
            try:
                self._agenda.run_due(now)
            except ReactorError as error:
                self.note_down("task_failed", {"error": str(error)})

    def pumps_off(self, rows: Mask) -> list[str]:
        """All pumps of `rows` off, verified, but for an overflow pump; returns what failed, one line per reactor."""
        return self._each(rows, lambda station: station.pumps_off(tries=1))

    def give_up(self, rows: Mask) -> list[str]:
        """`pumps_off` for the rest of the run: a reactor that regulates itself no longer does; returns what failed."""
        return self._each(rows, Station.give_up)

    def heat_off(self, rows: Mask) -> list[str]:
        """Thermostat and heater of `rows` off, and not switched on again; returns what failed."""
        return self._each(rows, lambda station: station.heat_off())

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """Hand `rows` over to the on-board regulation at `setpoint` (OD, shape (N,)); returns what failed.

        The reactor then feeds itself, at most 0.02 of full power; commands for it are refused from here on.
        """
        targets = dict(zip(self.names, setpoint, strict=True))
        return self._each(rows, lambda station: station.regulation.hand_over(float(targets[station.name])))

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
        """All pumps of all reactors off, overflow pumps too, verified; tried for `stop_s`, then escalated. Idempotent.

        Experiments go on (stirred, heated, measured). A reactor handed over to the on-board regulation is left to it,
        with its overflow pump.
        Raises: DeviceStateError naming every reactor whose pumps could not be verified off, and what to do.
        """
        pending = [s for s, regulated in zip(self.stations, self.handed_over, strict=True) if not regulated]
        errors: dict[str, ReactorError] = {}
        deadline = self._clock.now() + self.config.stop_s
        while pending:
            pending = [s for s in pending if not self._silence(s, errors)]
            if not pending or self._clock.now() >= deadline:
                break
            self._clock.sleep(min(self.config.retry_s, 2.0))
        self._agenda.clear()
        for station in pending:
            station.connection.escalate()
        pending = [s for s in pending if not self._silence(s, errors)]
        self.note_down("stop", {"reactors": self.names, "not_verified": [s.name for s in pending]})
        if pending:
            reasons = "; ".join(f"{s.name}: {errors[s.name]}" for s in pending)
            raise DeviceStateError(f"pumps not verified off: {reasons}. Switch the pump boards off by hand now")
        self._link.disarm()

    @staticmethod
    def _silence(station: Station, errors: dict[str, ReactorError]) -> bool:
        try:
            station.doses.settle(overflow_pump=True)
        except ReactorError as error:
            errors[station.name] = error
            return False
        return True

    def end(self) -> None:
        """`stop`, then end every experiment. Raises: ReactorError if one goes on."""
        self.stop()
        for station in self.stations:
            station.connection.post(f"/Experiment/0/{station.name}")
            if station.connection.read().running:
                raise DeviceStateError(f"{station.name}: the experiment does not end; stop it in the web page")

    def write(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Remember and log, or neither. Raises: what the log raises."""
        before = dict(self._past)
        row = self._remember(kind, fields)  # first: a stop may come right after it was written
        try:
            super().write(kind, row)
        except (OSError, ReactorError):
            self._past.update(before)
            raise

    def note_down(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Remember, and log without ever standing in the way of a pump-off."""
        super().note_down(kind, self._remember(kind, fields))

    def _remember(self, kind: str, fields: Mapping[str, Any]) -> dict[str, Any]:
        """What a row says is what a resumed run would know; the row."""
        row = {"time_s": round(self.elapsed(), 3), **fields}
        if (name := str(row.get("reactor"))) in self._past:
            self._past[name] = remember(self._past[name], {"kind": kind, **row})
        return row
