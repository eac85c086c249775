"""One sample per period from the vendor's readings: robust, undisturbed by the dose, never an old one."""

import json

import numpy as np
import pytest

from hardware.clock import VirtualClock
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig
from hardware.pioreactor.mailbox import Mailbox, Reading
from hardware.pioreactor.sampling import Sampling
from tests.hardware.pioreactor_lab import EXPERIMENT, UNIT, Lab, World


def mailbox():
    return Mailbox(UNIT, EXPERIMENT, "2", VirtualClock(5.0))


ODS = f"pioreactor/{UNIT}/{EXPERIMENT}/od_reading/ods"


def test_a_retained_reading_is_the_last_word_of_a_dead_job():
    box = mailbox()
    box.take(ODS, World.od(0.5, "t1").encode(), True)
    assert box.drain() == ([], [])
    assert box.refused == 1


def test_the_same_stamp_twice_is_one_reading():
    box = mailbox()
    for _ in range(2):
        box.take(ODS, World.od(0.5, "t1").encode(), False)
    assert len(box.drain()[0]) == 1


def test_a_clock_that_jumps_back_does_not_stop_the_readings():
    box = mailbox()
    for stamp in ("2026-01-01T00:00:10Z", "2025-01-01T00:00:00Z"):
        box.take(ODS, World.od(0.5, stamp).encode(), False)
    assert len(box.drain()[0]) == 2


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b'{"timestamp": 1}', b"\xff", b"null", b'{"ods": {"2": {}}}'])
@pytest.mark.parametrize(
    "topic", [ODS, ODS.replace("od_reading/ods", "dosing_events"), ODS.replace("od_reading/ods", "pwms/dc")]
)
def test_what_is_not_understood_is_left_out(topic, payload):
    box = mailbox()
    box.take(topic, payload, False)
    assert box.drain() == ([], [])


def test_readings_of_another_experiment_or_unit_are_not_ours():
    box = mailbox()
    box.take(ODS.replace(EXPERIMENT, "other"), World.od(0.5, "a").encode(), False)
    box.take(ODS.replace(UNIT, "pio02"), World.od(0.5, "b").encode(), False)
    assert box.drain()[0] == []


def test_duties_of_all_experiments_count():
    box = mailbox()
    box.take(f"pioreactor/{UNIT}/other/pwms/dc", json.dumps({"13": 100.0, "17": 30.0}).encode(), True)
    assert box.running_pins((13, 16, 12)) == [13]


def test_a_sample_is_the_median_so_one_bubble_does_not_move_it():
    sampling = Sampling(PioreactorConfig(od_zero=0.1, od_scale=2.0), 0.0)
    values = [0.60, 0.61, 0.59, 2.0, 0.60]
    sampling.take([Reading(40.0 + k, str(k), v, False) for k, v in enumerate(values)])
    sample = sampling.look(45.0, 0.0, False)
    assert sample is not None
    assert sample.number == 5
    assert sample.od == pytest.approx(2.0 * (0.60 - 0.1))
    assert sample.spread == pytest.approx(2.0 * 1.4826 * 0.01 / np.sqrt(5.0))
    assert sample.at == pytest.approx(42.0)


def test_readings_in_or_just_after_a_dose_do_not_count():
    sampling = Sampling(PioreactorConfig(), 0.0)
    sampling.take([Reading(float(k), str(k), 0.5 if k < 20 else 0.4, False) for k in range(10, 30)])
    assert sampling.look(29.0, 10.0, True) is None
    sample = sampling.look(29.0, 20.0, False)
    assert sample is not None
    assert sample.od == pytest.approx(0.4)


def test_one_sample_per_period():
    sampling = Sampling(PioreactorConfig(), 0.0)
    seen = []
    for second in range(600):
        sampling.take([Reading(float(second), str(second), 0.5, False)])
        if sampling.look(float(second), 0.0, False):
            seen.append(second)
    assert np.diff(seen).tolist() == [60] * (len(seen) - 1)
    assert len(seen) in (9, 10)


def test_a_killed_reader_is_noticed_and_asked_for_again(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin()
    lab.sample()
    lab.world.od_alive = False
    lab.world.say("od_reading/$state", "lost")
    m = lab.reactors.measure()
    while not (m.vitals.faults[0] and m.vitals.faults[0].kind == "stopped"):
        m = lab.reactors.measure()
    assert "/jobs/stop?job_name=od_reading" in lab.world.stops  # else a restart is refused as already running
    assert lab.sample().fresh[0]


def test_silence_is_told_in_the_age_of_the_sample(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin()
    lab.sample()
    lab.world.od_every_s = 1e9
    for _ in range(8):
        m = lab.reactors.measure()
    assert not m.fresh[0]
    assert m.vitals.age_s[0] > lab.reactors.config.stale_s


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"reactors": ()}, "backend.reactors"),
        ({"reactors": ("a", "a")}, "backend.reactors"),
        ({"stale_s": 50.0}, "backend.stale_s"),
        ({"max_dose_ml": 0.1, "min_dose_ml": 0.2}, "backend.max_dose_ml"),
        ({"addresses": {"x": "http://y"}}, "backend.addresses"),
        ({"od_scale": 0.0}, "backend.od_scale"),
    ],
)
def test_a_wrong_value_is_named(values, named):
    with pytest.raises(ValueError, match=named):
        PioreactorConfig(**values)


def test_addresses_have_a_default():
    config = RigBackendConfig(addresses={"pio01": "http://10.0.0.1/"})
    assert config.address("pio01") == "http://10.0.0.1"
    assert config.address("pio02") == "http://pio02.local"


def test_a_sample_that_is_due_while_pumps_are_switched_off_is_kept_for_whoever_decides(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin()
    lab.sample()
    before = len(lab.of("sample"))
    lab.world.sleep(70.0)
    lab.station.pumps_off(3.0)
    assert len(lab.of("sample")) == before
    assert lab.sample(1).fresh[0]
    assert len(lab.of("sample")) == before + 1
