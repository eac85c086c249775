"""One unit in the rig with the driver at it: what the tests against the vendor's own software share.

Waits are as long as a busy computer may need. A process is killed by the vial as it is told of a pin, at no set time.
"""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from hardware.clock import RealClock
from hardware.errors import DeviceStateError
from hardware.pioreactor.config import PUBLISHED, RigBackendConfig, RigConfig, UnitConfig
from hardware.pioreactor.doses import replay
from hardware.pioreactor.mailbox import MEDIA
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.versions import TESTED, facts
from hardware.reactor import Command
from hardware.rig.build import environment, home, missing
from hardware.rig.processes import Rig
from hardware.storage.journal import Journal
from tests.patience import PATIENCE_S

UNIT, EACH_ML = "pio01", 0.1  # mL: a busy computer is late by 60 ms
WHEELS = Path(__file__).resolve().parents[2] / "../shared/pioreactor_env"
PACKAGES = {version: version for version in TESTED}
PACKAGES["26.7.2"] = str(WHEELS / "26.7.2" / "pioreactor-26.7.2-py3-none-any.whl")


def need_the_rig(package: str = PUBLISHED) -> None:
    """Skip the calling test or module where this package cannot be run, and say what would help; build a wheel's."""
    pytest.importorskip("paho.mqtt.client", reason="pip install 'paho-mqtt>=2'")
    if lack := missing(package):
        pytest.skip(f"the vendor's software cannot run here: {lack}", allow_module_level=True)
    if package in TESTED and not (home(package) / "done").exists():
        pytest.skip(f"build it with: python -m hardware.rig --build-only --package {package}", allow_module_level=True)
    try:
        environment(package)
    except DeviceStateError as error:
        pytest.skip(str(error), allow_module_level=True)


def started(units: dict[str, float], config: RigConfig, **values: Any) -> Rig:
    """A rig, tried again where one of its ports, free a moment before, is another program's by now."""
    for _ in range(2):
        with contextlib.suppress(DeviceStateError):
            return Rig(units, config, **values)
    return Rig(units, config, **values)


class Lateness:
    """How late messages are on this computer: one after another over the broker and back, as long as the bench stands.

    Attributes: worst_s, the most so far.
    """

    def __init__(self, port: int) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        self.worst_s, self._ended = 0.0, threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_message = self._back
        self._client.connect("127.0.0.1", port)
        self._client.subscribe(self._topic)
        self._client.loop_start()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    _topic = "lateness"

    def _send(self) -> None:
        while not self._ended.wait(0.02):
            self._client.publish(self._topic, repr(time.monotonic()))

    def _back(self, _client: Any, _data: Any, message: Any) -> None:
        self.worst_s = max(self.worst_s, time.monotonic() - float(message.payload))

    def end(self) -> None:
        """No more of them."""
        self._ended.set()
        self._thread.join()
        self._client.disconnect()
        self._client.loop_stop()


class UnitBench:
    """One unit in the rig, and lives of the driver that end without a word and go on from the journal.

    Attributes: killed, how many doses lost their process; asked, how often the media pump was asked to run.
    """

    def __init__(self, folder: Path, package: str = PUBLISHED, period_s: float = 60.0, **values: Any) -> None:
        self.bench = Bench(period_s=period_s)
        self.rig = started({UNIT: 20.0}, RigConfig(package=package, od=0.5))
        self.folder, self.run, self.killed, self.asked = folder, f"test{time.time():.0f}", 0, 0
        where: dict[str, Any] = {"broker": "127.0.0.1", "broker_port": self.rig.broker, "leader": self.rig.web[UNIT]}
        where["units"] = {UNIT: UnitConfig(address=self.rig.web[UNIT])}
        self.config = RigBackendConfig(reactors=(UNIT,), **{"speed": 5.0, **where, **values})
        self.lateness = Lateness(self.rig.broker)
        try:
            self.live()
        except BaseException:
            self.rig.__exit__()
            raise

    def live(self) -> None:
        """A life of the driver, the first or the next."""
        self.journal = Journal(self.folder / "journal.jsonl")
        self.reactors = PioreactorReactors(self.config, RealClock(), self.journal.append, self.run, self.bench)
        self.station = self.reactors.stations[0]
        web = self.station.unit.web
        run = web.run

        def counted(job: str, options: Mapping[str, Any], *overrides: Any) -> str:
            self.asked += job == MEDIA
            return run(job, options, *overrides)

        web.run = counted  # type: ignore[method-assign]
        self.reactors.begin(replay(self.journal.rows), 1e4 * self.journal.next_row)

    def die(self) -> None:
        """What kill -9 leaves: nothing is stopped, the journal ends where it is."""
        self.reactors.close()
        self.journal.close()

    def end(self) -> None:
        """Everything ended and put away."""
        self.die()
        self.lateness.end()
        self.rig.__exit__()

    def sample(self) -> bool:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            if self.reactors.measure().fresh[0]:
                if self.station.book.fault is None:
                    return True
                self.dose(0.0)  # as the loop does with every sample
        return False

    def dose(self, ml: float) -> float:
        rate = np.array([ml / self.bench.period_s])
        return float(self.reactors.actuate(Command(np.array([True]), rate, np.array([np.nan]))).volume_ml[0])

    def go_on(self, until=lambda: False, real_s: float = PATIENCE_S) -> bool:
        """The driver works until something holds; whether it did."""
        end = time.monotonic() + real_s
        while time.monotonic() < end:
            self.station.poll()
            if until():
                return True
            time.sleep(0.05)
        return bool(until())

    def settled(self) -> bool:
        return self.go_on(lambda: not self.station.doses.running)

    def kill_a_dose(self, monkeypatch: pytest.MonkeyPatch, at_its_end: bool = False) -> None:
        """Kill the next dose (no short run) as the vial is told that its pump goes on, or before it is told off."""
        vial, begun = self.rig.vials.vials[UNIT], list[int]()
        drive = vial.drive

        def kills(pin: int, duty: float, pid: int, now: float) -> None:
            ends = at_its_end and begun == [pid] and duty == 0.0
            if not ends:
                drive(pin, duty, pid, now)
            dose = b"--ml" in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            begins = dose and pin == 13 and duty > 0.0 and not begun  # the chip was told; the unit and its broker not
            begun.extend([pid] * begins)
            if ends or (begins and not at_its_end):
                os.kill(pid, signal.SIGKILL)
                self.killed += 1

        monkeypatch.setattr(vial, "drive", kills)

    def truth(self) -> float:
        return float(self.rig.vials.vials[UNIT].plant.feed.delivered_ml[0])

    def od(self) -> float:
        """What the photodiode looks at."""
        return float(self.rig.vials.vials[UNIT].plant.apparent_od[0])

    def temperature(self) -> float:
        """Of the culture."""
        return float(self.rig.vials.vials[UNIT].plant.thermal.temperature[0])

    def target(self) -> float:
        """Of the thermostat, as the unit says."""
        said = self.station.unit.web.get("/jobs/settings/job_name/temperature_automation")
        return float(said["settings"]["target_temperature"])

    def pumping(self) -> bool:
        return self.rig.vials.vials[UNIT].duty[13] > 0.0

    def bounds(self) -> tuple[float, float, int, int]:
        """Least and most that the journal says was fed; doses intended, doses ended.

        What is fed beside doses counts, too: on a busy computer a pump is ended by short runs of it.
        """
        rows = self.journal.reread()
        ends = [r for r in rows if r["kind"] == "dose_end"]
        fed = [*ends, *(r for r in rows if r["kind"] == "given")]
        low = sum(r.get("feed_low_ml", 0.0) for r in fed)
        high = sum(r["feed_ml"] for r in fed)
        intended = [r for r in rows if r["kind"] == "intent" and r["feed_ml"] > 0.0]
        assert len({r["id"] for r in intended}) == len(intended)
        return low, high, len(intended), len([r for r in ends if r.get("id")])

    def pulses(self) -> int:
        """How often the media pump ran."""
        return len([p for p in self.rig.vials.vials[UNIT].pulses if p.pump == "media"])

    def clear_the_lock(self) -> None:
        """What the fault tells the operator to do on the unit."""
        self.pio(*facts(self.rig.version).purge.split()[1:], "pwm_locks", "13", "--as-int")

    def pio(self, *words: str) -> None:
        """A command of the vendor's on the unit."""
        subprocess.run([str(self.rig.folder / UNIT / "pio"), *words], check=True, capture_output=True)

    def judge(self, each_ml: float = EACH_ML) -> None:
        """Nothing twice, every dose with an end, the truth within the driver's own bounds.

        Args: each_ml: by how much messages may be late for a dose. A message that was later, as on a busy computer the
          bench's own are, tells a pump's on and off by as much too late.
        """
        low, high, intended, ended = self.bounds()
        assert ended == intended
        flow, late = self.station.doses.pumps.flow_ml_s[MEDIA], self.lateness.worst_s
        slack = each_ml * max(intended, 1) + 2.0 * flow * late
        runs = f"{self.truth():.2f} fed in {self.pulses()} runs for {intended} doses"
        told = f"{low:.2f} to {high:.2f} mL told, {runs}, messages up to {late:.2f} s late"
        assert low - slack <= self.truth() <= high + slack, told
        assert self.pulses() <= self.asked, told
