"""The table of versions against the vendor's software of each, and the rig that runs them: asked by HTTP, no driver.

What a unit does is judged by the vial.
"""

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest

from envs.plant.plant import Plant
from hardware.clock import RealClock
from hardware.errors import ProtocolError
from hardware.pioreactor.config import PioreactorConfig, RigConfig
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.messages import NotHeard
from hardware.pioreactor.versions import TESTED, Facts, facts
from hardware.pioreactor.web import Web
from hardware.rig import build
from hardware.rig.files import flows
from hardware.rig.processes import _as_on_a_unit
from hardware.rig.vials import HEATER, MEDIA, _Vial, vial_preset
from tests.hardware.pioreactor_bench import PACKAGES, UNIT, need_the_rig, started
from tests.hardware.test_emulator_server import until
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.xdist_group("pioreactor"), pytest.mark.timeout(2.0 * PATIENCE_S)]  # one rig at a time
rig = pytest.mark.slow

ENDLESS_S = 4.0 * PATIENCE_S  # a run of a pump that does not end by itself while a test waits


class Asked:
    """A unit in the rig, its culture in a small vial; `known` is the table's word on it."""

    def __init__(self, package: str) -> None:
        self.rig = started({UNIT: 14.0}, RigConfig(package=package, od=0.5), experiment="e1")
        self.known, self.vial = facts(self.rig.version), self.rig.vials.vials[UNIT]
        self.web = Web(self.rig.web[UNIT], "e1", PATIENCE_S)

    def reached(self) -> PioreactorConfig:
        """How the driver reaches it."""
        return PioreactorConfig(reactors=(UNIT,), experiment="e1", broker="127.0.0.1", broker_port=self.rig.broker)

    def run(self, job: str, options: dict[str, Any] | None = None) -> str:
        """Ask for a job, again as long as the unit has had too many requests for it; its task."""
        tasks: list[str] = []

        def taken() -> bool:
            try:
                tasks.append(self.web.run(job, options or {}))
            except NotHeard as error:
                if error.fields.get("status") != 429:
                    raise
            return bool(tasks)

        assert until(taken)
        return tasks[0]

    def finished(self, task: str) -> bool | None:
        """What the driver makes of a task that is over."""
        said: list[bool | None] = [None]
        assert until(lambda: said.append(self.web.result(task)) or said[-1] is not None)
        return said[-1]

    def jobs(self) -> list[str]:
        """Names of the jobs that the unit lists; a busy one answers with an error while a job begins."""
        said = list[list[dict[str, Any]]]()

        def told() -> bool:
            with suppress(ProtocolError):
                said.append(self.web.running())
            return bool(said)

        assert until(told)
        return [job["job_name"] for job in said[0]]

    def settings(self, job: str) -> dict[str, Any]:
        """Of a running job; none of one that does not run."""
        with suppress(NotHeard):
            return self.web.get(f"/jobs/settings/job_name/{job}")["settings"]
        return {}

    def fed_ml(self) -> float:
        return float(self.vial.plant.feed.delivered_ml[0])

    def pulsed_ml(self) -> float:
        """By the on-times of the media pump's pin."""
        on_s = sum(pulse.seconds for pulse in self.vial.pulses if pulse.pump == "media")
        return on_s * flows(0)["media_pump"]

    def pumping(self) -> bool:
        return self.vial.duty[MEDIA] > 0.0

    def pio(self, command: str) -> int:
        """Exit status of one of the vendor's commands, typed on the unit."""
        words = [str(self.rig.folder / UNIT / "pio"), *command.split()[1:]]
        return subprocess.run(words, capture_output=True, check=False, timeout=PATIENCE_S).returncode

    @contextmanager
    def at_once(self, status: dict[str, int]) -> Iterator[None]:
        """Commands with one of these words end with its status before the vendor's program is loaded."""
        path = self.rig.folder / UNIT / "pio"
        whole = path.read_text(encoding="utf-8")
        first, rest = whole.split("\n", 1)
        cases = "".join(f'case "$*" in *{word}*) exit {code};; esac\n' for word, code in status.items())
        path.write_text(f"{first}\n{cases}{rest}", encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(whole, encoding="utf-8")


@pytest.fixture(scope="module", params=PACKAGES)
def unit(request: pytest.FixtureRequest) -> Iterator[Asked]:
    need_the_rig(PACKAGES[request.param])
    made = Asked(PACKAGES[request.param])
    try:
        assert made.rig.version == request.param
        yield made
    finally:
        made.rig.__exit__()


@rig
def test_all_that_runs_on_a_bench_runs_here(unit):
    unit.run("od_reading", {"interval": 1.0})
    unit.run("stirring")
    unit.run("temperature_automation", {"automation-name": "thermostat", "target-temperature": 37.0})
    jobs = {"monitor", "od_reading", "stirring", "temperature_automation"}
    assert until(lambda: jobs <= set(unit.jobs()))
    assert until(lambda: "ods" in unit.settings("od_reading"))
    said = json.loads(unit.settings("od_reading")["ods"])["ods"]["2"]["od"]
    assert said == pytest.approx(float(unit.vial.plant.apparent_od[0]), abs=0.05)
    assert until(lambda: unit.vial.heat >= 0.0), "the vial feels the heater"
    assert unit.settings("stirring")["$state"] == "ready"


@rig
def test_a_dose_reaches_the_vial_and_its_task_is_a_success(unit):
    """As much as its pin was on, which is what was asked or, on a busy computer, more: its job times itself."""
    fed, pulsed, had = unit.fed_ml(), unit.pulsed_ml(), len(unit.vial.pulses)
    task = unit.run("add_media", {"ml": 0.4})
    assert until(lambda: len(unit.vial.pulses) > had)
    assert unit.fed_ml() - fed == pytest.approx(unit.pulsed_ml() - pulsed)
    assert unit.fed_ml() - fed > 0.39
    assert unit.finished(task) is True


@rig
def test_a_task_whose_job_cannot_start_has_failed(unit):
    """Older versions look for half a second, in which their command may not end: a shell gives its status."""
    wrong, help_ = (unit.pio(f"pio run {words}") for words in ("add_media --no-such-option 1", "remove_waste --help"))
    assert (wrong != 0, help_) == (True, 0)
    with unit.at_once({"--no-such-option": wrong, "--help": help_}):
        assert until(lambda: unit.finished(unit.run("add_media", {"no-such-option": 1})) is False)
        unit.finished(unit.run("remove_waste", {"help": None}))


@rig
def test_a_stop_ends_its_job(unit):
    unit.run("add_media", {"duration": ENDLESS_S})
    assert until(unit.pumping)
    unit.web.stop("add_media")
    assert until(lambda: not unit.pumping())
    assert until(lambda: "add_media" not in unit.jobs())


@rig
def test_each_pump_is_told_by_the_pin_of_its_channel(unit):
    """And stirring tells all pins again when its duty is changed a little."""
    box = Mailbox(UNIT, PioreactorConfig(experiment="e1"), RealClock())
    cluster = Cluster(unit.reached(), {UNIT: box}, "test", RealClock())
    try:
        assert until(lambda: cluster.connected)
        unit.run("stirring")
        assert until(lambda: box.stir_duty > 0.0)
        for k in range(2):
            at = box.dc_s
            cluster.publish(f"pioreactor/{UNIT}/e1/stirring/duty_cycle/set", f"{30.51 + 0.01 * k:g}")
            assert until(lambda at=at: box.dc_s > at)
        for job in ("add_media", "remove_waste"):
            unit.run(job, {"duration": ENDLESS_S})
            assert until(lambda job=job: box.on() == [job])
            unit.web.stop(job)
            assert until(lambda: not box.on())
            assert box.pins[job].ran_s > 0.0
    finally:
        cluster.close()


@rig
def test_a_killed_dose_pumps_on_until_its_lock_is_cleared_by_the_version_s_command(unit):
    unit.run("add_media", {"duration": ENDLESS_S})
    assert until(unit.pumping)
    for pid in unit.rig.jobs(UNIT, "add_media"):
        os.kill(pid, signal.SIGKILL)
    had = len(unit.vial.pulses)
    unit.finished(unit.run("add_media", {"duration": 0.1}))
    assert unit.pumping(), "a chip drives it on"
    wrong = {"pio cache clear", "pio cache purge"} - {unit.known.purge}
    assert unit.pio(f"{wrong.pop()} pwm_locks {MEDIA} --as-int") == 2, "no such command"
    assert unit.pio(f"{unit.known.purge} pwm_locks {MEDIA} --as-int") == 0
    unit.run("add_media", {"duration": 0.1})
    assert until(lambda: len(unit.vial.pulses) > had)
    assert until(lambda: not unit.pumping() and not unit.rig.jobs(UNIT, "add_media"))
    assert "add_media" in unit.jobs(), "a killed job is never taken off the list by itself"
    forget = {"pio jobs remove", "pio jobs purge"} - {unit.known.forget}
    assert all(unit.pio(f"{command} --job-name add_media") == 2 for command in forget)
    if unit.known.forget:
        assert unit.pio(f"{unit.known.forget} --job-name add_media") == 0
        assert until(lambda: "add_media" not in unit.jobs())


@rig
def test_a_turbidostat_takes_the_option_of_the_table_and_no_other(unit):
    name = {"automation-name": "turbidostat", "exchange-volume-ml": 1.0}
    (other,) = {"target-od", "target-biomass"} - {unit.known.target}
    unit.finished(unit.run("dosing_automation", name | {other: 9.0}))
    assert until(lambda: "dosing_automation" not in unit.jobs())
    unit.run("dosing_automation", name | {unit.known.target: 9.0} | dict(unit.known.signal))
    assert until(lambda: unit.settings("dosing_automation").get("$state") == "ready")
    said = unit.settings("dosing_automation")
    assert float(said[unit.known.target.replace("-", "_")]) == 9.0
    assert {option.replace("-", "_"): said.get(option.replace("-", "_")) for option, _ in unit.known.signal} == {
        option.replace("-", "_"): value for option, value in unit.known.signal
    }
    unit.web.stop("dosing_automation")
    assert until(lambda: "dosing_automation" not in unit.jobs())


@rig
def test_the_unit_keeps_a_ledger_that_can_be_set_where_the_table_says_so(unit):
    route = "/bioreactor/experiments/e1"
    if not unit.known.ledger:
        with pytest.raises(NotHeard):
            unit.web.get(route)
        return
    assert unit.web.get(route)["values"][unit.known.tube] == 14.0
    assert unit.web.set_level(14.5) == ""
    assert unit.web.get(route)["values"]["current_volume_ml"] == 14.5
    before = unit.fed_ml()
    with pytest.raises(NotHeard):  # 18 mL is the most in a vial of 20
        unit.run("add_media", {"ml": 3.5})
    assert unit.fed_ml() == before


@rig
def test_the_leader_says_which_experiment_a_unit_is_in(unit):
    other = Web(unit.rig.web[UNIT], "e2", PATIENCE_S)
    assert [bool(web.astray(name)) for web, name in ((unit.web, UNIT), (unit.web, "pio09"), (other, UNIT))] == [
        False, True, True,
    ]  # fmt: skip


# -- the heater, by itself -----------------------------------------------------------------------------------------


def vial(growth_x: float = 1.0) -> _Vial:
    config = vial_preset("nominal", 14.0, 0.0, flows(0), growth_x)
    made = _Vial(UNIT, Plant(config, 1, [np.random.default_rng(0)]), growth_x, lambda _row: None)
    made.at = 0.0
    return made


def heated(made: _Vial, duty: float, seconds: float, start: float = 0.0) -> float:
    """The vial's temperature, degC, after its heater had a duty for so long."""
    made.drive(HEATER, duty, os.getpid(), start)
    for share in np.linspace(0.0, 1.0, 1 + int(seconds // 10.0))[1:]:
        made.sync(start + seconds * float(share))
    return float(made.plant.thermal.temperature[0])


def test_a_culture_keeps_its_temperature_until_the_heater_is_driven():
    made = vial()
    made.sync(3600.0)
    assert float(made.plant.thermal.temperature[0]) == pytest.approx(37.0)


@pytest.mark.parametrize("growth_x", [1.0, 2.5])
def test_heat_moves_in_real_time_whatever_the_growth(growth_x):
    made = vial(growth_x)
    assert heated(made, 0.0, 39.0 * 60.0) == pytest.approx(24.0 + 13.0 / np.e, abs=0.05)  # one time constant
    assert heated(made, 16.25, 3.5 * 3600.0, 39.0 * 60.0) == pytest.approx(37.0, abs=0.1)  # 0.8 degC per percent


def test_a_heater_falls_with_its_process():
    made = vial()
    heated(made, 40.0, 60.0)
    with subprocess.Popen(["true"]) as gone:
        gone.wait()
    made.drive(HEATER, 40.0, gone.pid, 60.0)
    made.sync(61.0)
    assert made.heat == 0.0


ESTIMATE = """import json, sys
from pioreactor.background_jobs.temperature_automation import TemperatureAutomationJob as Job
print(json.dumps([Job.approximate_temperature_20_2_0(one) for one in json.load(sys.stdin)]))
"""


@rig
def test_the_vendor_s_estimate_from_the_plate_s_cooling_is_the_vial_s_temperature(unit):
    series = []
    for duty in (10.0, 25.0, 35.0):
        made, looks = vial(), 5.3 * np.arange(21)  # of the thermostat, which heats for 95 s before them
        for start in 200.0 * np.arange(60):
            heated(made, duty, 95.0, float(start))
            made.drive(HEATER, 0.0, os.getpid(), float(start) + 95.0)
            cooling = []
            for second in start + 95.0 + looks:
                made.sync(float(second))
                cooling.append(float(made.plant.thermal.temperature[0]) + made.plate_c)
        series.append({"previous_heater_dc": duty, "time_series_of_temp": cooling, "true": cooling[-1] - made.plate_c})
    told = subprocess.run(
        [unit.rig._bin / "python", "-c", ESTIMATE], input=json.dumps(series), text=True, capture_output=True,
        check=False, env=unit.rig._variables(UNIT),
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout.splitlines()[-1]) == pytest.approx([one["true"] for one in series], abs=0.4)


def test_what_the_rig_starts_hears_ctrl_c_whoever_started_the_rig():
    """A worker holds the signal back, a background job of a shell ignores it; the vendor stops jobs by it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        job = subprocess.Popen(["sleep", "600"], preexec_fn=_as_on_a_unit)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)
        signal.signal(signal.SIGINT, before)
    job.send_signal(signal.SIGINT)
    try:
        assert job.wait(PATIENCE_S) == -signal.SIGINT
    finally:
        job.kill()


# -- the table, by itself -------------------------------------------------------------------------------------------


def test_the_table_is_read_from_its_first_row_to_the_version_s():
    """A version is newer by its numbers, not by its letters."""
    newest, oldest = facts(TESTED[-1]), Facts()
    assert {facts(v) for v in ("26.10.0", "26.10.1", "27.1.0rc1", "100.1.1")} == {newest}
    assert {facts(v) for v in ("25.11.19", "", "9.12.31", "unnamed")} == {oldest}
    assert (facts("25.12.10").forget != "", facts("25.12.10").curve_struct) == (True, False)
    assert [facts(v).purge for v in ("26.2.9", "26.2.23")] == ["pio cache clear", "pio cache purge"]
    assert [facts(v).tube for v in ("26.3.12", "26.4.0")] == [oldest.tube, newest.tube]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("pioreactor (99.1.0)\nAvailable versions: 99.1.0, 26.11.1", "99.1.0"),
        (f"pioreactor ({TESTED[-1]})", ""),
        ("", ""),
    ],
)
def test_a_newer_version_on_the_package_index_is_told_in_a_line_and_nothing_without_network(monkeypatch, said, told):
    monkeypatch.setattr(build.subprocess, "run", lambda *_given, **_how: subprocess.CompletedProcess([], 1, said, ""))
    line = build.newer()
    assert (told in line, bool(line), "\n" in line) == (True, bool(told), False)
