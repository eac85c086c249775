"""Pioreactors that are only watched: readings and dosing events from the broker of their cluster."""

import numpy as np

from envs.bench import Bench
from hardware.clock import Clock, DeviceClock
from hardware.errors import LinkError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import ALT, MEDIA, Cluster, Mailbox
from hardware.pioreactor.sampling import UnitSampling
from hardware.reactor import Measurement, Vitals
from hardware.watch.messages import NoReading
from hardware.watched import Watched

LOOK_S, FIRST_S, AGAIN_S = 0.05, 30.0, 20.0  # real s: between two looks; until the broker answers; of a `measure`
REST_S = 15.0  # after a dose until readings count again: pumps, stirring
SILENT_S = 45.0  # time without a reading until a fault


class WatchedPioreactors(Watched):
    """Units that another client's jobs regulate. `close` after use. Raises: LinkError if the broker does not answer."""

    def __init__(self, config: PioreactorConfig, real: Clock, bench: Bench) -> None:
        super().__init__(config.reactors)
        self._clock, self._real, self._config = DeviceClock(config.speed, real), real, config
        self._began_s = self._clock.now()
        self.boxes = {unit: Mailbox(unit, config, real) for unit in config.reactors}
        self.sampling = [UnitSampling(config.of(unit), bench.period_s, self._began_s) for unit in config.reactors]
        self._dosed_s = [-np.inf] * len(self.names)
        self.mqtt = Cluster(config, self.boxes, f"turbidostat-watch-{config.reactors[0]}", real)
        deadline = real.now() + FIRST_S
        while not self.mqtt.connected:
            if real.now() > deadline or self.mqtt.refusal:
                why = self.mqtt.refusal or f"no answer in {FIRST_S:.0f} s"
                raise LinkError(f"MQTT broker {config.broker}:{config.broker_port}: {why}; check address and password")
            real.sleep(LOOK_S)

    def elapsed(self) -> float:
        return self._clock.now() - self._began_s

    def measure(self) -> Measurement:
        until_s, fresh = self._real.now() + AGAIN_S, [False] * len(self.names)
        while not any(fresh) and self._real.now() < until_s:
            self._real.sleep(LOOK_S)
            fresh = [self._listen(n, unit) for n, unit in enumerate(self.names)]
        s, now = self.sampling, self._clock.now()
        at, od, raw = (np.array([getattr(one, key) for one in s]) for key in ("at", "od", "raw"))
        warm = np.array([box.temperature for box in self.boxes.values()])
        age = np.array([now - one.arrived_s for one in s])
        faults = tuple(
            NoReading(seconds=now - one.read_s) if now - one.read_s > SILENT_S * self._config.speed else None
            for one in s
        )
        return Measurement(at - self._began_s, od, warm, np.array(fresh), Vitals(age, raw, faults))

    def _listen(self, n: int, unit: str) -> bool:
        readings, events, _ = self.boxes[unit].drain()
        now, mine = self._clock.now(), np.arange(len(self.names)) == n
        for event in events:
            if event.pump in (MEDIA, ALT):
                self.seen(self.elapsed(), mine * event.ml)
            self._dosed_s[n] = now
        since_s = self._dosed_s[n] + self._clock.of_real(REST_S)
        self.sampling[n].take([r._replace(at=self._clock.of_real(r.at)) for r in readings])
        return self.sampling[n].look(now, since_s)

    def close(self) -> None:
        self.mqtt.close()
