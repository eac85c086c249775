"""The driver against the vendor's own software: doses judged by the vial, every process killed in and between doses.

Each takes half a minute; `PIOREACTOR_KILLS=5` repeats every kill five times.
"""

import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from hardware.clock import RealClock
from hardware.errors import ReactorError
from hardware.pioreactor.config import RigBackendConfig
from hardware.pioreactor.preflight import preflight
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.resume import replay
from hardware.pioreactor.rig.build import CACHE, missing
from hardware.pioreactor.rig.processes import Rig, RigConfig
from hardware.reactor import Command
from hardware.storage.journal import Journal

pytest.importorskip("paho.mqtt.client", reason="pip install 'paho-mqtt>=2'")
if not (CACHE / "env" / "done").exists():
    pytest.skip("build it with: python -m hardware.pioreactor.rig", allow_module_level=True)
if missing():
    pytest.skip(f"the vendor's software cannot run here: {missing()}", allow_module_level=True)
pytestmark = pytest.mark.slow

UNIT, SPEED, EACH_ML = "pio01", 5.0, 0.1  # mL: a busy computer is late by 60 ms
REPEATS = int(os.environ.get("PIOREACTOR_KILLS", "1"))


class Bench:
    """One unit in the rig, and lives of the driver that end without a word and go on from the journal."""

    def __init__(self, folder: Path) -> None:
        self.rig = Rig((UNIT,), RigConfig(growth_x=1.0, od=0.5))
        self.folder, self.rates = folder, 0
        self.config = RigBackendConfig(
            reactors=(UNIT,), speed=SPEED, broker="127.0.0.1", broker_port=self.rig.broker, addresses=dict(self.rig.web)
        )
        self.live()

    def live(self) -> None:
        """A life of the driver, the first or the next."""
        self.journal = Journal(self.folder / "journal.jsonl")
        self.reactors = PioreactorReactors(self.config, RealClock(SPEED), self.journal.append, f"test{time.time():.0f}")
        self.reactors.begin(replay(self.journal.rows), 1e4 * self.journal.next_row)
        self.station = self.reactors.stations[0]

    def die(self) -> None:
        """What kill -9 leaves: nothing is stopped, the journal ends where it is."""
        self.reactors.close()
        self.journal.close()

    def sample(self, real_s: float = 60.0) -> bool:
        until = time.monotonic() + real_s
        while time.monotonic() < until:
            if self.reactors.measure().fresh[0]:
                if self.station.fault is None:
                    return True
                self.dose(0.0)  # as the loop does with every sample
        return False

    def dose(self, ml: float) -> float:
        rate = np.array([ml / self.config.period_s])
        return float(self.reactors.actuate(Command(np.array([True]), rate, np.array([np.nan]))).volume_ml[0])

    def go_on(self, real_s: float, until=lambda: False) -> bool:
        """The driver works until something holds; whether it did."""
        end = time.monotonic() + real_s
        while time.monotonic() < end:
            self.station.poll()
            if until():
                return True
            time.sleep(0.05)
        return bool(until())

    def settled(self, real_s: float = 60.0) -> bool:
        return self.go_on(real_s, lambda: not self.station.doses.running)

    def truth(self) -> float:
        return float(self.rig.vials.vials[UNIT].plant.feed.delivered_ml[0])

    def pumping(self) -> bool:
        return self.rig.vials.vials[UNIT].duty[13] > 0.0

    def bounds(self) -> tuple[float, float, int, int]:
        """Least and most that the journal says was fed; doses intended, doses ended."""
        rows = self.journal.reread()
        ends = [r for r in rows if r["kind"] == "dose_end"]
        low = sum(r.get("feed_low_ml", 0.0) for r in ends)
        high = sum(r["feed_ml"] for r in ends)
        intended = [r for r in rows if r["kind"] == "intent" and r["feed_ml"] > 0.0]
        assert len({r["id"] for r in intended}) == len(intended)
        return low, high, len(intended), len([r for r in ends if r.get("id")])

    def judge(self) -> None:
        """Nothing twice, every dose with an end, the truth within the driver's own bounds."""
        low, high, intended, ended = self.bounds()
        assert ended == intended
        slack = EACH_ML * max(intended, 1)
        assert low - slack <= self.truth() <= high + slack
        assert (
            len([p for p in self.rig.vials.vials[UNIT].pulses if p.pump == "media"]) <= intended + 1
        )  # one cycled pin


@pytest.fixture
def bench(tmp_path):
    made = Bench(tmp_path)
    try:
        assert made.sample()
        yield made
    finally:
        made.die()
        made.rig.close()


def test_doses_are_what_was_asked_each_with_its_own_id(bench):
    asked = []
    for ml in (0.1, 0.4, 1.2):
        asked.append(bench.dose(ml))
        assert bench.settled()
        assert bench.sample()
    given = [p.feed_ml for p in bench.rig.vials.vials[UNIT].pulses if p.pump == "media"]
    assert given == pytest.approx(asked, abs=EACH_ML)
    assert float(bench.rig.vials.vials[UNIT].plant.vessel.volume_ml[0]) == pytest.approx(20.0, abs=0.05)
    bench.judge()
    bench.reactors.stop()


def test_the_sample_is_the_culture_s(bench):
    assert bench.sample()
    true = float(bench.rig.vials.vials[UNIT].plant.apparent_od[0])
    assert bench.station.sampling.newest.od == pytest.approx(true, abs=0.02)


def test_preflight_passes(bench):
    failed = [str(check) for check in preflight(bench.reactors) if not check.ok]
    assert not failed


@pytest.mark.parametrize("repeat", range(REPEATS))
@pytest.mark.parametrize("moment", ["between", "in"])
@pytest.mark.parametrize("what", ["client", "dose", "od_reading", "tasks", "web", "broker"])
def test_a_kill(bench, what, moment, repeat):
    if what == "dose" and moment == "between":
        pytest.skip("there is no dose process between doses")
    if moment == "in":
        bench.dose(1.2)
        assert bench.go_on(30.0, bench.pumping)
    if what == "client":
        bench.die()
    elif what in ("dose", "od_reading"):
        for pid in bench.rig.jobs(UNIT, "add_media" if what == "dose" else what):
            os.kill(pid, 9)
    else:
        bench.rig.kill("broker" if what == "broker" else f"{UNIT} {what}")
    if what == "client":
        bench.live()
    noticed = bench.go_on(25.0, lambda: bench.station.fault is not None)
    if moment == "between" and what in ("tasks", "web"):
        refused = bench.dose(0.3)  # only a request shows it
        noticed = bench.go_on(30.0, lambda: bench.station.fault is not None) or refused == 0.0
    if what in ("tasks", "web", "broker"):
        bench.rig.start("broker" if what == "broker" else f"{UNIT} {what}")
    assert noticed or what == "client" or (moment == "in" and what in ("tasks", "web"))
    if what == "dose":
        assert bench.pumping(), "a chip drives it on"
        assert "pio cache clear pwm_locks 13 --as-int" in str(bench.station.fault)
        command = [str(bench.rig.folder / UNIT / "pio"), "cache", "clear", "pwm_locks", "13", "--as-int"]
        subprocess.run(command, check=True, capture_output=True)  # the operator
    assert bench.settled(200.0)
    bench.judge()
    if what == "od_reading":  # the vendor lets no second one start until the unit is rebooted
        bench.reactors.stop()
        return
    assert bench.sample(90.0)
    bench.dose(0.3)
    assert bench.settled()
    bench.judge()
    bench.reactors.stop()


def test_a_second_client_is_counted(bench):
    bench.station.web.run("add_media", {"ml": 0.5, "source-of-event": "UI"}, bench.station.book.env, [])
    assert bench.go_on(30.0, lambda: bench.station.fault is not None and bench.station.fault.kind == "mode")
    time.sleep(2.0)
    bench.go_on(1.0)
    assert sum(r.volume_ml[0] for _, r in bench.reactors.repeated()) == pytest.approx(0.5)


def test_the_vendors_turbidostat_takes_over(bench):
    failed = bench.reactors.regulate(np.array([True]), np.array([0.4]))
    assert not failed
    assert bench.reactors.handed_over[0]
    assert bench.dose(0.5) == 0.0
    bench.reactors.give_up(np.array([True]))


def test_stop_says_what_it_could_not_verify(bench):
    bench.rig.kill("broker")
    bench.config.__dict__["stop_s"] = 2.0
    with pytest.raises(ReactorError, match="plug"):
        bench.reactors.stop()
