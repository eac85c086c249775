"""The driver against the vendor's own software: doses judged by the vial, every process killed in and between doses.

Each takes half a minute; `PIOREACTOR_KILLS=5` repeats every kill five times.
"""

import os
import time

import numpy as np
import pytest

from hardware.clock import RealClock
from hardware.errors import ReactorError
from hardware.pioreactor.jobs import request
from hardware.pioreactor.preflight import preflight
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.versions import facts
from tests.hardware.pioreactor_bench import EACH_ML, PACKAGES, UNIT, UnitBench, need_the_rig

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("pioreactor")]  # one rig at a time

ALL = np.array([True])
REPEATS = int(os.environ.get("PIOREACTOR_KILLS", "1"))


@pytest.fixture(params=PACKAGES)
def bench(request, tmp_path):
    need_the_rig(PACKAGES[request.param])
    made = UnitBench(tmp_path, PACKAGES[request.param])
    try:
        assert made.sample()
        yield made
    finally:
        made.end()


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
    noticed = bench.go_on(25.0, lambda: bench.station.book.fault is not None)
    if moment == "between" and what in ("tasks", "web"):
        refused = bench.dose(0.3)  # only a request shows it
        noticed = bench.go_on(30.0, lambda: bench.station.book.fault is not None) or refused == 0.0
    if what in ("tasks", "web", "broker"):
        bench.rig.start("broker" if what == "broker" else f"{UNIT} {what}")
    assert noticed or what == "client" or (moment == "in" and what in ("tasks", "web"))
    if what == "dose":
        assert bench.pumping(), "a chip drives it on"
        assert f"{facts(bench.rig.version).purge} pwm_locks 13 --as-int" in str(bench.station.book.fault)
        bench.clear_the_lock()
    assert bench.settled(200.0)
    bench.judge()
    if what == "od_reading":  # the vendor lets no second one start until then
        forget = facts(bench.rig.version).forget
        assert (f"{forget} --job-name od_reading" if forget else "reboot it") in str(bench.station.book.fault)
        if forget:
            bench.pio(*forget.split()[1:], "--job-name", "od_reading")
        else:
            bench.rig.reboot(UNIT)
    assert bench.sample(90.0)
    bench.dose(0.3)
    assert bench.settled()
    bench.judge()
    bench.reactors.stop()


@pytest.mark.parametrize("moment", ["between", "in"])
def test_a_unit_that_reboots_is_measured_and_dosed_again(bench, moment):
    before = bench.truth()
    if moment == "in":
        assert bench.dose(1.2) == 1.2
        assert bench.go_on(30.0, bench.pumping)
    bench.rig.reboot(UNIT)
    assert not bench.pumping()
    assert bench.settled(60.0)
    if moment == "in":
        end = next(row for row in bench.journal.reread() if row["kind"] == "dose_end")
        assert end["feed_ml"] >= 1.2
        assert bench.truth() - before < 1.2
    bench.judge()
    assert bench.sample(90.0)
    bench.dose(0.3)
    assert bench.settled()
    bench.judge()
    bench.reactors.stop()


def test_the_remedy_of_the_preflight_for_a_killed_dose_works(bench):
    bench.dose(1.2)
    assert bench.go_on(30.0, bench.pumping)
    for pid in bench.rig.jobs(UNIT, "add_media"):
        os.kill(pid, 9)
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
        bench.rig.reboot(UNIT)
    bench.live()
    assert bench.settled(200.0)
    assert bench.sample(90.0)
    assert bench.dose(0.3) == 0.3
    assert bench.settled()
    bench.reactors.stop()


def test_a_second_client_is_counted(bench):
    bench.station.unit.web.run("add_media", {"ml": 0.5, "source-of-event": "UI"})
    assert bench.go_on(30.0, lambda: bench.station.book.fault is not None and bench.station.book.fault.kind == "mode")
    time.sleep(2.0)
    bench.go_on(1.0)
    assert sum(r.volume_ml[0] for _, r in bench.reactors.repeated()) == pytest.approx(0.5)


def test_the_vendors_turbidostat_takes_over_and_is_ended(bench):
    failed = bench.reactors.regulate(ALL, np.array([0.4]))
    assert not failed
    assert bench.reactors.handed_over[0]
    assert bench.dose(0.5) == 0.0
    assert bench.go_on(90.0, bench.pumping), "the culture is above its target"
    assert bench.station.book.fault is None
    assert bench.reactors.give_up(ALL) == []
    assert not bench.pumping()
    before = bench.truth()
    assert not bench.go_on(25.0, bench.pumping), "it looks every 15 s"
    assert bench.truth() == before
    assert not bench.rig.jobs(UNIT, "dosing_automation")


def test_an_automation_that_somebody_starts_is_a_fault_and_holds_ours(bench):
    options, overrides = request("dosing_automation", bench.config, facts(bench.rig.version), 37.0, 3.0)
    bench.station.unit.web.run("dosing_automation", options, overrides)
    assert bench.go_on(30.0, lambda: bench.station.book.fault is not None and bench.station.book.fault.kind == "mode")
    assert bench.dose(0.5) == 0.0
    bench.station.unit.web.stop("dosing_automation")
    assert bench.sample(60.0)
    assert bench.dose(0.5) == 0.5
    assert bench.settled()
    bench.judge()


def test_stirring_and_thermostat_run_follow_their_target_and_come_back_after_a_reboot(bench):
    box = bench.station._box

    def running():
        return all(box.state(job).word == "ready" for job in ("stirring", "temperature_automation"))

    assert bench.go_on(40.0, running)
    assert bench.go_on(20.0, lambda: bench.station.newest.temperature > 20.0)
    assert bench.station.newest.temperature == pytest.approx(bench.temperature(), abs=0.5)
    bench.station.set_temperature(33.0)
    assert bench.go_on(20.0, lambda: box.target == 33.0)
    assert bench.target() == 33.0
    bench.rig.reboot(UNIT)
    assert bench.go_on(30.0, lambda: bench.station.book.fault is not None)
    assert bench.go_on(90.0, running)
    assert bench.target() == 33.0
    assert bench.sample(60.0)
    assert bench.dose(0.4) == 0.4
    assert bench.settled()
    assert bench.reactors.heat_off(ALL) == []
    assert not bench.rig.jobs(UNIT, "temperature_automation")
    assert bench.rig.vials.vials[UNIT].duty.get(18, 0.0) == 0.0
    bench.reactors.stop()
    assert box.live("stirring")


def test_stop_says_what_it_could_not_verify(bench):
    bench.rig.kill("broker")
    bench.config.__dict__["stop_s"] = 2.0
    with pytest.raises(ReactorError, match="plug"):
        bench.reactors.stop()
