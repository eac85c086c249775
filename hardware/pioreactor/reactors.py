"""Pioreactors as a `Reactor`: one dose per fresh sample by the vendor's pump jobs, for any number of units."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from envs.bench import Bench
from hardware.clock import Clock, DeviceClock
from hardware.errors import ReactorError
from hardware.logbook import Log, Logbook, no_log
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.doses import UnitHistory
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.messages import BrokerRefuses, UnitTaken
from hardware.pioreactor.pumps import Unit
from hardware.pioreactor.station import PioreactorStation
from hardware.pioreactor.web import Web
from hardware.stations import Stations

LOOK_S, FIRST_S = 0.05, 30.0  # real seconds: between two looks; longest wait for the broker

screen = logging.getLogger(__name__)


class PioreactorReactors(Stations[PioreactorStation, UnitHistory]):
    """Units of one cluster; `close` after `stop`.

    Args: config: units and how to reach them. real: clock of messages and jobs; the run's clock is `config.speed` times
      as fast. run: id of this run, part of every dose's id; a resume keeps it. bench: period, volumes, bottle.
    Raises: LinkError if the broker does not answer.
    """

    def __init__(
        self, config: PioreactorConfig, real: Clock, log: Log = no_log, run: str = "", bench: Bench | None = None
    ) -> None:
        clock, bench = DeviceClock(config.speed, real), bench or Bench()
        super().__init__(clock, bench.stale_s, log)
        self.config, self._real = config, real
        run = run or format(int(time.time()), "x")
        boxes = {unit: Mailbox(unit, config, real) for unit in config.reactors}
        self.leader = Web((config.leader or f"http://{config.broker}").rstrip("/"), config.experiment)
        self.mqtt = Cluster(config, boxes, f"turbidostat-{run}-{config.reactors[0]}", real)
        self.stations = tuple(
            PioreactorStation(
                Unit(
                    name, config.of(name), bench, bench.volume_of(name), Web(config.address(name), config.experiment),
                    self.leader, self.mqtt, box, clock, Logbook(name, self.note_down, self.write, self.elapsed), run,
                )
            )
            for name, box in boxes.items()
        )  # fmt: skip

    def _take_over(self, histories: Mapping[str, UnitHistory]) -> None:
        self.connect()
        self.mqtt.hold()
        if others := [other for unit in self.names if (other := self.mqtt.holder(unit))]:
            raise UnitTaken(other=others[0])
        past = {station: histories.get(station.name, UnitHistory()) for station in self.stations}
        failed = self._all(self.stations, lambda station: station.bring_up(past[station]))
        for station, error in failed.items():
            if not histories or len(failed) == len(past):
                raise error.about(station.name)
            screen.warning("%s: not taken over, the others continue: %s", station.name, error)
            station.postpone_start(error, past[station])

    def connect(self) -> None:
        """Wait until the broker accepts this client, and for its retained messages. Raises: LinkError."""
        deadline = self._real.now() + FIRST_S
        while not self.mqtt.connected:
            if self._real.now() > deadline or self.mqtt.refusal:
                why = self.mqtt.refusal or f"no answer in {FIRST_S:.0f} s"
                raise BrokerRefuses(broker=f"{self.config.broker}:{self.config.broker_port}", why=why)
            self._real.sleep(LOOK_S)
        self._real.sleep(1.0)

    def _wait(self, _longest_s: float) -> None:
        self._real.sleep(LOOK_S)

    def _all(
        self, stations: Sequence[PioreactorStation], action: Callable[[PioreactorStation], Iterator[float]]
    ) -> dict[PioreactorStation, ReactorError]:
        """Run the steps of the actions in parallel, while the other units continue; return the errors."""
        courses, failed = {station: action(station) for station in stations}, dict[PioreactorStation, ReactorError]()
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

    def _silence(self, stations: Sequence[PioreactorStation]) -> dict[PioreactorStation, ReactorError]:
        """Switch all pumps of `stations` off, waste pumps too; return the errors of those that failed."""
        return self._all(stations, lambda station: station.pumps_off(self.config.stop_s, final=True))

    def set_level(self, n: int, level_ml: float) -> None:
        """Set the unit's own ledger, if it keeps one, to a volume as soon as the unit answers."""
        self.stations[n].level_ml = level_ml

    def close(self) -> None:
        self.mqtt.close()
        self.leader.close()
        for station in self.stations:
            station.unit.web.close()
