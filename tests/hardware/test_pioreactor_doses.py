"""A dose of a Pioreactor: in order, once, followed to its end; and every odd answer of the vendor's software."""

import math
from dataclasses import replace

import numpy as np
import pytest

from envs.bench import Bench
from hardware.errors import DeviceStateError, LinkError, RecordingError
from hardware.pioreactor.resume import History, replay
from hardware.safety.budget import FeedBudget
from hardware.safety.config import SafetyConfig
from hardware.storage.doses import dosed
from hardware.storage.journal import Journal
from tests.hardware.pioreactor_lab import FLOW, MEDIA_PIN, UNIT, WASTE_PIN, Lab, World


@pytest.fixture
def lab(monkeypatch):
    made = Lab(monkeypatch)
    made.begin()
    made.sample()
    return made


def test_a_dose_is_written_down_then_media_then_twice_the_waste_with_one_id(lab):
    assert lab.dose(0.7) == pytest.approx(0.7)
    lab.wait(6.0)
    (media,), (waste,) = lab.asked("add_media"), lab.asked("remove_waste")
    assert (media["ml"], waste["ml"]) == (0.7, 1.4)
    assert media["source-of-event"] == waste["source-of-event"]
    kinds = [row["kind"] for row in lab.rows if row["kind"] in ("intent", "feed_on", "dose_end")]
    assert kinds == ["intent", "feed_on", "dose_end"]
    (end,) = lab.of("dose_end")
    assert (end["feed_low_ml"], end["feed_ml"], end["waste_ml"]) == pytest.approx((0.7, 0.7, 1.4))
    assert lab.world.truth["add_media"] == pytest.approx(0.7)


def test_ids_differ(lab):
    for _ in range(3):
        lab.dose(0.2)
        lab.sample()
    assert len({o["source-of-event"] for o in lab.asked("add_media")}) == 3


def test_one_sample_gives_one_dose(lab):
    lab.dose(0.5)
    lab.wait(6.0)
    assert lab.dose(0.5) == 0.0
    assert len(lab.asked("add_media")) == 1
    assert any("no new sample" in note for note in lab.receipt.notes)


def test_an_intent_that_cannot_be_written_prevents_the_dose(lab):
    def full(kind, fields):
        raise RecordingError("no space left")

    lab.reactors._log = full
    with pytest.raises(RecordingError):
        lab.dose(0.5)
    assert not lab.asked("add_media")


def test_small_doses_are_put_off_and_large_ones_cut(lab):
    assert lab.dose(0.03) == 0.0
    assert lab.receipt.kept_ml[0] == pytest.approx(0.03)
    lab.sample()
    assert lab.dose(0.04) == pytest.approx(0.07)
    lab.sample()
    assert lab.dose(9.0) == lab.reactors.config.max_dose_ml


@pytest.mark.parametrize("rate", [-1.0, np.nan, np.inf])
def test_a_rate_that_is_none_is_refused(lab, rate):
    with pytest.raises(ValueError, match="pump rate"):
        lab.dose(rate)


# -- the list of what is odd -------------------------------------------------------------------------------------------


def test_a_pin_lock_left_behind_is_a_dose_that_was_accepted_and_not_given(lab):
    lab.world.locks.add(MEDIA_PIN)
    lab.dose(0.5)
    lab.wait(25.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_ml"], lab.world.truth["add_media"]) == (0.0, 0.0)
    assert "pio cache purge pwm_locks" in end["end"]
    assert len(lab.asked("add_media")) == 1


def test_a_job_that_was_accepted_and_died_at_once_did_nothing_and_is_told(lab):
    lab.world.dies = True
    lab.dose(0.5)
    lab.wait(20.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_ml"], lab.fault) == (0.0, None)
    assert "accepted and not carried out" in end["end"]


def test_samples_go_on_while_the_fate_of_a_dose_is_open(lab):
    lab.world.queue = False
    lab.dose(0.5)
    before = len(lab.of("sample"))
    for _ in range(30):
        lab.reactors.measure()
        lab.wait(10.0)
    assert not lab.of("dose_end")
    assert len(lab.of("sample")) >= before + 4
    assert len(lab.asked("add_media")) == 1


def test_a_unit_that_forgot_the_queue_in_a_reboot_is_asked_again(lab):
    lab.world.queue = False
    lab.dose(0.5)
    lab.wait(20.0)
    lab.world.waiting.clear()  # what lay in memory
    lab.world.queue = True
    lab.wait(220.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_ml"], lab.fault) == (0.0, None)
    assert len(lab.asked("add_media")) == 1


def test_a_request_in_a_dead_queue_is_never_sent_again_and_is_noticed_when_it_runs_late(lab):
    lab.world.queue = False
    lab.dose(0.5)
    lab.wait(60.0)
    assert lab.fault is not None
    assert "unknown" in lab.fault.detail
    assert lab.dose(0.5) == 0.0
    lab.world.revive()
    lab.wait(10.0)
    (end,) = lab.of("dose_end")
    assert end["feed_ml"] == pytest.approx(lab.world.truth["add_media"]) == pytest.approx(0.5)
    assert len(lab.asked("add_media")) == 1
    assert lab.fault is None


def test_a_lost_answer_is_unknown_not_a_reason_to_ask_again(lab):
    lab.world.heard = "lost answer"
    lab.dose(0.5)
    lab.wait(30.0)
    assert len(lab.asked("add_media")) == 1
    (end,) = lab.of("dose_end")
    assert end["feed_ml"] == pytest.approx(0.5)


def test_a_lost_answer_of_a_request_nobody_heard_ends_with_nothing_given(lab):
    lab.world.heard = "nobody"
    lab.dose(0.5)
    lab.wait(120.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.0]
    assert lab.fault is None


@pytest.mark.parametrize("how", ["429", "refused"])
def test_a_request_that_was_turned_away_gave_nothing_and_holds_nothing_up(lab, how):
    lab.world.heard = "429" if how == "429" else "yes"
    lab.world.web = how != "refused"
    lab.dose(0.5)
    lab.wait(1.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.0]
    assert not lab.station.doses.running


def test_events_of_a_dose_stopped_early_are_a_bound_not_the_truth(lab):
    lab.world.stop_after_s = 0.603
    lab.dose(1.4)
    lab.wait(8.0)
    low, high = lab.given()
    assert low <= lab.world.truth["add_media"] <= high
    assert high - low <= 0.6


def test_a_job_that_ends_its_pump_late_is_counted_by_the_pin(lab):
    lab.world.late_s = 1.0
    lab.dose(0.5)
    lab.wait(10.0)
    (end,) = lab.of("dose_end")
    assert end["feed_ml"] == pytest.approx(lab.world.truth["add_media"], abs=0.02) == pytest.approx(1.2, abs=0.02)


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


def test_a_dose_of_somebody_else_is_counted_once_as_what_it_is_and_holds_ours(lab):
    lab.world.event("add_media", 0.5, "UI")
    lab.wait(1.0)
    assert lab.fault is not None
    assert lab.fault.kind == "mode"
    ((_, receipt),) = lab.reactors.repeated()
    assert receipt.volume_ml[0] == pytest.approx(0.5)
    assert lab.reactors.repeated() == []
    assert lab.dose(0.5) == 0.0
    assert not lab.of("dose_end")
    (given,) = lab.of("given")
    assert (given["feed_ml"], given["waste_ml"]) == (0.5, 0.0)
    assert "by UI" in given["why"]
    (row,) = dosed(lab.rows)
    assert (row.feed_ml, row.at_s) == (0.5, given["at_s"])
    assert given["at_s"] == pytest.approx(lab.reactors.elapsed(), abs=1.5)


def test_each_dose_of_somebody_else_is_counted_once_however_many_there_were(lab):
    for ml in (0.5, 0.3, 0.2, 0.7):
        lab.world.event("add_media", ml, "UI")
        lab.wait(1.0)
    given = [row["feed_ml"] for row in lab.of("given")]
    assert given == pytest.approx([0.5, 0.3, 0.2, 0.7])
    assert [receipt.volume_ml[0] for _, receipt in lab.reactors.repeated()] == pytest.approx(given)


@pytest.mark.parametrize("retained", [False, True])
def test_a_retained_duty_of_another_experiment_is_no_pump_of_ours(monkeypatch, retained):
    lab = Lab(monkeypatch)
    lab.world.retained[f"pioreactor/{UNIT}/older/pwms/dc"] = '{"13": 100.0}'
    lab.world.say("pwms/dc", '{"13": 100.0}', retained=retained, experiment="older")
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
    lab.world.later(seconds, lambda: lab.world.say("pwms/dc", '{"13": 100.0, "17": 30.0}'))
    lab.wait(50.0)
    assert lab.fault is None
    assert [row["waste_ml"] for row in lab.of("dose_end")] == [pytest.approx(1.4)]
    assert lab.given() == pytest.approx((0.7, 0.7), abs=0.1)
    assert not lab.of("given")
    assert len(lab.asked("remove_waste")) == 1
    assert not [options for _, options in lab.world.asked if "duration" in options]


def test_a_second_dose_of_somebody_else_that_is_refused_does_not_end_ours(lab):
    lab.dose(1.4)
    lab.until(lambda: bool(lab.world.since), 5.0)
    lab.world.later(0.3, lambda: lab.world.take("theirs", "add_media", {"ml": 0.5, "source-of-event": "UI"}))
    lab.wait(12.0)
    assert lab.given() == pytest.approx((1.4, 1.4), abs=0.02)
    assert lab.world.truth["add_media"] == pytest.approx(1.4, abs=0.02)
    assert not lab.of("given")


def test_a_foreign_automation_forbids_the_dose(lab):
    lab.world.say("dosing_automation/$state", "ready", experiment="another")
    lab.wait(1.0)
    assert lab.fault is not None
    assert lab.fault.kind == "mode"
    assert lab.dose(0.5) == 0.0


def test_a_foreign_automation_forbids_the_run(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.rows["dosing_automation"] = 1
    with pytest.raises(DeviceStateError, match="pio01: a dosing automation"):
        lab.begin()


def test_a_dead_queue_forbids_the_run(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.queue = False
    with pytest.raises(LinkError, match="task queue"):
        lab.begin()


@pytest.mark.parametrize("pump", ["media_pump", "waste_pump"])
def test_a_missing_calibration_forbids_the_run(monkeypatch, pump):
    lab = Lab(monkeypatch)
    del lab.web.active[pump]
    with pytest.raises(DeviceStateError, match=f"no active calibration of the {pump}"):
        lab.begin()


# -- stop and resume ---------------------------------------------------------------------------------------------------


def test_stop_ends_jobs_and_is_verified(lab):
    lab.dose(1.0)
    lab.until(lambda: bool(lab.world.since), 5.0)
    lab.reactors.stop()
    assert not lab.world.since
    assert len(lab.of("dose_end")) == 1
    low, high = lab.given()
    assert low <= lab.world.truth["add_media"] <= high


def test_stop_in_the_waste_of_a_dose_tells_how_much_was_taken(lab):
    lab.dose(1.0)
    lab.until(lambda: WASTE_PIN in lab.world.since, 10.0)
    lab.wait(0.4)
    lab.reactors.stop()
    assert not lab.world.since
    (end,), taken = lab.of("dose_end"), lab.world.truth["remove_waste"]
    assert 0.5 < taken < 1.5, "of 2 mL"
    assert end["waste_ml"] <= taken <= end["waste_high_ml"] + 0.02
    assert end["waste_high_ml"] == pytest.approx(taken, abs=0.2)


def test_stop_that_cannot_be_verified_says_which_plug(lab):
    lab.world.kill_after_s = 0.2
    lab.dose(0.5)
    lab.wait(1.0)
    with pytest.raises(DeviceStateError, match="pull the plug"):
        lab.reactors.stop()
    assert not lab.asked("remove_waste"), "no pump is started by a stop, and none goes on after it"


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


def test_a_process_that_starts_late_is_waited_for(lab):
    lab.world.begin_s = 25.0
    lab.dose(0.5)
    lab.wait(90.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [pytest.approx(0.5)]
    assert lab.world.truth["add_media"] == pytest.approx(0.5)


@pytest.mark.parametrize("version", ["25.11.19", "26.7.2"])
@pytest.mark.parametrize("away_s", [0.5, 90.0, 9 * 3600.0])
def test_a_dose_left_open_is_counted_at_most_whole_and_never_sent_again(monkeypatch, version, away_s):
    """Whatever time passed: not by the time that nobody watched."""
    lab = Lab(monkeypatch, World(version))
    lab.begin()
    lab.sample()
    lab.dose(0.8)
    lab.wait(0.6)
    rows, world = list(lab.rows), lab.world
    assert replay(rows)[UNIT].open
    world.box = None
    world.sleep(away_s)
    again = Lab(monkeypatch, world)
    again.rows = rows
    again.begin(replay(rows)[UNIT], 60.0 + away_s)
    took = again.until(lambda: bool(again.of("dose_end")), 100.0)
    assert took <= 100.0
    (end,) = again.of("dose_end")
    assert end["feed_low_ml"] <= world.truth["add_media"] <= end["feed_ml"] + 0.02
    assert end["feed_ml"] <= 0.85
    assert len(again.asked("add_media")) == 1
    assert again.fault is None
    again.sample()
    assert again.dose(0.5) == 0.5
    again.wait(8.0)
    assert len({o["source-of-event"] for o in again.asked("add_media")}) == 2


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
    past = History(
        boot="boot1", sample=(1.0, 1), doses=1, open=True, fed=True, id="turbidostat/run/pio01/1", feed_ml=0.5
    )
    lab.begin(past)
    lab.wait(30.0)
    assert not lab.of("dose_end")
    assert lab.fault is not None
    lab.world.waiting.insert(0, lambda: lab.world.take("t", "add_media", {"ml": 0.5, "source-of-event": past.id}))
    lab.world.revive()  # it runs late
    lab.wait(140.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.5]
    ((_, correction),) = lab.reactors.repeated()  # its waste is not on record, and was booked when it began
    assert (correction.volume_ml[0], correction.waste_ml[0]) == (0.0, -0.5)


def test_an_intent_whose_request_was_never_sent_gave_nothing(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin(History(sample=(1.0, 1), doses=1, open=True, fed=False, id="turbidostat/old/pio01/1", feed_ml=0.5))
    lab.wait(2.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.0]


@pytest.mark.parametrize(("given", "level"), [("nothing", 20.0), ("all but its waste", 20.6), ("as planned", 20.0)])
def test_the_ledger_of_the_interlock_ends_where_the_vial_does(lab, given, level):
    """A dose is booked when it begins; what became of it is booked as a correction."""
    budget = FeedBudget(SafetyConfig(), Bench(), np.full(1, 20.0), np.full(1, 25.0))
    lab.world.locks |= {MEDIA_PIN} if given == "nothing" else set()
    planned = lab.dose(0.6)
    budget.book(np.array([planned]), np.array([2.0 * planned]), 0.0)
    if given == "all but its waste":
        lab.world.locks.add(WASTE_PIN)
    lab.wait(160.0)
    for at, receipt in lab.reactors.repeated():
        budget.book(receipt.volume_ml, receipt.waste_ml, at)
    assert float(budget.volume_ml[0]) == pytest.approx(level, abs=0.01)
    assert float(budget.fed_ml[0]) == pytest.approx(lab.world.truth["add_media"], abs=0.01)


@pytest.mark.parametrize("version", ["25.11.19", "26.7.2"])
def test_the_unit_s_own_ledger_is_put_to_the_level_that_was_read(monkeypatch, version):
    lab = Lab(monkeypatch, World(version))
    lab.begin()
    lab.sample()
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
    assert lab.station.sampling.newest.od == pytest.approx(0.5)


def test_five_times_faster_a_period_of_two_minutes_is_dosed_whole_and_an_old_sample_not_at_all(monkeypatch):
    lab = Lab(monkeypatch, speed=5.0, period_s=120.0, waste_factor=3.0)
    lab.begin()
    lab.sample()
    assert lab.dose(0.9) == 0.9
    lab.wait(10.0)
    assert lab.world.truth["add_media"] == pytest.approx(0.9, abs=0.02)
    assert lab.world.truth["remove_waste"] == pytest.approx(2.7, abs=0.05)
    lab.sample()
    lab.world.od_alive = False
    lab.world.sleep(30.0)  # 150 s of the culture
    assert lab.dose(0.9) == 0.0
    assert "no dose: its sample is stale" in [row["note"] for row in lab.of("note")]


def test_a_slow_pump_is_given_the_time_that_its_dose_takes(monkeypatch):
    monkeypatch.setitem(FLOW, "add_media", 0.3)
    lab = Lab(monkeypatch)
    lab.begin()
    lab.sample()
    assert lab.dose(1.5) == 1.5
    lab.wait(15.0)
    assert lab.given() == pytest.approx((1.5, 1.5), abs=0.02)
    assert lab.world.truth["add_media"] == pytest.approx(1.5, abs=0.02)
    assert lab.fault is None


def test_pumps_off_while_a_run_goes_on_lets_the_waste_pump_end(lab):
    assert lab.dose(1.0) == 1.0
    lab.until(lambda: WASTE_PIN in lab.world.since, 10.0)
    assert lab.reactors.pumps_off(np.array([True])) == []
    assert lab.world.truth["remove_waste"] == pytest.approx(2.0, abs=0.05)


def test_alternative_medium_of_somebody_else_fills_the_vial(lab):
    lab.world.event("add_alt_media", 0.4, "UI")
    lab.wait(1.0)
    (row,) = lab.of("given")
    assert (row["feed_ml"], row["waste_ml"]) == (0.4, 0.0)


class Unit:
    """What is asked of a station, by unit."""

    def __init__(self, name):
        self.name, self.level_ml, self.asked = name, 0.0, []

    def regulate(self, setpoint):
        self.asked.append(setpoint)
        yield 0.0

    def go_on(self):
        pass


def test_each_unit_is_handed_over_at_its_own_setpoint_and_has_its_own_level(lab):
    lab.reactors.stations = units = (Unit("pio01"), Unit("pio02"))
    assert lab.reactors.regulate(np.array([True, True]), np.array([0.4, 0.7])) == []
    assert [unit.asked for unit in units] == [[0.4], [0.7]]
    lab.reactors.set_level(1, 14.5)
    assert [unit.level_ml for unit in units] == [0.0, 14.5]


def crashed(monkeypatch, first_s, speed=1.0):
    """The lab before and the lab after a crash `first_s` behind a dose of .8 mL that no pump took; not begun again."""
    lab = Lab(monkeypatch, speed=speed)
    lab.begin()
    lab.sample()
    lab.world.queue = False
    lab.dose(0.8)
    lab.wait(first_s)
    again = Lab(monkeypatch, lab.world, speed=speed)
    again.rows = list(lab.rows)
    return lab, again


def test_after_a_crash_medium_that_still_waits_in_the_queue_is_waited_for(monkeypatch):
    _, again = crashed(monkeypatch, 0.6)
    world = again.world
    again.begin(replay(again.rows)[UNIT], 60.0)
    again.wait(30.0)
    assert not again.of("dose_end")
    world.revive()
    again.until(lambda: bool(again.of("dose_end")), 120.0)
    assert world.truth["add_media"] == pytest.approx(0.8, abs=0.02)


def test_what_is_put_off_is_told_once_and_taken_back_when_it_is_given(lab):
    assert lab.dose(0.03) == 0.0
    assert lab.receipt.kept_ml[0] == pytest.approx(0.03)
    lab.sample()
    assert lab.dose(0.04) == pytest.approx(0.07)
    assert lab.receipt.kept_ml[0] == pytest.approx(-0.03)


def test_what_is_put_off_stays_while_nothing_is_asked_and_what_is_cut_is_not_put_off(lab):
    for asked, given, kept in (
        (0.03, 0.0, 0.03),
        (0.0, 0.0, 0.0),
        (0.04, 0.07, -0.03),
        (9.0, 1.5, 0.0),
        (0.2, 0.2, 0.0),
    ):
        assert lab.dose(asked) == pytest.approx(given)
        assert lab.receipt.kept_ml[0] == pytest.approx(kept)
        assert lab.receipt.waste_ml[0] == pytest.approx(2.0 * given)
        lab.sample()
    assert [row["doses"] for row in lab.of("intent")] == [0, 0, 1, 2, 3]
    assert [row["carry_ml"] for row in lab.of("intent")] == pytest.approx([0.03, 0.03, 0.0, 0.0, 0.0])


def test_waste_that_somebody_takes_out_is_no_feed(lab):
    lab.world.event("remove_waste", 0.6, "UI")
    lab.wait(1.0)
    (row,) = lab.of("given")
    assert (row["feed_ml"], row["feed_low_ml"], row["waste_ml"]) == (0.0, 0.0, 0.6)
    assert row["why"] == "remove_waste of 0.60 mL without our command (by UI)"
    ((at, receipt),) = lab.reactors.repeated()
    assert (receipt.volume_ml[0], receipt.waste_ml[0]) == (0.0, 0.6)
    assert at == pytest.approx(row["at_s"])


def test_the_least_and_the_most_of_what_somebody_takes_back_is_what_is_left(lab):
    """0.5 mL are told before they are pumped; of these 0.2 are taken back when it is stopped."""
    lab.world.event("add_media", 0.5, "UI")
    lab.world.event("add_media", -0.2, "UI")
    lab.wait(1.0)
    assert sum(row["feed_ml"] for row in lab.of("given")) == pytest.approx(0.3)
    assert lab.fault is not None
    assert "add_media of 0.30 mL without our command" in lab.fault.detail


@pytest.mark.parametrize(("volume_ml", "rim_ml"), [(14.0, 20.0), (30.0, 40.0)])
def test_after_a_stop_the_ledger_of_a_flooded_vial_stands_at_its_rim(monkeypatch, volume_ml, rim_ml):
    """A media pump that stood on for half a minute gave some 21 mL; a stop drains nothing."""
    lab = Lab(monkeypatch, volume_ml=volume_ml)
    lab.begin()
    lab.sample()
    lab.world.freeze_after_s, lab.world.frozen_s = 0.6, 29.0
    budget = FeedBudget(SafetyConfig(), lab.bench, np.full(1, volume_ml), np.full(1, 50.0))
    planned = lab.dose(0.7)
    budget.book(np.array([planned]), np.array([2.0 * planned]), 0.0)
    lab.until(lambda: bool(lab.world.since), 5.0)
    lab.wait(0.8)
    lab.reactors.config = replace(lab.reactors.config, stop_s=60.0)
    lab.reactors.stop()
    for at, receipt in lab.reactors.repeated():
        budget.book(receipt.volume_ml, receipt.waste_ml, at)
    assert lab.world.truth["add_media"] > 15.0
    assert float(budget.fed_ml[0]) >= lab.world.truth["add_media"] - 0.1
    assert float(budget.volume_ml[0]) == pytest.approx(rim_ml, abs=0.01)


def test_each_pump_s_flow_is_that_of_its_own_calibration_and_on_record(lab):
    (row,) = lab.of("device")
    assert row["flows"] == {"add_media": 0.7, "remove_waste": 1.6}
    assert (row["device_id"], row["boot"]) == (UNIT, "boot1")


def test_a_dose_has_the_name_of_its_run_its_unit_and_its_number(lab):
    lab.dose(0.2)
    lab.sample()
    lab.dose(0.3)
    lab.wait(6.0)
    first, second = (o["source-of-event"] for o in lab.asked("add_media"))
    assert (first, second) == ("turbidostat/run/pio01/1", "turbidostat/run/pio01/2")
    assert [row["id"] for row in lab.of("dose_end")] == [first, second]
    assert {row["id"] for row in lab.of("task")} == {first, second}
    assert [row["job"] for row in lab.of("task")] == ["add_media", "remove_waste"] * 2


def test_after_a_crash_of_a_fast_run_a_dose_is_late_by_real_time(monkeypatch):
    """Five times faster: 20 s of the run are 4 s, and 12 s are allowed until its pump is seen to run."""
    lab, again = crashed(monkeypatch, 0.5, speed=5.0)
    again.begin(replay(again.rows)[UNIT], lab.of("intent")[0]["on_s"] + 20.0)
    again.wait(4.0)
    assert again.fault is None
    again.wait(6.0)
    assert again.fault is not None
    assert "the fate of a dose of 0.80 mL (add_media) is unknown" in again.fault.detail
