"""What a run keeps going on a unit: readings, stirring, thermostat and, after a hand-over, the vendor's turbidostat."""

import numpy as np
import pytest

from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.jobs import request
from hardware.pioreactor.versions import facts
from tests.hardware.pioreactor_lab import Lab


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


@pytest.mark.parametrize("job", ["stirring", "temperature_automation"])
def test_what_never_came_up_is_a_fault(monkeypatch, job):
    lab = Lab(monkeypatch, stirring=job == "stirring", thermostat=job != "stirring")
    lab.world.barred = True
    lab.begin()
    lab.wait(30.0)
    assert lab.fault is not None
    assert lab.fault.kind == "stopped"


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
