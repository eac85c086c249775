"""What a run keeps going on a unit: readings, stirring, thermostat and, after a hand-over, the vendor's turbidostat."""

from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError
from hardware.pioreactor import reactors as pioreactors
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig, UnitConfig
from hardware.pioreactor.jobs import request
from hardware.pioreactor.mailbox import Mailbox
from hardware.pioreactor.preflight import _unit
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.resume import replay
from hardware.pioreactor.versions import Facts, facts
from hardware.rig import family as rig
from tests.hardware.pioreactor_lab import UNIT, Lab, World


@pytest.fixture
def lab(monkeypatch):
    made = Lab(monkeypatch, stirring=True, thermostat=True, temperature=30.0)
    made.begin()
    made.sample()
    return made


def started(lab, job):
    return [options for name, options in lab.world.asked if name == job]


def test_each_is_started_once(lab):
    for _ in range(3):
        lab.sample()
    assert [len(started(lab, job)) for job in ("od_reading", "stirring", "temperature_automation")] == [1, 1, 1]
    assert started(lab, "temperature_automation")[0]["target-temperature"] == 30.0


@pytest.mark.parametrize("job", ["stirring", "temperature_automation"])
def test_what_a_reboot_ended_is_started_again_and_nothing_is_dosed_without_it(lab, job):
    lab.world.barred = True
    lab.world.rows.pop(job)
    lab.world.say(f"{job}/$state", "lost")
    for _ in range(5):  # as long as it is gone, also between two attempts
        lab.wait(13.0)
        assert lab.fault is not None
        assert lab.fault.kind == "stopped"
    assert lab.dose(0.5) == 0.0
    assert 2 <= len(started(lab, job)) - 1 <= 4
    lab.world.barred = False
    lab.until(lambda: lab.fault is None, 30.0)
    lab.sample()
    assert lab.dose(0.5) == 0.5


@pytest.mark.parametrize("rebooted", [False, True])
def test_a_resumed_run_heats_to_what_was_set_last_and_not_to_the_first_temperature(monkeypatch, lab, rebooted):
    """30 degC by its config, 33.4 by the scenario when it was killed."""
    lab.station.set_temperature(33.4)
    lab.until(lambda: lab.station._box.target == 33.4, 10.0)
    world = World() if rebooted else lab.world
    world.box = None
    again = Lab(monkeypatch, world, stirring=True, thermostat=True, temperature=30.0)
    again.begin(replay(lab.rows)[UNIT], 60.0)
    again.wait(10.0)
    assert again.station._box.target == 33.4
    assert started(again, "temperature_automation")[-1]["target-temperature"] == (33.4 if rebooted else 30.0)


@pytest.mark.parametrize("job", ["stirring", "temperature_automation"])
def test_what_never_came_up_is_a_fault(monkeypatch, job):
    lab = Lab(monkeypatch, stirring=job == "stirring", thermostat=job != "stirring")
    lab.world.barred = True
    lab.begin()
    lab.wait(30.0)
    assert lab.fault is not None
    assert lab.fault.kind == "stopped"


def test_readings_that_somebody_stopped_are_started_again(lab):
    """Stirring may be somebody's wish; without readings nothing is controlled."""
    lab.world.od_alive = False
    lab.world.over("od_reading")
    lab.until(lambda: lab.fault is not None and lab.fault.kind == "stopped", 120.0)
    lab.until(lambda: len(started(lab, "od_reading")) == 2, 60.0)
    lab.until(lambda: lab.fault is None, 60.0)
    lab.sample()


def test_a_unit_that_was_given_up_is_regulated_by_nobody_any_more(lab):
    """It was handed over before; after a reboot the vendor's turbidostat stays away, too."""
    assert lab.reactors.regulate(np.array([True]), np.array([0.6])) == []
    assert lab.reactors.handed_over.tolist() == [True]
    assert lab.reactors.give_up(np.array([True])) == []
    assert lab.reactors.handed_over.tolist() == [False]
    lab.world.rows.pop("dosing_automation", None)
    lab.world.say("dosing_automation/$state", "lost")
    lab.wait(60.0)
    assert len(started(lab, "dosing_automation")) == 1


def test_what_somebody_stops_in_the_vendors_page_stays_stopped(lab):
    lab.world.over("stirring")
    lab.wait(60.0)
    assert lab.fault is None
    assert len(started(lab, "stirring")) == 1


def test_a_target_told_while_the_thermostat_starts_is_told_again(lab):
    lab.world.say("temperature_automation/$state", "init")
    lab.station.set_temperature(33.0)
    lab.wait(5.0)
    assert lab.station._box.target == 30.0
    lab.world.say("temperature_automation/$state", "ready")
    lab.wait(5.0)
    assert lab.station._box.target == 33.0
    told = len(lab.world.mqtt.said)
    lab.world.say("temperature_automation/target_temperature", "35.0")  # the operator
    lab.wait(30.0)
    assert len(lab.world.mqtt.said) == told


def test_a_thermostat_switched_off_is_not_started_again(lab):
    lab.world.later(0.5, lambda: lab.world.say("temperature_automation/$state", "lost"))
    assert lab.reactors.heat_off(np.array([True])) == []
    lab.wait(60.0)
    lab.station.set_temperature(33.0)
    lab.wait(30.0)
    assert len(started(lab, "temperature_automation")) == 1
    assert lab.fault is None


def test_doses_of_the_vendors_turbidostat_are_counted_and_no_fault(lab):
    assert lab.reactors.regulate(np.array([True]), np.array([0.6])) == []
    assert started(lab, "dosing_automation")[0]["target-biomass"] == 0.6
    lab.world.event("add_media", 0.5, "dosing_automation:turbidostat")
    lab.wait(1.0)
    assert lab.fault is None
    ((_, receipt),) = lab.reactors.repeated()
    assert receipt.volume_ml[0] == pytest.approx(0.5)
    lab.world.rows.pop("dosing_automation")
    lab.world.say("dosing_automation/$state", "lost")  # a reboot
    lab.wait(30.0)
    assert len(started(lab, "dosing_automation")) == 2


@pytest.mark.parametrize(("version", "target"), [("25.11.19", "target-od"), ("26.7.2", "target-biomass")])
def test_the_vendors_turbidostat_is_told_readings_of_its_own_scale_and_the_channel_of_ours(version, target):
    config = PioreactorConfig(od_zero=0.1, od_scale=2.0, channel="1")
    options, overrides = request("dosing_automation", config, facts(version), 37.0, 1.0)
    assert options[target] == pytest.approx(0.6)  # 1.0 / 2 + 0.1
    assert overrides == [["turbidostat.config", "signal_channel", "1"]]


def test_readings_are_asked_for_as_often_as_the_run_wants_them_and_without_smoothing() -> None:
    """One smoothed reading in five seconds would lag behind every dose."""
    for reading_s, rate in ((5.0, "0.2"), (8.0, "0.125")):
        options, overrides = request("od_reading", PioreactorConfig(reading_s=reading_s), facts("26.7.2"), 37.0, np.nan)
        assert options == {}
        assert sorted(overrides) == [
            ["od_reading.config", "samples_per_second", rate],
            ["od_reading.config", "smoothing_penalizer", "0"],
        ]


def test_a_version_is_newer_by_its_numbers_not_by_its_letters() -> None:
    newest, oldest = facts("26.7.2"), Facts()
    assert facts("26.10.1") == facts("27.1.0") == facts("100.1.1") == newest
    assert facts("9.12.31") == facts("25.9.30") == facts("unnamed") == oldest
    assert facts("26.2.9").purge == "pio cache clear" != facts("26.2.23").purge
    assert (facts("26.3.12").tube, facts("26.4.0").tube) == (oldest.tube, newest.tube)
    assert [facts(v).succeeded for v in ("26.4.3", "26.4.4", "26.4.10")] == ["complete", "succeeded", "succeeded"]


def test_only_what_a_unit_says_itself_is_a_sign_of_its_life() -> None:
    """Not what the broker says of a job that died, what others tell a job, or what is retained."""
    clock = VirtualClock(100.0)
    box = Mailbox("pio01", PioreactorConfig(), clock)
    below = "pioreactor/pio01/turbidostat/"
    for job, payload, retained, alive in (
        ("stirring/$state", b"ready", False, True),
        ("add_media/$state", b"lost", False, False),
        ("od_reading/$state", b"lost", False, False),
        ("stirring/duty_cycle/set", b"30", False, False),
        ("add_media/$state/set", b"disconnected", False, False),
        ("stirring/$state", b"ready", True, False),
        ("add_media/$state", b"disconnected", False, True),
        ("temperature_automation/temperature", b'{"temperature": 36.5}', False, True),
    ):
        before = box.heard_s
        clock.sleep(5.0)
        box.take(below + job, payload, retained)
        assert (job, box.heard_s) == (job, clock.now() if alive else before)


class Said:
    """A unit's answers, and that its queue takes what is written down."""

    url = "http://pio02.local"

    def __init__(self, channels: dict[str, str], tube: str) -> None:
        self.settings = {"od_config.photodiode_channel": channels, "bioreactor": {"efflux_tube_volume_ml": tube}}

    def get(self, path: str, below: str = "/unit_api") -> Any:
        curve = {"curve_data_": {"type": "poly", "coefficients": [0.7, 0.0]}}
        return {
            "/health": {"pioreactor_unit": "pio02", "utc_time": "2026-11-21T00:00:00Z"},
            "/versions/app": {"version": "26.7.2"},
            "/workers/pio02/experiment": {"experiment": "turbidostat"},
            "/active_calibrations": {"media_pump": curve, "waste_pump": curve},
            "/config/merged": self.settings,
        }[path]

    def running(self) -> list[dict[str, Any]]:
        return []

    def run(self, job: str, options: Any) -> str:
        return "task"

    def result(self, task: str) -> bool:
        return True

    def ask(self, what: Any, *given: Any) -> "Future[Any]":
        done: Future[Any] = Future()
        done.set_result(what(*given))
        return done


@pytest.mark.parametrize(("channel", "ok"), [("1", True), ("2", False), (None, False)])
def test_a_photodiode_is_judged_by_the_channel_of_its_own_unit(channel: str | None, ok: bool) -> None:
    """Which sees the culture by 1, and has the reference at 2, that of all other units."""
    config = PioreactorConfig(reactors=("pio01", "pio02"), units={"pio02": UnitConfig(channel=channel)}, channel="2")
    web: Any = Said({"1": "90", "2": "REF", "3": "", "4": ""}, "13.8")
    unit = SimpleNamespace(web=web, config=config.of("pio02"), volume_ml=14.0)
    mqtt = SimpleNamespace(holder=lambda name: "")
    found = _unit(SimpleNamespace(name="pio02", unit=unit), SimpleNamespace(config=config, mqtt=mqtt), web)  # type: ignore[arg-type]
    checks = {check.name: check for check in found}
    assert (checks["pio02 photodiode"].ok, checks["pio02 volume"].ok) == (ok, True)
    assert checks["pio02 photodiode"].detail == f"{channel or '2'} of 1 at 90 degrees"


@pytest.mark.parametrize(("tube", "ok"), [("13.8", True), ("30", False)])
def test_a_tube_is_judged_by_the_volume_of_its_own_unit(tube: str, ok: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    web: Any = Said({"1": "90", "2": "REF"}, tube)
    monkeypatch.setattr(pioreactors, "Web", lambda *_given: web)
    monkeypatch.setattr(pioreactors, "Cluster", lambda *_given: SimpleNamespace(holder=lambda name: ""))
    bench = Bench(volume_ml=30.0, volumes_ml={"pio02": 14.0})
    units = PioreactorReactors(PioreactorConfig(reactors=("pio01", "pio02")), VirtualClock(), bench=bench)
    checks = {check.name: check for check in _unit(units.stations[1], units, web)}
    found = checks["pio02 volume"]
    assert (found.ok, found.detail) == (ok, f"{tube} mL in its settings, 14 here")


def test_a_rig_has_vials_of_the_volume_of_each_unit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made: list[dict[str, float]] = []

    class Started:
        def __init__(self, cultures: dict[str, float], *_given: Any) -> None:
            made.append(cultures)
            self.web, self.version, self.broker = dict.fromkeys(cultures, "http://127.0.0.1:1"), "26.7.2", 1883

        def __enter__(self) -> "Started":
            return self

        def __exit__(self, *_error: object) -> None:
            pass

    monkeypatch.setattr(rig, "Rig", Started)
    backend = RigBackendConfig(reactors=("pio01", "pio02", "pio03"))
    bench = Bench(volume_ml=14.0, volumes_ml={"pio02": 30.0})
    with rig.FAMILY.reached(backend, bench, tmp_path):
        assert made == [{"pio01": 14.0, "pio02": 30.0, "pio03": 14.0}]


class Busy:
    """A unit whose pumps take so many steps to be verified off; `steps` counts how often it went on meanwhile."""

    def __init__(self, takes: int, fails: bool = False) -> None:
        self.takes, self.fails, self.steps = takes, fails, 0

    def go_on(self) -> None:
        self.steps += 1

    def pumps_off(self) -> Iterator[float]:
        for _ in range(self.takes):
            yield 0.1
        if self.fails:
            raise DeviceStateError("stuck")


def test_while_one_unit_is_switched_off_the_others_go_on() -> None:
    quick, slow, stuck, beside = Busy(2), Busy(50), Busy(10, fails=True), Busy(0)
    units = object.__new__(PioreactorReactors)
    units.stations, units._real = (quick, slow, stuck, beside), VirtualClock()  # type: ignore[assignment]
    failed = units._all((quick, slow, stuck), Busy.pumps_off)  # type: ignore[arg-type]
    assert {str(error) for error in failed.values()} == {"stuck"}
    assert list(failed) == [stuck]
    assert beside.steps == 51  # all the time
    assert (quick.steps, slow.steps, stuck.steps) == (51 - 2, 1, 51 - 10)  # from when on their pumps were off
