"""What every part of one unit's driver works with."""

from dataclasses import dataclass

from envs.bench import Bench
from hardware.clock import Clock, DeviceClock
from hardware.logbook import Logbook
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.web import Web

__all__ = ["Unit"]


@dataclass(frozen=True)
class Unit:
    """One unit's surroundings.

    name: as in the vendor's page. config: of this unit. bench: period, bottle. volume_ml: of its culture. web, leader,
    mqtt, box: the ways to it and to its leader. clock: of the run, whose `real` is that of messages and jobs. book:
    what it reports. run: of this run, part of every dose's id.
    """

    name: str
    config: PioreactorConfig
    bench: Bench
    volume_ml: float
    web: Web
    leader: Web
    mqtt: Cluster
    box: Mailbox
    clock: DeviceClock
    book: Logbook
    run: str

    @property
    def real(self) -> Clock:
        """Real time: messages, jobs, pins."""
        return self.clock.real

    def say(self, topic: str, payload: str) -> None:
        """Publish below our experiment."""
        self.mqtt.publish(f"pioreactor/{self.name}/{self.config.experiment}/{topic}", payload)
