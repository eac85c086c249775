"""A dose of a Pioreactor: in order, once, followed to its end; and every odd answer of the vendor's software."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hardware.errors import DeviceStateError, RecordingError
from hardware.messages import NoNewSample, PumpFault
from hardware.pioreactor import messages
from hardware.pioreactor.doses import UnitHistory, replay
from hardware.pioreactor.pumps import LATE_ML
from hardware.pioreactor.versions import TESTED
from hardware.storage.doses import dosed
from hardware.storage.journal import Journal
from tests.hardware.pioreactor_lab import ALT_PIN, FLOW, MEDIA_PIN, UNIT, WASTE_PIN, Lab, World, sampled
from tests.hardware.script import noted


@pytest.fixture
def lab(monkeypatch):
    return sampled(monkeypatch)


def test_a_dose_is_written_down_then_media_then_twice_the_waste_with_one_id(lab):
    assert lab.dose(0.7) == pytest.approx(0.7)
    lab.wait(6.0)
    (media,), (waste,) = lab.asked("add_media"), lab.asked("remove_waste")
    assert (media["ml"], waste["ml"]) == (0.7, 1.4)
    assert media["source-of-event"] == waste["source-of-event"] == "turbidostat/run/pio01/1"
    assert [(row["job"], row["id"]) for row in lab.of("task")] == [
        (job, "turbidostat/run/pio01/1") for job in ("add_media", "remove_waste")
    ]
    kinds = [row["kind"] for row in lab.rows if row["kind"] in ("intent", "feed_on", "dose_end")]
    assert kinds == ["intent", "feed_on", "dose_end"]
    (end,) = lab.of("dose_end")
    assert (end["feed_low_ml"], end["feed_ml"], end["waste_ml"]) == pytest.approx((0.7, 0.7, 1.4))
    assert lab.world.truth["add_media"] == pytest.approx(0.7)


def test_one_sample_gives_one_dose(lab):
    lab.dose(0.5)
    lab.wait(6.0)
    assert lab.dose(0.5) == 0.0
    assert len(lab.asked("add_media")) == 1
    assert noted(lab.rows, NoNewSample)


def test_an_intent_that_cannot_be_written_prevents_the_dose(lab):
    def full(kind, fields):
        raise RecordingError("no space left")

    lab.reactors._log = full
    with pytest.raises(RecordingError):
        lab.dose(0.5)
    assert not lab.asked("add_media")


@pytest.mark.parametrize("rate", [-1.0, np.nan, np.inf])
def test_a_rate_that_is_none_is_refused(lab, rate):
    with pytest.raises(ValueError, match="pump rate"):
        lab.dose(rate)


# -- the list of what is odd -------------------------------------------------------------------------------------------


def test_samples_go_on_while_the_fate_of_a_dose_is_open(monkeypatch):
    lab = sampled(monkeypatch, period_s=30.0)
    lab.world.queue = False
    lab.dose(0.5)
    before = len(lab.of("sample"))
    for _ in range(10):
        lab.reactors.measure()
    assert not lab.of("dose_end")
    assert len(lab.of("sample")) >= before + 4
    assert len(lab.asked("add_media")) == 1


def test_a_waste_pump_that_ends_late_is_counted_by_its_own_pin_from_this_dose_on(lab):
    lab.dose(0.3)
    lab.wait(6.0)
    lab.sample()
    lab.dose(0.5)
    lab.until(lambda: WASTE_PIN in lab.world.since, 10.0)
    lab.world.late_s = 1.0
    lab.wait(10.0)
    _, end = lab.of("dose_end")
    assert lab.world.truth["remove_waste"] == pytest.approx(0.6 + 1.0 + 1.6, abs=0.02)
    assert (end["waste_ml"], end["waste_high_ml"]) == pytest.approx((1.0, 2.6), abs=0.02)


# -- what others do ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pump", ["add_media", "add_alt_media", "remove_waste"])
def test_each_dose_of_somebody_else_is_counted_once_as_what_it_is_and_holds_ours(lab, pump):
    volumes, taken = (0.5, 0.3, 0.2, 0.7), pump == "remove_waste"
    for ml in volumes:
        lab.world.event(pump, ml, "UI")
        lab.wait(1.0)
    assert lab.fault.kind == "mode"
    rows, booked = lab.of("given"), lab.reactors.repeated()
    told = np.array([(r["feed_ml"], r["feed_low_ml"], r["waste_ml"]) for r in rows])
    assert told == pytest.approx(np.array([(0.0, 0.0, ml) if taken else (ml, ml, 0.0) for ml in volumes]))
    assert [(r.volume_ml[0], r.waste_ml[0]) for _, r in booked] == [(r["feed_ml"], r["waste_ml"]) for r in rows]
    assert [(row.feed_ml, row.at_s) for row in dosed(lab.rows)] == [(r["feed_ml"], r["at_s"]) for r in rows]
    assert [at for at, _ in booked] == pytest.approx([r["at_s"] for r in rows])
    assert rows[-1]["at_s"] == pytest.approx(lab.reactors.elapsed(), abs=1.5)
    assert all(f"{pump} of " in row["why"] and "by UI" in row["why"] for row in rows)
    assert lab.reactors.repeated() == []
    assert lab.dose(0.5) == 0.0
    assert not lab.of("dose_end")


def test_a_pump_that_a_word_and_then_a_lock_of_before_keep_off_is_told_with_its_command_and_tried_again(lab):
    lab.world.say("add_media/$state", "ready", retained=True)  # and its unit does not list it
    lab.wait(60.0)
    lab.world.locks.add(MEDIA_PIN)  # as a full disk leaves it
    for told in ([], ["undosed"], []):
        lab.sample()
        assert lab.dose(0.5) == 0.5
        lab.wait(8.0)
        assert [fault.kind for fault in [lab.fault] if fault and fault.fields["why"].fields["pin"] == MEDIA_PIN] == told
        lab.world.locks -= {MEDIA_PIN} if told else set()


@pytest.mark.parametrize("retained", [False, True])
def test_a_retained_duty_of_another_experiment_is_no_pump_of_ours(monkeypatch, retained):
    lab = Lab(monkeypatch)
    lab.world.retained[f"pioreactor/{UNIT}/older/pwms/dc"] = '{"13": 100.0}'
    lab.world.say_pins({13: 100.0}, retained=retained, experiment="older")
    lab.reactors.mqtt.__init__(lab.reactors.config, lab.reactors.mqtt.boxes, "", lab.world)
    lab.begin()
    lab.sample()
    lab.wait(40.0)
    lab.sample()
    assert lab.dose(0.5) == 0.5
    lab.wait(10.0)
    assert len(lab.asked("remove_waste")) == 1
    assert lab.world.truth["add_media"] == pytest.approx(0.5, abs=0.15)
    low, high = lab.given()
    assert low - 0.02 <= lab.world.truth["add_media"] <= high + 0.02


@pytest.mark.parametrize("seconds", [0.0, 0.002, 0.01, 0.06, 0.3])
def test_a_word_of_stirring_that_was_overtaken_is_no_pump_that_runs_on(lab, seconds):
    """It read the pins while the pump ran, and says so after the pump's own last word."""
    lab.dose(0.7)
    lab.until(lambda: bool(lab.world.since), 5.0)
    lab.until(lambda: not lab.world.since, 5.0)
    lab.world.later(seconds, lambda: lab.world.say_pins({13: 100.0, 17: 30.0}))
    lab.wait(50.0)
    assert lab.fault is None
    assert [row["waste_ml"] for row in lab.of("dose_end")] == [pytest.approx(1.4)]
    assert lab.given() == pytest.approx((0.7, 0.7), abs=0.1)
    assert not lab.of("given")
    assert len(lab.asked("remove_waste")) == 1
    assert not [options for _, options in lab.world.asked if "duration" in options]


@pytest.mark.parametrize("seconds", [30.0, 10.0])
def test_what_a_job_of_several_pumps_gives_is_told_booked_by_its_pins_and_left_to_its_end(lab, seconds):
    """Of 10 s its event of waste says more than its pin."""
    lab.world.circulate(seconds)
    lab.wait(seconds - 1.0)
    assert (lab.fault.kind, lab.fault.fields) == ("mode", {"job": "circulate_media"})
    assert lab.dose(0.5) == 0.0
    lab.wait(10.0)
    assert lab.given() == pytest.approx((lab.world.truth["add_media"],) * 2, abs=0.1)
    assert lab.world.truth["add_media"] > 0.25 * seconds
    assert lab.ledger(0.0).volume_ml[0] == lab.bench.volume_ml, "waste ran beside it"
    assert not [options for _, options in lab.world.asked if "duration" in options]
    lab.sample()
    lab.dose(0.0)  # it was told, and held one dose
    lab.sample()
    assert lab.dose(0.5) == 0.5


def test_a_pump_that_was_calibrated_anew_is_booked_by_that(lab, monkeypatch):
    """It gives half as much, and its unit knows."""
    monkeypatch.setitem(FLOW, "add_media", 0.35)
    lab.web.active["media_pump"] = {"curve_data_": {"type": "poly", "coefficients": [0.35, 0.0]}}
    lab.dose(0.7)
    lab.wait(10.0)
    assert lab.world.truth["add_media"] == pytest.approx(0.7)
    assert lab.given() == pytest.approx((0.7, 0.7), abs=0.02)


def test_an_event_that_a_bridge_brings_twice_is_booked_once_and_a_late_correction_whole(lab):
    box = lab.world.box
    take = box.take
    box.take = lambda *message: [take(*message), take(*message)]
    for ml in (0.5, 0.2, 14.0, -3.0):
        lab.world.event("add_media", ml, "UI")
    lab.wait(1.0)
    assert lab.given() == pytest.approx((11.7, 11.7))


@pytest.mark.parametrize("late_s", [0.1, 0.3])
def test_excesses_of_jobs_that_end_late_are_booked_once_they_are_much_and_taken_by_the_waste_of_their_doses(
    lab, late_s
):
    planned, lab.world.late_s = 0.0, late_s
    for _ in range(10):
        planned += lab.dose(0.5)
        lab.wait(10.0)
        lab.sample()
    truth = lab.world.truth["add_media"]
    assert truth > planned + 0.5
    assert float(lab.ledger(planned).fed_ml[0]) == pytest.approx(truth, abs=LATE_ML + 0.02)
    assert not noted(lab.rows, messages.Drained), "no pump ran on"
    assert len(lab.asked("remove_waste")) == 10
    assert lab.world.truth["remove_waste"] >= truth


@pytest.mark.parametrize(
    ("lacks", "error", "values"),
    [
        (lambda lab: lab.world.rows.update(dosing_automation=1), messages.AutomationRuns, {}),
        (lambda lab: vars(lab.world).update(queue=False), messages.QueueStuck, {}),
        (lambda lab: lab.web.active.pop("media_pump"), messages.NotCalibrated, {"pump": "media_pump"}),
        (lambda lab: lab.web.active.pop("waste_pump"), messages.NotCalibrated, {"pump": "waste_pump"}),
    ],
)
def test_a_unit_that_cannot_be_dosed_alone_and_in_time_forbids_the_run(monkeypatch, lacks, error, values):
    lab = Lab(monkeypatch)
    lacks(lab)
    with pytest.raises(error) as refused:
        lab.begin()
    assert refused.value.fields == values
    assert str(refused.value).startswith("pio01: ")


# -- stop and resume ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pin", [MEDIA_PIN, WASTE_PIN])
def test_stop_ends_jobs_is_verified_and_tells_how_much_was_moved(lab, pin):
    lab.dose(1.0)
    lab.until(lambda: pin in lab.world.since, 10.0)
    lab.wait(0.4)
    lab.reactors.stop()
    assert not lab.world.since
    (end,), truth = lab.of("dose_end"), lab.world.truth
    assert end["feed_low_ml"] <= truth["add_media"] <= end["feed_ml"] + 1e-6
    assert end["waste_ml"] <= truth["remove_waste"] <= end["waste_high_ml"] + 0.02
    whole, cut = (("add_media", 1.0), ("remove_waste", 2.0))[:: 1 if pin == WASTE_PIN else -1]
    assert truth[cut[0]] < 0.75 * cut[1]
    assert truth[whole[0]] == pytest.approx(whole[1] if pin == WASTE_PIN else 0.0)
    assert end["waste_high_ml"] == pytest.approx(truth["remove_waste"], abs=0.2)


@pytest.mark.parametrize("broker", [True, False])
def test_stop_that_cannot_be_verified_says_which_plug(lab, broker):
    lab.world.kill_after_s = 0.2
    lab.dose(0.5)
    lab.wait(1.0)
    begun = len(lab.asked("remove_waste"))
    if not broker:
        lab.world.lose_broker(1e6)
    with pytest.raises(DeviceStateError, match="pull (its|the) plug"):
        lab.reactors.stop()
    assert len(lab.asked("remove_waste")) == begun, "no pump is started by a stop"
    assert set(lab.world.since) == {MEDIA_PIN}, "and none goes on after it but the one that cannot be stopped"


@pytest.mark.parametrize("stops", [False, True])
def test_what_a_media_pump_gave_too_much_is_drained_also_while_pumps_are_off_and_not_after_a_stop(lab, stops):
    """It stood still for 2.5 s in a dose of .7 mL. The interlock says pumps off meanwhile, or the run is ended."""
    lab.world.freeze_after_s, lab.world.frozen_s = 0.6, 2.5
    lab.dose(0.7)
    lab.until(lambda: bool(lab.world.since), 5.0)
    lab.wait(0.8)
    if stops:
        lab.reactors.stop()
    else:
        assert lab.reactors.pumps_off(np.array([True])) == []
    assert not lab.world.since
    assert lab.world.truth["add_media"] > 1.5
    least = 0.0 if stops else lab.world.truth["add_media"]
    assert lab.world.truth["remove_waste"] >= least - 0.1, "back at its tube"
    assert bool(lab.asked("remove_waste")) is not stops


@pytest.mark.parametrize("version", TESTED)
@pytest.mark.parametrize("away_s", [0.5, 90.0, 9 * 3600.0])
@pytest.mark.parametrize("pin", [MEDIA_PIN, WASTE_PIN])
def test_a_dose_left_open_is_counted_at_most_whole_and_never_sent_again(monkeypatch, version, away_s, pin):
    """Whatever time passed: not by the time that nobody watched. In its waste the unit loses its power, too."""
    lab = sampled(monkeypatch, World(version))
    lab.dose(0.8)
    lab.until(lambda: pin in lab.world.since, 10.0)
    lab.wait(0.2)
    if pin == WASTE_PIN:
        lab.world.cut()
        lab.world.power()
    assert replay(lab.rows)[UNIT].open
    again, world = lab.resumed(monkeypatch, away_s, 60.0), lab.world
    took = again.until(lambda: bool(again.of("dose_end")), 100.0)
    assert took <= 100.0
    (end,) = again.of("dose_end")
    low, high = again.given()  # with short runs that prove it off
    assert low <= world.truth["add_media"] <= high + 0.02
    assert end["waste_ml"] <= world.truth["remove_waste"] + 1e-6
    assert end["feed_ml"] <= 0.85
    assert len(again.asked("add_media")) == 1
    assert again.fault is None
    again.sample()
    assert again.dose(0.5) == 0.5
    again.wait(8.0)
    assert len({o["source-of-event"] for o in again.asked("add_media")}) == 2


@pytest.mark.parametrize("rebooted", [False, True])
def test_after_a_resume_nobody_is_told_to_pull_a_plug_while_no_pump_is_told_on(monkeypatch, lab, rebooted):
    """Its program was killed in a dose, which has ended since: by itself, or with the unit's power."""
    lab.dose(0.8)
    lab.until(lambda: MEDIA_PIN in lab.world.since, 10.0)
    if rebooted:
        lab.world.cut()
        lab.world.power()
    again = lab.resumed(monkeypatch, 20.0, 60.0)
    told = []
    again.until(lambda: told.append(str(again.fault)) or not again.station.doses.running, 15.0)
    again.until(lambda: told.extend(again.reactors.pumps_off(np.array([True]))) or again.fault is None, 1.0)
    assert not [line for line in told if "plug" in line or "stirring" in line]
    again.sample()
    assert again.dose(0.5) == 0.5


def test_a_run_without_a_thermostat_is_resumed_from_its_journal_on_the_disk(monkeypatch, tmp_path):
    lab, journal = Lab(monkeypatch, thermostat=False), Journal(tmp_path / "journal.jsonl")
    lab.begin()
    lab.sample()
    lab.dose(0.8)
    lab.wait(6.0)
    for row in lab.rows:
        journal.append(row["kind"], {key: row[key] for key in row.keys() - {"n", "wall", "kind"}})
    known = replay(journal.reread())[UNIT]
    assert math.isnan(known.temperature)  # null in the file
    assert (known.open, known.fed, known.wasted, known.boot, known.doses) == (False, True, True, "boot1", 1)
    assert known.seen_s == lab.rows[-1]["time_s"]


def test_an_open_dose_waits_for_a_dead_queue(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.queue = False
    asked = {"id": "turbidostat/run/pio01/1", "feed_ml": 0.5, "waste_ml": 1.0}
    past = UnitHistory(boot="boot1", sample=(1.0, 1), doses=1, open=True, fed=True, **asked)
    lab.begin(past)
    lab.wait(30.0)
    assert not lab.of("dose_end")
    assert lab.fault is not None
    lab.world.waiting.insert(0, lambda: lab.world.take("t", "add_media", {"ml": 0.5, "source-of-event": past.id}))
    lab.world.revive()  # it runs late
    lab.wait(140.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.5]
    ledger = lab.ledger(0.5)  # its waste is not on record, and was booked when it began
    assert float(ledger.volume_ml[0]) >= lab.world.level_ml - 0.1
    assert float(ledger.fed_ml[0]) >= lab.world.truth["add_media"] - 0.02


def test_an_intent_whose_request_was_never_sent_gave_nothing(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin(UnitHistory(sample=(1.0, 1), doses=1, open=True, fed=False, id="turbidostat/old/pio01/1", feed_ml=0.5))
    lab.wait(2.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.0]


@pytest.mark.parametrize("version", TESTED)
def test_the_unit_s_own_ledger_is_put_to_the_level_that_was_read(monkeypatch, version):
    lab = sampled(monkeypatch, World(version))
    lab.world.web = False
    lab.reactors.set_level(0, 18.5)
    lab.wait(20.0)
    assert lab.web.levels == []
    lab.world.web = True
    lab.wait(20.0)
    assert lab.web.levels == ([18.5] if version > "26" else [])


# -- where nothing is as in the other tests ----------------------------------------------------------------------------


def test_ten_times_faster_readings_of_a_dose_do_not_count_for_the_sample_after_it(monkeypatch):
    lab = Lab(monkeypatch, speed=10.0, mix_s=15.0, reading_s=1.0)
    lab.world.od_s = 0.5
    lab.begin()
    lab.sample()
    assert lab.dose(1.0) == 1.0
    lab.world.reading = 0.9
    lab.until(lambda: not lab.station.doses.running, 6.0)
    lab.wait(1.4)
    lab.world.reading = 0.5
    lab.until(lambda: lab.station.sampling.count == 2, 10.0)
    assert lab.station.sampling.od == pytest.approx(0.5)


def test_five_times_faster_a_period_of_two_minutes_is_dosed_whole_and_an_old_sample_not_at_all(monkeypatch):
    lab = sampled(monkeypatch, speed=5.0, period_s=120.0, waste_factor=3.0)
    assert lab.dose(0.9) == 0.9
    lab.wait(10.0)
    assert lab.world.truth["add_media"] == pytest.approx(0.9, abs=0.02)
    assert lab.world.truth["remove_waste"] == pytest.approx(2.7, abs=0.05)
    lab.sample()
    lab.world.od_alive = False
    lab.world.sleep(30.0)  # 150 s of the culture
    assert lab.dose(0.9) == 0.0
    assert "SampleStale" in [row["fields"]["why"]["name"] for row in lab.of("note") if row["name"] == "NoDose"]


def test_pumps_off_while_a_run_goes_on_lets_the_waste_pump_end(lab):
    assert lab.dose(1.0) == 1.0
    lab.until(lambda: WASTE_PIN in lab.world.since, 10.0)
    assert lab.reactors.pumps_off(np.array([True])) == []
    assert lab.world.truth["remove_waste"] == pytest.approx(2.0, abs=0.05)


def test_what_is_put_off_stays_while_nothing_is_asked_and_what_is_cut_is_not_put_off(lab):
    of = ((0.03, 0.0, 0.03), (0.0, 0.0, 0.0), (0.04, 0.07, -0.03), (9.0, 1.5, 0.0), (0.2, 0.2, 0.0))
    for asked, given, kept in of:
        assert lab.dose(asked) == pytest.approx(given)
        assert lab.receipt.kept_ml[0] == pytest.approx(kept)
        assert lab.receipt.waste_ml[0] == pytest.approx(2.0 * given)
        lab.sample()
    assert [row["doses"] for row in lab.of("intent")] == [0, 0, 1, 2, 3]
    assert [row["carry_ml"] for row in lab.of("intent")] == pytest.approx([0.03, 0.03, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("bench", "rim_ml"),
    [({"volume_ml": 14.0}, 20.0), ({"volume_ml": 30.0}, 40.0), ({"volume_ml": 30.0, "volumes_ml": {UNIT: 14.0}}, 20.0)],
)
def test_after_a_stop_the_ledger_of_a_flooded_vial_stands_at_its_rim(monkeypatch, bench, rim_ml):
    """A media pump that stood on for half a minute gave some 21 mL; a stop drains nothing."""
    lab = sampled(monkeypatch, **bench)
    lab.world.freeze_after_s, lab.world.frozen_s = 0.6, 29.0
    planned = lab.dose(0.7)
    lab.until(lambda: bool(lab.world.since), 5.0)
    lab.wait(0.8)
    lab.reactors.config = replace(lab.reactors.config, stop_s=60.0)
    lab.reactors.stop()
    ledger = lab.ledger(planned)
    assert lab.world.truth["add_media"] > 15.0
    assert float(ledger.fed_ml[0]) >= lab.world.truth["add_media"] - 0.1
    assert float(ledger.volume_ml[0]) == pytest.approx(rim_ml, abs=0.1)  # a short run proves the pump off


def test_a_drain_that_the_broker_and_then_the_end_of_a_run_cut_is_booked_with_the_least_that_it_took(monkeypatch):
    monkeypatch.setitem(FLOW, "remove_waste", 0.9)
    lab = sampled(monkeypatch)
    lab.world.freeze_after_s, lab.world.frozen_s = 0.6, 4.0
    planned = lab.dose(0.7)
    lab.until(lambda: set(lab.world.since) == {WASTE_PIN}, 20.0)
    lab.world.lose_broker(2.0)
    lab.reactors.stop()
    assert lab.world.level_ml > 20.5
    assert float(lab.ledger(planned).volume_ml[0]) >= lab.world.level_ml - 0.1


@pytest.mark.parametrize("of", ["media", "waste", "drain"])
def test_an_event_that_comes_after_the_end_of_its_pump_is_booked_as_far_as_it_was_not(lab, of):
    """Of medium what was booked is the most that it gave, of waste the least that it took; somebody had stopped it."""
    world, pump = lab.world, "add_media" if of == "media" else "remove_waste"
    if of == "drain":
        world.freeze_after_s, world.frozen_s = 0.6, 4.0
    lab.dose(1.4)
    lab.until(lambda: any(of != "drain" or "drain" in o["source-of-event"] for o in lab.asked(pump)), 20.0)
    lab.until(lambda: pump in world.run_now, 5.0)
    lab.wait(0.8)
    world.run_now[pump][0] = True
    source = lab.asked(pump)[-1]["source-of-event"]
    lab.until(lambda: not lab.station.doses.running, 30.0)
    (end,), reported = lab.of("dose_end"), lab.station._pumps.reported[pump, source]
    booked = {"media": end["feed_ml"], "waste": end["waste_ml"], "drain": reported - LATE_ML}[of]
    volume, before = "feed_ml" if of == "media" else "waste_ml", len(lab.of("given"))
    for ml in (0.3, 0.9):
        world.event(pump, ml, source)
        lab.wait(1.0)
    assert sum(row[volume] for row in lab.of("given")[before:]) == pytest.approx(reported + 1.2 - booked)


def test_each_pump_s_flow_is_that_of_its_own_calibration_and_on_record(lab):
    (row,) = lab.of("device")
    assert row["flows"] == {"add_media": 0.7, "remove_waste": 1.6}
    assert (row["device_id"], row["boot"]) == (UNIT, "boot1")


def test_after_a_crash_a_pump_that_cannot_be_proven_off_is_told_after_a_while(monkeypatch):
    """Five times faster; the task queue is dead, so no short run comes, and nobody tells the pump on."""
    lab = sampled(monkeypatch, speed=5.0)
    lab.world.queue = False
    lab.dose(0.8)
    lab.wait(0.5)
    again = Lab(monkeypatch, lab.world, speed=5.0)
    again.begin(replay(lab.rows)[UNIT], lab.of("intent")[0]["on_s"] + 20.0)
    seen = []
    again.until(lambda: seen.append(type(again.fault)) or seen[-1] is messages.MayRunOn, 60.0)
    assert [kind for kind in dict.fromkeys(seen) if issubclass(kind, PumpFault)][-2:] == [
        messages.BeingVerified, messages.MayRunOn
    ]  # fmt: skip
    assert messages.RunsOn not in seen


def test_a_pump_that_was_killed_untold_is_booked_whole_by_a_run_that_is_resumed(lab, monkeypatch):
    lab.world.kill_after_s, lab.world.unkept = 0.01, True
    lab.dose(0.8)
    lab.wait(5.0)
    again = lab.resumed(monkeypatch, 10.0, lab.reactors.elapsed())
    again.wait(60.0)
    lab.world.locks.clear()
    again.well()
    again.check_given(LATE_ML)


# -- a second fluid ----------------------------------------------------------------------------------------------------


@pytest.fixture
def two(monkeypatch):
    return sampled(monkeypatch, alt_media=True)


def test_a_dose_of_the_alt_media_pump_is_followed_booked_as_pump_3_and_wasted_as_one_of_media(two):
    assert two.dose(0.04) == 0.0
    two.sample()
    assert two.dose(0.9, pump=3) == pytest.approx(0.9)
    assert two.receipt.kept_ml[0] == 0.0, "what the feed has put off stays"
    two.wait(8.0)
    assert [len(two.asked(job)) for job in ("add_media", "add_alt_media", "remove_waste")] == [0, 1, 1]
    assert two.world.truth["add_alt_media"] == pytest.approx(0.9, abs=0.02)
    assert two.world.truth["remove_waste"] == pytest.approx(1.8, abs=0.02)
    assert [(row.pump, row.feed_ml) for row in dosed(two.rows)] == [(3, pytest.approx(0.9, abs=0.02))]
    two.sample()
    assert two.dose(0.3) == pytest.approx(0.34)


@pytest.mark.parametrize("away_s", [0.2, 30.0])
def test_a_dose_of_alt_media_in_which_the_program_is_killed_is_booked_and_sent_once(monkeypatch, two, away_s):
    two.dose(0.9, pump=3)
    two.until(lambda: ALT_PIN in two.world.since, 10.0)
    again, world = two.resumed(monkeypatch, away_s, 60.0, alt_media=True), two.world
    again.until(lambda: not again.station.doses.running, 60.0)
    low, high = again.given()
    assert low <= world.truth["add_alt_media"] <= high + 0.02
    assert {row.pump for row in dosed(again.rows)} == {3}
    assert (len(again.asked("add_alt_media")), world.truth["add_media"]) == (1, 0.0)
    again.sample()
    assert again.dose(0.7) == pytest.approx(0.7)


def test_an_alt_media_pump_that_stands_on_is_drained_proven_off_and_booked_as_pump_3(two):
    two.world.strikes, two.world.freeze_after_s, two.world.frozen_s = "add_alt_media", 0.6, 20.0
    planned = two.dose(0.9, pump=3)
    two.until(lambda: isinstance(two.fault, messages.RunsOn) and two.fault.fields["pin"] == 16, 20.0)
    two.until(lambda: two.fault is None and not two.station.doses.running, 100.0)
    assert two.world.truth["remove_waste"] >= two.world.truth["add_alt_media"] - 0.1
    extra = two.reactors.repeated()
    assert {receipt.pump for _, receipt in extra} == {3}
    booked = planned + sum(float(receipt.volume_ml[0]) for _, receipt in extra)
    assert two.given()[0] <= two.world.truth["add_alt_media"] <= booked + LATE_ML


@pytest.mark.parametrize("lacks", ["alt_media_pump", ""])
def test_a_run_with_alt_media_needs_a_calibration_of_its_pump(monkeypatch, lacks):
    lab = Lab(monkeypatch, alt_media=bool(lacks))
    lab.web.active.pop("alt_media_pump")
    if not lacks:
        lab.begin()
        return
    with pytest.raises(messages.NotCalibrated) as error:
        lab.begin()
    assert error.value.fields == {"pump": "alt_media_pump"}
