"""The driver against the vendor's own software: remedies, the hand-over and the jobs beside the readings.

Each takes half a minute. What can go wrong in and between doses is in tests/campaigns/pioreactor_faults.py.
"""

import numpy as np
import pytest

from hardware.clock import RealClock
from hardware.pioreactor.preflight import preflight
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.versions import facts
from tests.hardware.pioreactor_bench import PACKAGES, UNIT, UnitBench, need_the_rig

pytestmark = [pytest.mark.campaign, pytest.mark.xdist_group("pioreactor")]  # one rig at a time

ALL = np.array([True])


@pytest.fixture(params=PACKAGES)
def bench(request, tmp_path):
    need_the_rig(PACKAGES[request.param])
    made = UnitBench(tmp_path, PACKAGES[request.param])
    try:
        assert made.sample()
        yield made
    finally:
        made.end()


def test_the_remedy_of_the_preflight_for_a_killed_dose_works(bench, monkeypatch):
    bench.kill_a_dose(monkeypatch)
    bench.dose(1.2)
    assert bench.go_on(lambda: bench.killed > 0)
    bench.die()
    forget = facts(bench.rig.version).forget
    reactors = PioreactorReactors(bench.config, RealClock())
    named = [check for check in preflight(reactors) if not check.ok and check.name == f"{UNIT} dosing"]
    reactors.close()
    assert ("rebooted" if not forget else f"{forget} --job-name add_media") in str(named[0])
    if forget:
        bench.clear_the_lock()
        bench.pio(*forget.split()[1:], "--job-name", "add_media")
    else:
        bench.rig.cut(UNIT)
        bench.rig.boot(UNIT)
    bench.live()
    assert bench.settled()
    assert bench.sample()
    assert bench.dose(0.3) == 0.3
    assert bench.settled()
    bench.reactors.stop()


def test_the_vendors_turbidostat_takes_over_and_is_ended(bench):
    failed = bench.reactors.regulate(ALL, np.array([0.4]))
    assert not failed
    assert bench.reactors.handed_over[0]
    assert bench.dose(0.5) == 0.0
    assert bench.go_on(bench.pumping), "the culture is above its target"
    assert bench.station.book.fault is None
    assert bench.reactors.give_up(ALL) == []
    assert not bench.pumping()
    before = bench.truth()
    assert not bench.go_on(bench.pumping, 25.0), "it looks every 15 s"
    assert bench.truth() == before
    assert not bench.rig.jobs(UNIT, "dosing_automation")


def test_stirring_and_thermostat_run_follow_their_target_and_come_back_after_a_reboot(bench):
    box = bench.station._box

    def running():
        return all(box.state(job).word == "ready" for job in ("stirring", "temperature_automation"))

    assert bench.go_on(running)
    assert bench.go_on(lambda: bench.station.sampling.temperature > 20.0)
    assert bench.station.sampling.temperature == pytest.approx(bench.temperature(), abs=0.5)
    bench.station.set_temperature(33.0)
    assert bench.go_on(lambda: box.target == 33.0)
    assert bench.target() == 33.0
    bench.rig.cut(UNIT)
    bench.rig.boot(UNIT)
    assert bench.go_on(lambda: bench.station.book.fault is not None)
    assert bench.go_on(running)
    assert bench.target() == 33.0
    assert bench.sample()
    assert bench.dose(0.4) == 0.4
    assert bench.settled()
    assert bench.reactors.heat_off(ALL) == []
    assert not bench.rig.jobs(UNIT, "temperature_automation")
    assert bench.rig.vials.vials[UNIT].duty.get(18, 0.0) == 0.0
    bench.reactors.stop()
    assert box.live("stirring")
