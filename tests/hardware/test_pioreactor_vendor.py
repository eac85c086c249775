"""The driver against the vendor's own software, in the suite that always runs: one rig for all tests of this file.

Judged by what was really in the vial and by the driver's own bounds; no deadline is one that a busy computer misses.
The tests take turns at one unit, each leaves it settled; tests/hardware/test_pioreactor_rig.py has what takes longer.
"""

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace

import pytest

from envs.bench import Bench
from hardware.clock import RealClock
from hardware.pioreactor.preflight import preflight
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.versions import facts
from tests.hardware.pioreactor_bench import PACKAGES, UNIT, UnitBench, need_the_rig
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("pioreactor"), pytest.mark.timeout(2.0 * PATIENCE_S)]  # one rig

LATE_ML = 0.3  # messages on a computer whose cores are all taken


@pytest.fixture(scope="module", params=PACKAGES)
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UnitBench]:
    package = PACKAGES[request.param]
    need_the_rig(package)
    folder, values = tmp_path_factory.mktemp("unit"), {"speed": 10.0, "period_s": 30.0, "start_s": 60.0}
    made = UnitBench(folder, package, max_dose_ml=3.0, **values)
    try:
        assert made.sample()
        yield made
    finally:
        made.end()


def asked_for(bench: UnitBench, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The pump jobs that are asked for from now on, apart from short ones that switch a pin off."""
    jobs: list[str] = []
    run = bench.station.unit.web.run

    def noted(job, options, overrides=()):
        jobs.extend([job] * ("ml" in options))
        return run(job, options, overrides)

    monkeypatch.setattr(bench.station.unit.web, "run", noted)
    return jobs


def test_preflight_passes(bench, monkeypatch):
    monkeypatch.setattr("hardware.pioreactor.preflight.QUEUE_S", PATIENCE_S)
    assert not [str(check) for check in preflight(bench.reactors) if not check.ok]


def test_what_a_run_would_lack_is_named_with_what_helps(bench, monkeypatch):
    monkeypatch.setattr("hardware.pioreactor.preflight.QUEUE_S", PATIENCE_S)
    config = replace(bench.config, experiment="other", channel="4")
    reactors = PioreactorReactors(config, RealClock(), bench=Bench(volume_ml=14.0))
    try:
        checks = {check.name.removeprefix(f"{UNIT} "): check for check in preflight(reactors)}
    finally:
        reactors.close()
    assert not checks["experiment"].ok
    assert "turbidostat, backend.experiment = other" in str(checks["experiment"])
    assert not checks["photodiode"].ok
    assert "4 of 2 at 90 degrees" in str(checks["photodiode"])
    assert not checks["client"].ok, "the program of this test controls the unit"
    assert "20.0 mL in its settings, 14 here" in str(checks["volume"])
    assert checks["version"].ok
    assert checks["task queue"].ok


def test_a_unit_of_the_rig_cannot_shut_this_computer_down(bench):
    found = shutil.which("sudo", path=bench.rig._variables(UNIT)["PATH"])
    assert found is not None
    assert found.startswith(str(bench.rig.folder))
    assert subprocess.run([found, "true"], check=False).returncode == 1


def test_a_sample_is_the_culture_s_and_a_dose_reaches_it_once_and_as_much_leaves_it(bench, monkeypatch):
    before = bench.od()
    assert bench.sample()
    assert before - 0.02 < bench.station.sampling.od < bench.od() + 0.02, "it grows meanwhile"
    jobs = asked_for(bench, monkeypatch)
    assert bench.dose(0.8) == 0.8
    assert bench.settled()
    assert (jobs[0], set(jobs[1:])) == ("add_media", {"remove_waste"})
    assert float(bench.rig.vials.vials[UNIT].plant.vessel.volume_ml[0]) == pytest.approx(20.0, abs=0.05)
    bench.judge(LATE_ML)


@pytest.mark.parametrize("at_its_end", [False, True])
def test_a_dose_whose_process_is_killed_is_an_alarm_and_nothing_is_sent_until_it_is_off(bench, monkeypatch, at_its_end):
    bench.kill_a_dose(monkeypatch, at_its_end)
    assert bench.sample()
    assert bench.dose(3.0) == 3.0
    purge = facts(bench.rig.version).purge
    assert bench.go_on(lambda: f"{purge} pwm_locks 13 --as-int" in str(bench.station.book.fault))
    jobs = asked_for(bench, monkeypatch)
    assert bench.pumping(), "a chip drives it on"
    assert bench.dose(0.5) == 0.0
    bench.clear_the_lock()
    assert bench.settled()
    assert set(jobs) <= {"remove_waste"}
    assert not bench.pumping()
    bench.judge(LATE_ML)


def test_a_killed_program_goes_on_from_its_journal_and_its_stop_is_verified(bench):
    bench.die()
    bench.live()
    assert bench.sample()
    assert bench.dose(0.5) == 0.5
    assert bench.settled()
    bench.judge(LATE_ML)  # ids among them: of both lives
    bench.reactors.stop()
    assert not any(bench.rig.vials.vials[UNIT].duty.values())
    assert bench.journal.reread()[-1]["not_verified"] == []
