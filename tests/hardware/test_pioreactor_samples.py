"""One sample per period from the vendor's readings: robust, undisturbed by the dose, never an old one."""

import contextlib
import itertools
import json
import math
import random
import string

import numpy as np
import pytest

from envs.bench import Bench
from hardware.clock import VirtualClock
from hardware.errors import UnfitError
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig, UnitConfig
from hardware.pioreactor.family import PioreactorFamily
from hardware.pioreactor.mailbox import LIVE, LOCKS, MEDIA, WASTE, WORDS, Cluster, Mailbox, Reading, State
from hardware.pioreactor.messages import JobGone, MessageIgnored
from hardware.pioreactor.sampling import UnitSampling
from hardware.safety.config import RAW_MIN
from tests.hardware.pioreactor_lab import EXPERIMENT, UNIT, Lab, World, sampled
from tests.hardware.script import noted


def mailbox():
    return Mailbox(UNIT, PioreactorConfig(), VirtualClock(5.0))


ODS = f"pioreactor/{UNIT}/{EXPERIMENT}/od_reading/ods"


@pytest.mark.parametrize(
    ("said", "count"),
    [
        ([("t1", True)], 0),  # retained: the last word of a job that may be dead
        ([("t1", False), ("t1", False)], 1),  # the same one twice
        ([("2026-01-01T00:00:10Z", False), ("2025-01-01T00:00:00Z", False)], 2),  # a clock that jumped back
    ],
)
def test_each_reading_that_is_said_now_counts_once(said, count):
    box = mailbox()
    for stamp, retained in said:
        box.take(ODS, World.od(0.5, stamp).encode(), retained)
    assert [reading.at for reading in box.drain()[0]] == [5.0] * count


@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize("before", ["", *WORDS])
def test_what_a_job_said_of_itself_has_its_time_and_what_is_retained_has_none(word, before):
    """Nobody knows when a retained word was said: it moves no pin, is no sign of life, and of another run no job."""
    jobs = ("add_media", "remove_waste", "stirring", "dosing_automation")
    for experiment, job in itertools.product((EXPERIMENT, "older"), jobs):
        clock, mine = VirtualClock(5.0), experiment == EXPERIMENT
        box, topic = Mailbox(UNIT, PioreactorConfig(), clock), f"pioreactor/{UNIT}/{experiment}/{job}/$state"
        if before:
            box.take(topic, before.encode(), False)
            assert box.states[experiment, job] == State(before, 5.0)
        clock.sleep(7.0)
        heard_s, pins = box.heard_s, [vars(pin).copy() for pin in box.pins.values()]
        box.take(topic, word.encode(), True)
        assert box.states[experiment, job] == State(word, 5.0 if word == before else -math.inf)
        assert (box.heard_s, [vars(pin) for pin in box.pins.values()]) == (heard_s, pins)
        assert box.live(job) == (word in LIVE and (mine or word == before))
        assert box.state(job) == (box.states[experiment, job] if mine else State())
        clock.sleep(2.0)
        box.take(topic, word.encode(), False)
        assert box.states[experiment, job] == State(word, 14.0)
        assert box.live(job) == (word in LIVE)
        assert box.heard_s == (heard_s if word == "lost" else 14.0)  # that is the broker's word


def test_a_pin_that_is_retained_as_on_runs_since_nobody_knows_when():
    box = mailbox()
    box.take(f"pioreactor/{UNIT}/{EXPERIMENT}/pwms/dc", b'{"13": 100.0}', True)
    assert (box.on(), box.pins[MEDIA].on_s, box.dc_s) == ([MEDIA], -math.inf, -math.inf)
    box.take(f"pioreactor/{UNIT}/{EXPERIMENT}/pwms/dc", b"{}", False)
    assert (box.on(), box.pins[MEDIA].off_s, box.pins[MEDIA].ran_s, box.dc_s) == ([], 5.0, 0.0, 5.0)


@pytest.mark.parametrize("payload", [b"{", b"[]", b'{"timestamp": 1}', b"\xff", b"null", b'{"ods": {"2": {}}}'])
@pytest.mark.parametrize("rest", ["od_reading/ods", "dosing_events", "pwms/dc"])
def test_what_is_not_understood_is_left_out_and_said_once(rest, payload):
    box = mailbox()
    for _ in range(2):
        box.take(ODS.replace("od_reading/ods", rest), payload, False)
    readings, events, ignored = box.drain()
    assert (readings, events, len(ignored), box.on()) == ([], [], 1, [])


NUMBERS = [
    "1", "0", "-0.5", "NaN", "Infinity", "-Infinity", "1e999", "9" * 400, "null", "true", '"x"', '"1"', "[]", "{}",
]  # fmt: skip


def word(rng):
    """A value of JSON or what looks like one, of any depth."""
    kind = rng.randrange(6)
    if kind == 0:
        return rng.choice(NUMBERS)
    if kind == 1:
        deep = rng.choice([2, 50, 5000, 50_000])
        return "[" * deep + "]" * deep
    if kind == 2:
        keys = rng.sample(["timestamp", "ods", "2", "od", "volume_change", "event", "source_of_event", "13", "x"], 4)
        return "{" + ", ".join(f'"{key}": {word(rng)}' for key in keys) + "}"
    if kind == 3:
        one = f'{{"od": {rng.choice(NUMBERS)}, "channel": "2"}}'
        return f'{{"timestamp": {rng.choice(NUMBERS)}, "ods": {{"{rng.choice("12x")}": {one}}}}}'
    if kind == 4:
        ml, source = rng.choice(NUMBERS), rng.choice(['"CLI"', "null", "3", "[]"])
        event = rng.choice(['"add_media"', '"remove_waste"', '"x"', "null", "[]"])
        return f'{{"volume_change": {ml}, "event": {event}, "source_of_event": {source}, "timestamp": 1}}'
    return "".join(rng.choices(string.printable, k=rng.choice([0, 1, 10, 1000])))


RESTS = [
    "od_reading/ods", "dosing_events", "pwms/dc", "stirring/duty_cycle", "temperature_automation/temperature",
    "temperature_automation/target_temperature", "add_media/$state", "od_reading/$state", "stirring/$state",
    "dosing_automation/$state", "pwms/channel_dc", "", "//", "$state",
]  # fmt: skip


def test_messages_of_any_kind_leave_a_loop_that_lives_and_a_ledger_that_is_finite(monkeypatch):
    """Types, sizes, depths, NaN, wrong units, retained or not; a dose is given between them all the same."""
    lab, rng = Lab(monkeypatch), random.Random(3)
    lab.begin()
    lab.sample()
    box = lab.world.box
    for k in range(5_000):
        rest = rng.choice(RESTS)
        payload = word(rng).encode() if rng.random() < 0.9 else rng.randbytes(rng.choice([0, 5, 200_000]))
        if rest.endswith("$state") and payload in (b"ready", b"init"):
            continue
        topic = f"pioreactor/{rng.choice([UNIT, 'pio77', ''])}/{rng.choice([EXPERIMENT, 'older', ''])}/{rest}"
        box.take(topic, payload, rng.random() < 0.3)
        if k % 250 == 0:
            lab.wait(0.5)
    notes = [note["topic"] for note in noted(lab.rows, MessageIgnored)]
    assert len(notes) == len(set(notes))
    for kind in ("ods", "dosing_events", "dc", "duty_cycle", "temperature", "$state"):
        assert any(topic.endswith(kind) for topic in notes), f"{kind}: what it ignored is said"
    assert all(len(row["note"]) < 300 for row in lab.of("note"))
    assert all(np.isfinite([row["feed_ml"], row["waste_ml"]]).all() for row in lab.of("given"))
    assert all(np.isfinite(row["od"]) for row in lab.of("sample"))
    lab.world.pins()  # the unit's own word on its pins
    lab.until(lambda: not lab.station.doses.running, 120.0)
    lab.sample(60)
    lab.dose(0.0)  # what was dosed by somebody, as they said, is counted and seen by whoever decides
    lab.sample(60)
    assert lab.dose(0.5) == 0.5


def test_a_message_for_the_lock_of_the_cluster_may_say_anything(monkeypatch):
    lab = Lab(monkeypatch)
    link = Cluster.__new__(Cluster)
    link._boxes, link._lock, link._others = {UNIT: lab.world.box}, f"{LOCKS}us", {}
    rng = random.Random(5)
    said = ('{"units": 3}', '{"units": "pio01"}', '{"units": {"pio01": 1}}', "[]", "null")
    for payload in (*said, *(word(rng) for _ in range(500))):
        with contextlib.suppress(ValueError, RecursionError):  # which the link counts
            link._message(f"{LOCKS}other", payload.encode(), True)
        assert link.holder(UNIT) is None


def test_readings_of_another_experiment_or_unit_are_not_ours():
    box = mailbox()
    box.take(ODS.replace(EXPERIMENT, "other"), World.od(0.5, "a").encode(), False)
    box.take(ODS.replace(UNIT, "pio02"), World.od(0.5, "b").encode(), False)
    assert box.drain()[0] == []


def test_a_sample_is_the_median_so_one_bubble_does_not_move_it():
    sampling = UnitSampling(PioreactorConfig(od_zero=0.1, od_scale=2.0), 60.0, 0.0)
    values = [0.60, 0.61, 0.59, 2.0, 0.60]
    sampling.take([Reading(40.0 + k, v) for k, v in enumerate(values)])
    assert sampling.look(45.0, 0.0)
    assert sampling.number == 5
    assert sampling.od == pytest.approx(2.0 * (0.60 - 0.1))
    assert sampling.spread == pytest.approx(2.0 * 1.4826 * 0.01 / np.sqrt(5.0))
    assert sampling.at == pytest.approx(42.0)


@pytest.mark.parametrize("late_s", [1, 7])
def test_samples_keep_their_beat_also_when_each_is_looked_at_late(late_s):
    sampling = UnitSampling(PioreactorConfig(), 60.0, 0.0)
    seen = []
    for second in range(0, 3600, late_s):
        sampling.take([Reading(float(second - k), 0.5) for k in range(late_s - 1, -1, -2)])
        seen += [second] if sampling.look(float(second), 0.0) else []
    assert len(seen) in (60, 61)
    assert np.diff(seen) == pytest.approx(60, abs=late_s - 1)


@pytest.mark.parametrize("said", ["lost", "ready", "disconnected"])
def test_a_reader_that_brings_nothing_is_noticed_and_started_anew_whatever_it_says(monkeypatch, said):
    """Killed, stopped, or, as when the vendor's lock on the lamp was left behind, there by its own word."""
    lab = sampled(monkeypatch)
    lab.world.od_alive = False
    lab.world.say("od_reading/$state", said)
    lab.until(lambda: lab.fault is not None and lab.fault.kind == "stopped", 100.0)
    assert isinstance(lab.reactors.measure().vitals.faults[0], JobGone)
    lab.until(lambda: lab.fault is None, 100.0)
    assert lab.sample(60).fresh[0]
    assert len([job for job, _ in lab.world.asked if job == "od_reading"]) == 2
    assert lab.dose(0.5) == 0.5


def test_silence_is_told_in_the_age_of_the_sample_and_counted_from_the_start_at_most(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.sleep(200.0)  # a preflight, say
    lab.world.od_s = 14.0
    lab.begin()
    assert lab.reactors.measure().vitals.age_s[0] < lab.bench.stale_s
    lab.sample()
    lab.world.od_s = 1e9
    for _ in range(8):
        m = lab.reactors.measure()
    assert not m.fresh[0]
    assert m.vitals.age_s[0] > lab.bench.stale_s


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"reactors": ("a", "a")}, "backend.reactors"),
        ({"reading_s": 10.0, "window_s": 10.0}, r"backend.window_s = 10.0 s: allowed more than 10 s"),
        ({"speed": 6.0}, r"backend.window_s = 30.0 s: allowed more than 30 s"),
        ({"max_dose_ml": 0.1, "min_dose_ml": 0.2}, "backend.max_dose_ml"),
        ({"units": {"x": UnitConfig(address="http://y")}}, "backend.units"),
        ({"experiment": "a/b"}, "backend.experiment"),
    ],
)
def test_a_wrong_value_is_named(values, named):
    with pytest.raises(ValueError, match=named):
        PioreactorConfig(**values)


def test_a_sample_that_is_due_while_pumps_are_switched_off_is_kept_for_whoever_decides(monkeypatch):
    lab = sampled(monkeypatch)
    before = len(lab.of("sample"))
    lab.world.sleep(70.0)
    assert lab.reactors.pumps_off(np.array([True])) == []
    assert len(lab.of("sample")) == before
    assert lab.sample(1).fresh[0]
    assert len(lab.of("sample")) == before + 1


def test_two_units_have_their_own_values(monkeypatch):
    """All units have a zero of 0.3 but the second, whose calibration is active: its own 0.0 stands."""
    units = {"pio02": UnitConfig(channel="1", od_zero=0.0)}
    shared = {"reactors": ("pio01", "pio02"), "od_zero": 0.3, "od_scale": 2.5, "units": units}
    lab = Lab(monkeypatch, volume_ml=35.0, volumes_ml={"pio02": 14.0}, **shared)
    assert [station.unit.volume_ml for station in lab.reactors.stations] == [35.0, 14.0]
    config = PioreactorConfig(**shared)
    assert PioreactorFamily().rim_ml(lab.bench.volumes(config.reactors)).tolist() == [36.0, 18.0]
    own = [(one.channel, one.od_zero, one.od_scale) for one in map(config.of, config.reactors)]
    assert own == [("2", 0.3, 2.5), ("1", 0.0, 2.5)]
    box = Mailbox("pio02", config, VirtualClock(5.0))
    said = {"timestamp": "t", "ods": {"1": {"od": 0.4}, "2": {"od": 9.0}}}
    box.take("pioreactor/pio02/turbidostat/od_reading/ods", json.dumps(said).encode(), False)
    (reading,), _, _ = box.drain()
    sampling = UnitSampling(config.of("pio02"), 60.0, 0.0)
    sampling.take([reading, reading])
    assert sampling.look(6.0, 0.0)
    assert sampling.od == pytest.approx(2.5 * 0.4)
    config = RigBackendConfig(units={"pio01": UnitConfig(address="http://10.0.0.1/")})
    assert [config.address(name) for name in ("pio01", "pio02")] == ["http://10.0.0.1", "http://pio02.local"]


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize(("reading", "raw"), [(0.6, 6000.0), (-0.2, 0.0), (6.1, 60000.0), (0.00005, 0.5)])
def test_the_interlock_s_counts_are_those_of_the_photodiode_not_of_the_od(reading, raw, calibrated):
    """Of a reading of a calibration they are unknown, and never those of a sensor that failed."""
    sampling = UnitSampling(PioreactorConfig(od_zero=0.1, od_scale=2.0), 60.0, 0.0)
    sampling.take([Reading(at, reading, calibrated) for at in (1.0, 3.0)])
    assert sampling.look(4.0, 0.0)
    assert sampling.raw == pytest.approx(max(raw, RAW_MIN) if calibrated else raw)


def test_readings_of_the_window_count_and_one_alone_is_no_sample():
    """12 s of window: at 30 s what came at 18 s and later; the first of a sample is not older than it."""
    sampling = UnitSampling(PioreactorConfig(window_s=12.0), 60.0, 0.0)
    sampling.take([Reading(17.9, 9.0)])
    sampling.take([Reading(18.0, 0.5)])
    assert sampling.look(29.9, 0.0)
    assert sampling.number == 2
    sampling = UnitSampling(PioreactorConfig(window_s=12.0), 60.0, 0.0)
    sampling.take([Reading(17.9, 9.0), Reading(18.0, 0.5)])
    assert not sampling.look(30.0, 0.0)
    sampling.take([Reading(30.0, 0.7)])
    assert sampling.look(30.0, 0.0)
    assert (sampling.od, sampling.count, sampling.read_s) == (pytest.approx(0.6), 1, 30.0)


def test_what_a_unit_says_of_its_heat_and_its_pumps_is_read_by_its_own_names():
    """Pins of a board of one's own: media by 5, alternative medium by 6, waste by 9."""
    box = Mailbox(UNIT, PioreactorConfig(pump_pins=(5, 6, 9)), VirtualClock(7.0))
    below = f"pioreactor/{UNIT}/{EXPERIMENT}/"
    for topic, payload in (
        ("temperature_automation/temperature", '{"temperature": 36.2}'),
        ("temperature_automation/target_temperature", "31.5"),
        ("stirring/duty_cycle", "28"),
        ("pwms/dc", '{"9": 100.0, "5": 0.0, "17": 30.0}'),
    ):
        box.take(below + topic, payload.encode(), False)
        box.take(below.replace(EXPERIMENT, "older") + topic, b"99", False)
    assert (box.temperature, box.target, box.stir_duty) == (36.2, 31.5, 28.0)
    heard_s, box._clock = box.heard_s, VirtualClock(9.0)
    box.take(f"{below}stirring/duty_cycle/set", b"30", False)
    assert box.heard_s == heard_s, "what others say to a job is no sign of its unit's life"
    assert (box.jobs, box.dc_s) == ({"add_media": 5, "add_alt_media": 6, "remove_waste": 9}, 7.0)
    box.take(f"{below}remove_waste/$state", b"ready", False)
    box.take(f"{below}pwms/dc", b'{"9": 100.0}', False)
    assert box.on() == [WASTE]


@pytest.mark.parametrize(("ml", "counts"), [(10.0, True), (-10.0, True), (100.1, False), (-100.1, False)])
def test_an_event_tells_no_more_than_a_pump_can_give(ml, counts):
    box = mailbox()
    body = {"volume_change": ml, "event": "remove_waste", "source_of_event": "UI", "timestamp": "t"}
    box.take(f"pioreactor/{UNIT}/{EXPERIMENT}/dosing_events", json.dumps(body).encode(), False)
    assert [(e.pump, e.ml, e.source) for e in box.drain()[1]] == ([("remove_waste", ml, "UI")] if counts else [])


def test_a_sample_is_on_record_with_the_time_of_its_readings_also_in_a_life_that_goes_on(monkeypatch):
    """Ten times faster, an hour into the run: readings every 10 s of the culture, of which the last three count."""
    lab = Lab(monkeypatch, speed=10.0, reading_s=1.0, od_scale=2.0)
    lab.world.od_s = 1.0
    lab.begin(elapsed_s=3600.0)
    m = lab.sample()
    assert m.od[0] == pytest.approx(1.0)
    m = lab.sample()
    row = lab.of("sample")[-1]
    assert row["sample_s"] == pytest.approx(m.time_s[0], abs=1e-3)
    assert 3600.0 < row["sample_s"] < lab.reactors.elapsed()
    assert (row["readings"], row["od"], m.vitals.raw[0]) == (3, pytest.approx(1.0), pytest.approx(5000.0))


VOLUMES = {"pio02": 17.9, "pio03": 14.0}


@pytest.mark.parametrize(
    ("bench", "words"),
    [
        ({}, None),
        ({"period_s": 29.0}, r"bench.period_s = 29 s: allowed 30 to 600 with backend=pioreactor$"),
        ({"period_s": 601.0}, r"bench.period_s = 601 s: allowed 30 to 600"),
        ({"period_s": 30.0, "max_rate": 0.05}, None),
        ({"volumes_ml": {"pio03": 18.0, "pio02": 36.0}}, r"= 36 mL of pio02: allowed less than .* vial, 36$"),
        ({"max_rate": 0.0251}, r"backend.max_dose_ml = 1.5 mL, the interlock allows 1.51 mL in a period of 60 s"),
        ({"period_s": 90.0, "max_rate": 0.017}, r"1.53 mL in a period of 90 s; set bench.max_rate=0.01666 or"),
    ],
)
def test_a_bench_is_such_as_units_may_have(bench, words):
    backend = PioreactorConfig(reactors=("pio01", "pio02", "pio03"))
    given = Bench(**({"volume_ml": 20.0, "volumes_ml": VOLUMES} | bench))
    if words is None:
        PioreactorFamily().doses(backend, given)
    else:
        with pytest.raises(UnfitError, match=words):
            PioreactorFamily().doses(backend, given)
