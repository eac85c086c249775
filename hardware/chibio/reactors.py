"""Chi.Bio reactors as a `Reactor`: one verified single-shot dose per fresh sample, one to eight units, one thread.

The device stirs, heats, measures and logs without a client; its own OD regulation stays off and the pumps are off
except during a dose (docs/device.md, Dosing). Later actions (pump off, check, restart) are tasks on an agenda that
`measure` works through while it waits. The doses of several reactors can therefore overlap, and a dose is ended even
when other requests fail.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from envs.bench import Bench
from hardware.chibio import messages
from hardware.chibio.agenda import Agenda
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.dose_sequence import OFF_AGAIN_S, REFUSALS
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.protocol import CONTROL_S
from hardware.chibio.resume import ReactorHistory, replay
from hardware.chibio.station import ChibioStation
from hardware.clock import Clock
from hardware.errors import DeviceStateError, ReactorError
from hardware.link.transport import SharedLink, Transport
from hardware.logbook import Log, Logbook, no_log
from hardware.stations import Stations

SLOWEST_S = 61.0  # a cycle of the device rarely takes longer


class ChiBioReactors(Stations[ChibioStation, ReactorHistory]):
    """One to eight Chi.Bio reactors behind one server; `end` ends the experiments too.

    Args:
      transport: the link; this object is its only user. clock: device time.
      calibrations: one per reactor of `config.reactors`; nominal ones if left out. bench: volumes of the cultures.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        config: ChiBioConfig,
        calibrations: Sequence[ReactorCalibration] | None = None,
        log: Log = no_log,
        bench: Bench | None = None,
    ) -> None:
        calibrations = calibrations if calibrations is not None else [ReactorCalibration()] * len(config.reactors)
        super().__init__(clock, config.stale_s, log)
        self.config, bench = config, bench or Bench()
        self._link = SharedLink(transport, clock)
        self._past = dict.fromkeys(config.reactors, ReactorHistory())
        self._agenda = Agenda(clock)
        self.stations = tuple(
            ChibioStation(
                Connection(name, config.permitted, self._link, clock, self.note_down), bench.volume_of(name),
                calibration, config, self._agenda, Logbook(name, self.note_down, self.write, self.elapsed),
                partial(self._past.__getitem__, name),
            )
            for name, calibration in zip(config.reactors, calibrations, strict=True)
        )  # fmt: skip

    def bounds_s(self, rows: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
        """Return bounds on the run time, s, from the cycles that the devices have begun since their newest samples.

        A cycle takes 60 s or slightly more, whatever the clocks show. An experiment that was stopped for a while counts
        too few cycles. An experiment that died counts none: without any cycle there is no upper bound.
        Args: rows: rows of the run's journal.
        """
        low_s, most_s = 0.0, list[float]()
        newest = {row["reactor"]: row for row in rows if row["kind"] == "sample"}
        began = {name: known.start_time for name, known in replay(rows).items()}
        for station in self.stations:
            with suppress(ReactorError, KeyError, TypeError, ValueError):
                row, state = newest[station.name], station.connection.read()
                begun, at_s = state.cycles - int(row["sample"][1]), float(row["time_s"])
                if state.running and state.start_time == began[station.name]:
                    low_s = max(low_s, at_s + CONTROL_S * (begun - 1))
                    most_s.append(at_s + SLOWEST_S * (begun + 1) if begun > 0 else math.inf)
        return low_s, max(most_s, default=math.inf)

    def _take_over(self, histories: Mapping[str, ReactorHistory]) -> None:
        """Switch the pumps off, pin identities and blanks, start the experiments that do not run, spread over a minute.

        A running experiment is adopted and not started again, because a second start would stop it. A reactor that was
        handed over to the on-board regulation stays so.
        """
        self._past |= histories
        failed = list[ReactorError]()
        for station in self.stations:
            try:
                station.restore()
            except ReactorError as error:
                failed.append(error)
                if not histories or len(failed) == len(self.stations):
                    raise
                station.book.say(messages.NotTakenOver(error=error))
        self._bring_up([station for station in self.stations if station.restored], resumed=bool(histories))

    def _bring_up(self, stations: Sequence[ChibioStation], resumed: bool) -> None:
        """Bring each station into its running state, with starts spread over a minute; a resumed run does not wait."""
        slot = 0
        for station in stations:
            running = station.connection.read().running
            station.busy = True
            wait_s = 0.0 if running else slot * 60.0 / len(self.stations)
            if wait_s:
                station.book.say(messages.StartsInTurn(seconds=wait_s))
            self._agenda.add(station.take_over() if resumed else station.bring_up(), wait_s)
            slot += not running
        self._agenda.run_due()
        while any(station.busy for station in stations) and not resumed:
            self._agenda.run_due()
            self._clock.sleep(min(self._agenda.next_due() - self._clock.now(), 1.0))
        for station in stations:
            if not resumed and (trouble := station.overflow_pump.trouble or station.fluorescence.trouble):
                raise messages.NotReady(reactor=station.name, trouble=trouble)

    def _between(self) -> None:
        """Run the tasks that are due now. A task that fails is dropped and logged; the others still run."""
        now = self._clock.now()
        while self._agenda.next_due() <= now:
            try:
                self._agenda.run_due(now)
            except ReactorError as error:
                self.note_down("task_failed", {"error": str(error)})

    def _wait(self, longest_s: float) -> None:
        self._clock.sleep(max(min(longest_s, self._agenda.next_due() - self._clock.now()), 0.01))

    def stop(self) -> None:
        """Stop as `Stations.stop`, overflow pumps too: try for `stop_s`, then escalate. Disarm the dead-man switch."""
        super().stop()
        self._link.disarm()

    def _silence(self, stations: Sequence[ChibioStation]) -> dict[ChibioStation, ReactorError]:
        """Switch all pumps of `stations` off, at last by ending experiments; return the errors of those that failed."""

        def failed(pending: Sequence[ChibioStation]) -> dict[ChibioStation, ReactorError]:
            return self._all(pending, lambda station: station.doses.settle(overflow_pump=True))

        deadline, tries = self._clock.now() + self.config.stop_s, 1
        pending = failed(stations)
        while pending and self._clock.now() < deadline:
            if (tries := tries + 1) == REFUSALS:  # a reactor that answers and does not obey
                for station in (one for one, error in pending.items() if isinstance(error, DeviceStateError)):
                    station.connection.escalate()
            self._clock.sleep(OFF_AGAIN_S)
            pending = failed(list(pending))
        self._agenda.clear()
        for station in pending:
            station.connection.escalate()
        return failed(list(pending))

    def end(self) -> None:
        """Stop, then end every experiment. Raises: ReactorError if an experiment still runs."""
        self.stop()
        for station in self.stations:
            station.connection.post(f"/Experiment/0/{station.name}")
            if station.connection.read().running:
                raise messages.DoesNotEnd(reactor=station.name)

    def write(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Add a row to the history and the log, or to neither. Raises: what the log raises."""
        before = dict(self._past)
        row = self._remember(kind, fields)  # first, because a stop may come right after the write
        try:
            super().write(kind, row)
        except (OSError, ReactorError):
            self._past.update(before)
            raise

    def note_down(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Add a row to the history and the log; an error of the log never prevents a pump-off."""
        super().note_down(kind, self._remember(kind, fields))

    def _remember(self, kind: str, fields: Mapping[str, Any]) -> dict[str, Any]:
        row = {"time_s": round(self.elapsed(), 3), **fields}
        if (name := str(row.get("reactor"))) in self._past:
            self._past[name] = self._past[name].after({"kind": kind, **row})
        return row
