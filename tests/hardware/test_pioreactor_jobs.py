"""What a run keeps going on a unit: readings, stirring, thermostat and, after a hand-over, the vendor's turbidostat."""

import json
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.plant.plant import PlantConfig
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError
from hardware.family import Opening
from hardware.pioreactor import messages
from hardware.pioreactor import reactors as pioreactors
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig, UnitConfig
from hardware.pioreactor.doses import replay
from hardware.pioreactor.family import FAMILY
from hardware.pioreactor.preflight import _unit
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.versions import TESTED, facts, flow, regulates, request
from hardware.pioreactor.web import Web
from hardware.rig import family as rig
from tests.hardware.pioreactor_lab import UNIT, Lab, World, sampled
from tests.hardware.script import noted


@pytest.fixture
def lab(monkeypatch):
    return sampled(monkeypatch, stirring=True, thermostat=True, temperature=30.0)


def started(lab, job):
    return [options for name, options in lab.world.asked if name == job]


@pytest.mark.parametrize(
    ("version", "forget"), [("26.7.2", "pio jobs purge --job-name {}, else reboot"), ("25.11.19", "reboot")]
)
@pytest.mark.parametrize(("job", "said"), [("stirring", "does not stir"), ("temperature_automation", "does not heat")])
def test_what_a_reboot_ended_is_named_started_again_and_holds_doses(monkeypatch, version, forget, job, said):
    """By what its version knows against it."""
    lab = sampled(monkeypatch, World(version), stirring=True, thermostat=True)
    lab.world.barred = True
    lab.world.rows.pop(job)
    lab.world.say(f"{job}/$state", "lost")
    for _ in range(5):  # as long as it is gone, also between two attempts
        lab.wait(13.0)
        assert (type(lab.fault), lab.fault.fields["gone"]) == (messages.JobGone, said)
        assert lab.fault.fields["command"].startswith(forget.format(job))
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


def test_a_unit_that_was_given_up_is_regulated_by_nobody_any_more_and_says_so_of_each_dose(lab):
    """It was handed over before; after a reboot the vendor's turbidostat stays away, too."""
    turns = (lab.reactors.regulate, messages.RegulatesItself), (lab.reactors.give_up, messages.GivenUp)
    for turn, told in turns:
        assert turn(*(np.array([True]), np.array([0.6]))[: 1 + (turn == lab.reactors.regulate)]) == []
        assert lab.reactors.handed_over.tolist() == [turn == lab.reactors.regulate]
        lab.sample()
        assert lab.dose(0.5) == 0.0
        assert noted(lab.rows[-1:], told)
    lab.world.rows.pop("dosing_automation", None)
    lab.world.say("dosing_automation/$state", "lost")
    lab.wait(60.0)
    assert len(started(lab, "dosing_automation")) == 1
    assert not lab.asked("add_media")


@pytest.mark.parametrize("job", ["stirring", "temperature_automation"])
def test_what_ends_by_itself_is_told_and_started_again_once_and_held_after_that(lab, job):
    """Or because somebody stopped it in the vendor's page."""
    for held in (False, True, True):
        lab.world.over(job)
        lab.until(lambda: lab.fault is not None, 60.0)
        assert (lab.fault.kind, "start it" in lab.fault.remedy) == ("stopped", held)
        lab.wait(300.0)
        assert (len(started(lab, job)), lab.fault is not None, lab.dose(0.5) == 0.0) == (2, held, held)
        if held:
            lab.world.ready(job, {"target-temperature": 30.0})
            lab.until(lambda: lab.fault is None, 10.0)


@pytest.mark.parametrize(
    "said", [{"experiment": "other", "is_active": 1}, {"experiment": "turbidostat", "is_active": 0}, {}]
)
def test_a_unit_that_was_reassigned_made_inactive_or_removed_is_told_and_not_dosed(lab, said):
    ours, lab.world.assigned = lab.world.assigned, said
    lab.until(lambda: lab.fault is not None, 60.0)
    assert lab.fault.kind == "mode"
    lab.sample()
    assert lab.dose(0.5) == 0.0
    for _ in range(2):  # the vendor ends it there as often as it is started, and that is no fault of the job
        lab.world.over("stirring")
        lab.wait(200.0)
    lab.world.assigned = ours
    lab.until(lambda: lab.fault is None, 200.0)


def test_a_run_keeps_its_id_when_it_is_resumed(lab, monkeypatch, tmp_path):
    """By which its doses, and its lock at the broker, are its own."""
    runs: list[str] = []

    def units(*given):
        runs.append(given[-1])
        raise KeyError

    monkeypatch.setattr(FAMILY, "units", units)
    journal = SimpleNamespace(rows=lab.rows, append=None)
    opening = Opening(lab.reactors.config, lab.bench, PlantConfig(), journal, tmp_path, resumed=True)
    with pytest.raises(KeyError), FAMILY.open(opening):
        pass
    assert runs == [lab.station.unit.run]


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


@pytest.mark.parametrize(("reading_s", "rate"), [(5.0, "0.2"), (8.0, "0.125")])
def test_readings_are_asked_for_as_often_as_the_run_wants_them_and_without_smoothing(reading_s, rate):
    """One smoothed reading in five seconds would lag behind every dose."""
    options, overrides = request("od_reading", PioreactorConfig(reading_s=reading_s), facts("26.7.2"), 37.0, np.nan)
    asked = [["samples_per_second", rate], ["smoothing_penalizer", "0"]]
    assert (options, sorted(overrides)) == ({}, [["od_reading.config", *each] for each in asked])


class Said:
    """A unit's answers, and that its queue takes what is written down."""

    url = "http://pio02.local"

    def __init__(self, channels: dict[str, str], tube: str, jobs: tuple[str, ...] = (), **answers: Any) -> None:
        self.jobs, self.answers = jobs, answers
        self.settings = {"od_config.photodiode_channel": channels, "bioreactor": {"efflux_tube_volume_ml": tube}}
        self.settings["PWM"] = {"1": "stirring", "2": "media", "3": "alt_media", "4": "waste", "5": "heating"}

    def get(self, path: str, below: str = "/unit_api") -> Any:
        curves = {"media_pump": {"curve_data_": [0.7, 0.0]}, "waste_pump": {"curve_data_": [1.6, 0.0]}}
        return {
            "health": {"pioreactor_unit": "pio02", "utc_time": "2026-11-21T00:00:00Z"},
            "app": {"version": "26.7.2"},
            "experiment": {"experiment": "turbidostat"},
            "active_calibrations": curves,
            "merged": self.settings,
        }[name := path.rpartition("/")[2]] | self.answers.get(name, {})

    astray = Web.astray
    _experiment = "turbidostat"

    def running(self) -> list[dict[str, Any]]:
        return [{"job_name": job} for job in self.jobs]

    def run(self, job: str, *_options: Any) -> str:
        return "task"

    def result(self, task: str) -> bool:
        return True

    def ask(self, what: Any, *given: Any) -> "Future[Any]":
        done: Future[Any] = Future()
        done.set_result(what(*given))
        return done


@pytest.mark.parametrize(
    ("channel", "tube", "ok"), [("1", "13.8", (True, True)), ("2", "30", (False, False)), (None, "13.8", (False, True))]
)
def test_photodiode_and_tube_are_judged_by_channel_and_volume_of_their_own_unit(channel, tube, ok, monkeypatch):
    """Which sees the culture by 1, and has the reference at 2, that of all other units, whose vials are larger."""
    web: Any = Said({"1": "90", "2": "REF", "3": "", "4": ""}, tube)
    monkeypatch.setattr(pioreactors, "Web", lambda *_given: web)
    monkeypatch.setattr(pioreactors, "Cluster", lambda *_given: SimpleNamespace(holder=lambda name: None))
    config = PioreactorConfig(reactors=("pio01", "pio02"), units={"pio02": UnitConfig(channel=channel)}, channel="2")
    units = PioreactorReactors(config, VirtualClock(), bench=Bench(volume_ml=30.0, volumes_ml={"pio02": 14.0}))
    checks = {check.name: check for check in _unit(units.stations[1], units)}
    light, volume = checks["pio02 photodiode"], checks["pio02 volume"]
    assert (light.ok, volume.ok, checks["pio02 wiring"].ok, checks["pio02 pins"].ok) == (*ok, True, False)
    assert light.detail == f"{channel or '2'} of 1 at 90 degrees"
    assert volume.detail == f"{tube} mL in its settings, 14 here"


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


def test_a_target_is_written_down_once_and_sent_once_and_nan_leaves_it(lab):
    before, said = len(lab.of("temperature")), len(lab.world.mqtt.said)
    for target in (33.0, 33.0, float("nan"), 33.0):
        lab.station.set_temperature(target)
        lab.wait(8.0)
    assert [row["temperature"] for row in lab.of("temperature")[before:]] == [33.0]
    sent = [payload for topic, payload in lab.world.mqtt.said[said:] if topic.endswith("target_temperature/set")]
    assert sent == ["33.0"]


@pytest.mark.parametrize(("stirring", "thermostat"), [(True, False), (False, True)])
def test_only_the_jobs_that_a_run_wants_run_and_each_is_started_once(monkeypatch, stirring, thermostat):
    lab = sampled(monkeypatch, stirring=stirring, thermostat=thermostat, temperature=31.0)
    lab.wait(30.0)
    wanted = {"od_reading", "stirring"} | ({"temperature_automation"} if thermostat else set())
    assert sorted(job for job, options in lab.world.asked if "help" not in options) == sorted(wanted)
    assert [options["target-temperature"] for options in started(lab, "temperature_automation")] == [31.0] * thermostat
    assert lab.station._box.live("stirring") is stirring, "switched for a moment, to hear of its pin"
    assert lab.fault is None


@pytest.mark.parametrize("stirring", [True, False])
@pytest.mark.parametrize("version", [*TESTED, "99.1.1"])
def test_nothing_is_dosed_before_the_unit_told_a_pin_that_was_switched(monkeypatch, version, stirring):
    """In whatever form; and from then on without a fault."""
    lab = Lab(monkeypatch, World(version), stirring=stirring)
    lab.world.blind = True
    lab.begin()
    lab.sample()
    assert isinstance(lab.fault, messages.PinsUntold)
    assert lab.dose(0.5) == 0.0
    lab.world.blind = False
    lab.until(lambda: lab.fault is None, 20.0)
    lab.sample()
    assert lab.dose(0.5) == 0.5
    lab.until(lambda: lab.station._box.on() == ["add_media"], 5.0)
    lab.until(lambda: lab.station._box.on() == ["remove_waste"], 5.0)
    lab.wait(5.0)
    assert lab.given() == pytest.approx((0.5, 0.5), abs=0.02)


@pytest.mark.parametrize("stirring", [True, False])
def test_pins_that_are_told_no_more_hold_doses_after_two_of_them(monkeypatch, stirring):
    lab = Lab(monkeypatch, stirring=stirring)
    lab.begin()
    doses = []
    for blind in (False, True, True, True, True):
        lab.sample()
        lab.world.blind = blind
        doses.append(lab.dose(0.5))
        lab.wait(8.0)
    assert doses == [0.5, 0.5, 0.5, 0.0, 0.0]
    assert isinstance(lab.fault, messages.PinsUntold)
    assert lab.given() == pytest.approx((1.5, 1.5), abs=0.1)
    lab.world.blind = False
    lab.until(lambda: lab.fault is None, 20.0)
    lab.sample()
    assert lab.dose(0.5) == 0.5


BELOW = "OD signal on channel 2 is below its stored blank (0.1 < 0.2). No OD reading was published."


@pytest.mark.parametrize("first", [True, False])
def test_a_reader_that_publishes_nothing_is_told_with_what_its_log_says(monkeypatch, first):
    """From 26.11 on it publishes no reading below the blank, from the beginning or in a run."""
    lab = Lab(monkeypatch)
    if first:
        lab.world.od_s = 1e9
    lab.begin()
    if not first:
        lab.sample()
        lab.world.od_s = 1e9
    lab.wait(lab.station.unit.config.reading_s + 1.0)
    said = {"task": "od_reading", "message": BELOW, "level": "ERROR"}
    lab.world.say("logs/app/error", json.dumps({**said, "task": "stirring", "message": "no reading of the rpm"}))
    lab.world.say("logs/app/error", json.dumps(said))
    lab.until(lambda: lab.fault is not None, 60.0)
    assert (type(lab.fault), lab.fault.fields) == (messages.ReaderComplains, {"log": BELOW})
    lab.world.od_s, lab.world.od_alive = 5.0, True
    lab.world._read()
    lab.until(lambda: lab.fault is None, 60.0)
    lab.world.od_alive = False
    lab.until(lambda: lab.fault is not None, 100.0)
    assert isinstance(lab.fault, messages.JobGone), "it has read since"


def test_a_web_server_that_does_not_answer_is_told_within_a_minute(lab):
    lab.world.web = False
    assert lab.until(lambda: lab.fault is not None, 60.0) > 10.0, "not every request that fails is a fault"
    assert isinstance(lab.fault, messages.WebServerSilent)
    lab.world.web = True
    lab.until(lambda: lab.fault is None, 30.0)


def test_a_flow_is_read_from_every_kind_of_curve():
    """A line as a list or as coefficients; of points that were weighed the slope of the line through 0."""
    recorded = {"x": [1.0, 2.0, "4"], "y": [0.5, 1.2, 2.0]}
    calibrations = {
        "media_pump": {"curve_data_": [0.62, 0.01]},
        "waste_pump": {"curve_data_": {"type": "poly", "coefficients": ["1.4", -0.02]}},
        "alt_media_pump": {"curve_data_": {"type": "spline", "knots": []}, "recorded_data": recorded},
    }
    flows = [flow(calibrations, pump) for pump in ("media_pump", "waste_pump", "alt_media_pump")]
    assert flows == pytest.approx([0.62, 1.4, (0.5 + 2.4 + 8.0) / 21.0])
    for curve in ([0.0, 0.5], [-0.3, 0.1], ["x", 0.0], [0.5], {"type": "poly"}, {"type": "spline"}, None):
        with pytest.raises(messages.NotCalibrated):
            flow({"media_pump": {"curve_data_": curve}, "waste_pump": {"curve_data_": [0.5, 0.0]}}, "media_pump")


def test_a_turbidostat_regulates_only_by_what_it_was_asked_for():
    asked = {"target-biomass": 0.6, "biomass-signal": "od"}
    for settings, holds in (
        ({"target_biomass": "0.6", "biomass_signal": "od", "volume": 3}, True),
        ({"target_biomass": 0.61, "biomass_signal": "od"}, False),
        ({"target_biomass": 0.6, "biomass_signal": "normalized_od"}, False),
        ({"target_biomass": 0.6}, False),
        ({"target_biomass": "many", "biomass_signal": "od"}, False),
    ):
        assert regulates({"settings": settings}, asked) is holds, settings
    assert not regulates({"error": "no such job"}, asked)


def test_each_check_of_a_unit_says_what_it_saw_and_what_helps() -> None:
    config = PioreactorConfig(reactors=("pio01", "pio02"), max_dose_ml=1.2)
    web: Any = Said(
        {"1": "90", "2": "REF", "3": "135"},
        "20",
        ("od_reading", "circulate_media", "add_alt_media", "stirring"),
        health={"pioreactor_unit": "pio09", "utc_time": "2001-11-21T00:00:00Z"},
        app={"version": "26.1.30"},
        experiment={"experiment": "older"},
    )
    unit = SimpleNamespace(web=web, leader=web, config=config.of("pio02"), volume_ml=14.0)
    mqtt = SimpleNamespace(holder=lambda name: messages.OtherClient(pid=7, host="lab", unit=name, topic="it"))
    web.settings["PWM"] = {"1": "stirring", "2": "waste", "4": "media"}
    web.settings["od_reading.config"] = {"ref_normalization": "unity"}
    doses = SimpleNamespace(pumps=SimpleNamespace(jobs=("add_media", "remove_waste")))
    station: Any = SimpleNamespace(name="pio02", unit=unit, doses=doses)
    found = list(_unit(station, SimpleNamespace(config=config, mqtt=mqtt)))  # type: ignore[arg-type]
    checks = {check.name.removeprefix("pio02 "): check for check in found}
    assert {name for name, check in checks.items() if not check.ok and check.required} == {
        "identity", "experiment", "photodiode", "scale", "wiring", "client", "dosing",
    }  # fmt: skip
    assert {name for name, check in checks.items() if not check.ok and not check.required} == {"version"}
    assert checks["identity"].detail == "the unit at http://pio02.local is pio09"
    assert "experiment older, backend.experiment = turbidostat" in checks["experiment"].detail
    assert checks["photodiode"].detail == "2 of 1 at 90 degrees, 3 at 135 degrees"
    assert checks["dosing"].detail == "add_alt_media, circulate_media"
    assert "pio jobs remove --job-name add_alt_media" in checks["dosing"].remedy
    assert checks["client"].detail == "process 7 on lab controls pio02: one client per unit"
    assert checks["client"].remedy.endswith("it")
    pumps = [checks[f"{pump}_pump"].detail for pump in ("media", "waste")]
    assert pumps == ["0.700 mL/s at its calibrated duty", "1.600 mL/s at its calibrated duty"]
    assert checks["volume"].detail == "not set mL in its settings, 14 here"


def test_a_reader_that_the_broker_takes_for_lost_is_there_as_long_as_it_reads(monkeypatch):
    """Ten times faster: a reading a second of the unit, every ten of the culture."""
    lab = Lab(monkeypatch, speed=10.0, reading_s=1.0)
    lab.world.od_s = 1.0
    lab.begin()
    lab.sample()
    lab.world.say("od_reading/$state", "lost")
    for _ in range(5):
        lab.wait(5.0)
        assert lab.fault is None
    assert len(started(lab, "od_reading")) == 1


def test_a_broker_that_does_not_answer_is_waited_for_half_a_minute_and_one_that_refuses_not_at_all(monkeypatch):
    lab = Lab(monkeypatch, broker="lead.local", broker_port=1884)
    lab.world.broker = False
    began = lab.world.now()
    with pytest.raises(messages.BrokerRefuses) as silent:
        lab.reactors.connect()
    assert silent.value.fields["broker"] == "lead.local:1884"
    assert lab.world.now() - began == pytest.approx(30.0, abs=0.2)
    lab.reactors.mqtt.refusal, began = "Not authorized", lab.world.now()
    with pytest.raises(messages.BrokerRefuses) as refused:
        lab.reactors.connect()
    assert refused.value.fields["why"] == "Not authorized"
    assert lab.world.now() == began
