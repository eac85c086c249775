"""A dose of a Pioreactor: in order, once, followed to its end; and every odd answer of the vendor's software."""

import numpy as np
import pytest

from hardware.errors import DeviceStateError, LinkError, RecordingError
from hardware.pioreactor.resume import History, replay
from hardware.safety.budget import FeedBudget
from hardware.safety.config import SafetyConfig
from tests.hardware.pioreactor_lab import MEDIA_PIN, UNIT, Lab, World


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
    assert lab.world.moved["add_media"] == pytest.approx(0.7)


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

    lab.station.book._log = full
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
    lab.world.lock = True
    lab.dose(0.5)
    lab.wait(25.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_ml"], lab.world.moved["add_media"]) == (0.0, 0.0)
    assert "pio cache clear pwm_locks" in end["end"]
    assert len(lab.asked("add_media")) == 1


@pytest.mark.parametrize("mute", [False, True], ids=["told", "killed before its pin was told"])
def test_a_killed_dose_whose_pin_runs_on_is_an_alarm_and_counted_until_it_is_proven_off(lab, mute):
    lab.world.kill_after_s, lab.world.mute = 0.2, mute
    lab.dose(0.5)
    lab.wait(15.0)
    assert lab.station.fault is not None
    assert lab.station.fault.kind == "pump"
    assert f"pwm_locks {MEDIA_PIN} --as-int" in lab.station.fault.detail
    assert not lab.of("dose_end")
    with pytest.raises(DeviceStateError, match="pull the plug"):
        lab.reactors.stop()
    lab.world.lock, lab.world.mute, lab.world.kill_after_s = False, False, np.inf  # the operator
    lab.wait(200.0)  # it drains once nobody has asked for pumps off for a while
    cycled, end = sorted(lab.of("dose_end"), key=lambda row: row["feed_ml"])
    assert lab.world.moved["remove_waste"] == pytest.approx(40.0)  # twice what can stand above the tube
    more = sum(r.volume_ml[0] for _, r in lab.reactors.repeated())
    assert 0.5 + more == pytest.approx(end["feed_ml"] + 0.1)
    assert end["feed_low_ml"] <= lab.world.moved["add_media"] <= end["feed_ml"] + cycled["feed_ml"]
    assert cycled["source"].endswith("/off")
    assert lab.station.fault is None
    assert not lab.world.duty
    lab.reactors.stop()
    assert len(lab.asked("add_media")) == 1


def test_a_job_that_was_accepted_and_died_at_once_did_nothing_and_is_told(lab):
    lab.world.dies = True
    lab.dose(0.5)
    lab.wait(20.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_ml"], lab.station.fault) == (0.0, None)
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


def test_short_runs_of_a_pump_do_not_pile_up_in_a_queue_that_is_dead(lab):
    lab.world.kill_after_s = 0.2
    lab.dose(0.5)
    lab.wait(2.0)
    lab.world.queue, lab.world.lock = False, False
    lab.wait(300.0)
    assert len([o for _, o in lab.world.runs if "duration" in o]) <= 2
    before = lab.world.moved["add_media"]
    lab.world.pin("add_media", False)
    lab.world.revive()
    lab.wait(30.0)
    assert sum(r["feed_ml"] for r in lab.of("dose_end") if r.get("source")) <= 0.21
    assert lab.world.moved["add_media"] >= before


def test_a_unit_that_forgot_the_queue_in_a_reboot_is_asked_again(lab):
    lab.world.queue = False
    lab.dose(0.5)
    lab.wait(20.0)
    lab.world.waiting.clear()  # what lay in memory
    lab.world.queue = True
    lab.wait(220.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_ml"], lab.station.fault) == (0.0, None)
    assert len(lab.asked("add_media")) == 1


def test_a_vial_that_a_pump_filled_is_drained_although_a_stop_comes_in_between(lab):
    lab.world.kill_after_s = 0.2
    lab.dose(0.5)
    lab.wait(8.0)
    lab.world.lock, lab.world.kill_after_s = False, np.inf
    assert lab.station.doses.running
    lab.world.stop_after_s = 2.0  # somebody stops it in the middle of the draining
    while "remove_waste" not in lab.world.jobs:
        lab.wait(0.5)
    assert not replay(lab.rows)[UNIT].open, "a program that is killed now knows what the dose was"
    lab.wait(5.0)
    lab.world.stop_after_s = np.inf
    lab.wait(300.0)
    (end,) = [row for row in lab.of("dose_end") if row.get("id")]
    assert end["feed_ml"] > 5.0
    assert lab.world.moved["remove_waste"] >= 2.0 * end["feed_ml"] - 0.1
    assert lab.station.fault is None


def test_a_request_in_a_dead_queue_is_never_sent_again_and_is_noticed_when_it_runs_late(lab):
    lab.world.queue = False
    lab.dose(0.5)
    lab.wait(60.0)
    assert lab.station.fault is not None
    assert "unknown" in lab.station.fault.detail
    assert lab.dose(0.5) == 0.0
    lab.world.revive()
    lab.wait(10.0)
    (end,) = lab.of("dose_end")
    assert end["feed_ml"] == pytest.approx(lab.world.moved["add_media"]) == pytest.approx(0.5)
    assert len(lab.asked("add_media")) == 1
    assert lab.station.fault is None


def test_a_lost_answer_is_unknown_not_a_reason_to_ask_again(lab):
    lab.world.heard = "lost answer"
    lab.dose(0.5)
    lab.wait(30.0)
    assert len(lab.asked("add_media")) == 1
    (end,) = lab.of("dose_end")
    assert end["feed_ml"] == pytest.approx(0.5)


def test_a_lost_answer_of_a_request_nobody_heard_ends_with_nothing_given(lab):
    lab.world.heard, lab.world.lock = "lost answer", True
    lab.dose(0.5)
    lab.wait(30.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.0]
    assert lab.station.fault is None


@pytest.mark.parametrize("how", ["429", "refused"])
def test_a_request_that_was_turned_away_gave_nothing_and_holds_nothing_up(lab, how):
    lab.world.heard = "429" if how == "429" else "yes"
    if how == "refused":
        lab.station.doses._strays = lambda: False
        lab.world.web = False
    lab.dose(0.5)
    lab.wait(1.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [0.0]
    assert not lab.station.doses.running


def test_a_list_of_jobs_that_cannot_be_had_forbids_the_dose(lab):
    lab.world.heard = "500"
    assert lab.dose(0.5) == 0.0
    assert not lab.asked("add_media")


def test_a_broker_lost_in_a_dose_makes_it_counted_whole(lab):
    lab.dose(1.0)
    lab.wait(1.0)
    lab.world.broker, lab.world.mqtt.breaks = False, 1
    lab.wait(5.0)
    assert lab.station.fault is not None
    assert lab.station.fault.kind == "link"
    lab.world.broker = True
    lab.world.box.forget()
    lab.wait(3.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_low_ml"], end["feed_ml"]) == (0.0, 1.0)


def test_a_dose_asked_for_just_before_the_broker_died_is_counted_whole(lab):
    lab.dose(1.0)
    lab.world.broker, lab.world.mqtt.breaks = False, 1
    lab.wait(5.0)
    lab.world.broker = True
    lab.world.box.forget()
    lab.wait(140.0)
    (end,) = lab.of("dose_end")
    assert (end["feed_low_ml"], end["feed_ml"]) == (0.0, 1.0)


def test_events_of_a_dose_stopped_early_are_a_bound_not_the_truth(lab):
    lab.world.stop_after_s = 0.603
    lab.dose(1.4)
    lab.wait(8.0)
    (end,) = lab.of("dose_end")
    assert lab.world.moved["add_media"] == pytest.approx(0.603)
    assert end["feed_low_ml"] <= 0.603 <= end["feed_ml"]


def test_a_job_that_ends_its_pump_late_is_counted_by_the_pin(lab):
    lab.world.late_s = 1.0
    lab.dose(0.5)
    lab.wait(10.0)
    (end,) = lab.of("dose_end")
    assert lab.world.moved["add_media"] == pytest.approx(1.5)
    assert (end["feed_low_ml"], end["feed_ml"]) == (pytest.approx(0.5), pytest.approx(1.5))


def test_a_dose_of_somebody_else_is_counted_once_and_holds_ours(lab):
    lab.world.event("add_media", 0.5, "UI")
    lab.wait(1.0)
    assert lab.station.fault is not None
    assert lab.station.fault.kind == "mode"
    ((_, receipt),) = lab.reactors.repeated()
    assert receipt.volume_ml[0] == pytest.approx(0.5)
    assert lab.reactors.repeated() == []
    assert lab.dose(0.5) == 0.0


def test_a_foreign_automation_forbids_the_dose(lab):
    lab.world.say("dosing_automation/$state", "ready", experiment="another")
    lab.wait(1.0)
    assert lab.station.fault is not None
    assert lab.station.fault.kind == "mode"
    assert lab.dose(0.5) == 0.0


def test_a_foreign_automation_forbids_the_run(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.say("dosing_automation/$state", "ready")
    with pytest.raises(DeviceStateError, match="dosing automation"):
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


def test_a_pump_that_nobody_commanded_is_an_alarm(lab):
    lab.world.pin("add_media", True)
    lab.wait(1.0)
    assert lab.station.fault is not None
    assert lab.station.fault.kind == "pump"
    assert lab.dose(0.5) == 0.0


# -- stop and resume ---------------------------------------------------------------------------------------------------


def test_stop_ends_jobs_by_mqtt_and_is_verified(lab):
    lab.dose(1.0)
    lab.wait(0.6)
    lab.reactors.stop()
    topics = [topic for topic, payload in lab.world.mqtt.said if payload == "disconnected"]
    assert f"pioreactor/{UNIT}/turbidostat/add_media/$state/set" in topics
    assert not lab.world.duty
    assert len(lab.of("dose_end")) == 1


def test_stop_that_cannot_be_verified_says_which_plug(lab):
    lab.world.pin("add_media", True)
    lab.world.lock = True
    with pytest.raises(DeviceStateError, match="pull the plug"):
        lab.reactors.stop()


def test_a_pin_left_on_without_its_job_is_switched_on_and_off(lab):
    lab.world.pin("remove_waste", True)  # what the vendor's job leaves when it is stopped just as its pump starts
    lab.wait(1.0)
    lab.reactors.stop()
    (short,) = [(job, o) for job, o in lab.world.runs if "duration" in o]
    assert short[0] == "remove_waste"
    assert not lab.world.duty


def test_a_locked_pin_left_on_is_tried_seldom_and_told(lab):
    lab.world.pin("remove_waste", True)
    lab.world.lock = True
    with pytest.raises(DeviceStateError, match="pull the plug"):
        lab.reactors.stop()
    assert 2 <= len([o for _, o in lab.world.runs if "duration" in o]) <= 6


def test_a_job_that_was_killed_before_this_run_is_proven_off_first(lab):
    lab.world.say("remove_waste/$state", "lost")
    lab.wait(0.3)
    assert lab.dose(0.5) == 0.0
    lab.wait(10.0)
    assert lab.station.fault is None
    assert [row["waste_ml"] for row in lab.of("dose_end")] == [pytest.approx(0.1)]


def test_a_process_that_starts_late_is_waited_for(lab, monkeypatch):
    monkeypatch.setattr("tests.hardware.pioreactor_lab.BEGIN_S", 25.0)
    lab.dose(0.5)
    lab.wait(70.0)
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [pytest.approx(0.5)]
    assert lab.world.moved["add_media"] == pytest.approx(0.5)


def test_a_job_that_is_there_is_about_to_begin_and_not_stopped(lab, monkeypatch):
    monkeypatch.setattr("tests.hardware.pioreactor_lab.BEGIN_S", 20.0)
    lab.dose(0.5)
    lab.world.later(11.0, lambda: lab.world.say("add_media/$state", "init"))
    lab.wait(15.0)
    monkeypatch.setattr("tests.hardware.pioreactor_lab.BEGIN_S", 0.4)
    lab.wait(15.0)
    assert not lab.of("note")
    assert [row["feed_ml"] for row in lab.of("dose_end")] == [pytest.approx(0.5)]


def test_a_dose_left_open_is_counted_whole_and_never_sent_again(monkeypatch, lab):
    lab.dose(0.8)
    rows = [row for row in lab.rows]
    assert replay(rows)[UNIT].open
    again = Lab(monkeypatch, World())
    again.begin(replay(rows)[UNIT])
    again.wait(140.0)
    (end,) = again.of("dose_end")
    assert (end["feed_low_ml"], end["feed_ml"], end["waste_ml"]) == (0.0, 0.8, 0.0)
    assert not again.asked("add_media")
    again.sample()
    again.dose(0.5)
    assert again.asked("add_media")[0]["source-of-event"] != lab.asked("add_media")[0]["source-of-event"]


def test_an_open_dose_waits_for_a_dead_queue(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.queue = False
    lab.begin(History(sample=(1.0, 1), doses=1, open=True, fed=True, id="turbidostat/old/pio01/1", feed_ml=0.5))
    lab.wait(30.0)
    assert not lab.of("dose_end")
    assert lab.station.fault is not None
    lab.world.event("add_media", 0.5, "turbidostat/old/pio01/1")  # it runs late
    lab.world.revive()
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
    budget = FeedBudget(1, SafetyConfig(volume_ml=20.0))
    lab.world.lock = given == "nothing"
    planned = lab.dose(0.6)
    budget.book(np.array([planned]), np.array([2.0 * planned]), 0.0)
    if given == "all but its waste":
        lab.world.later(0.9, lambda: setattr(lab.world, "lock", True))  # once the media pump runs
    lab.wait(160.0)
    for at, receipt in lab.reactors.repeated():
        budget.book(receipt.volume_ml, receipt.waste_ml, at)
    assert float(budget.volume_ml[0]) == pytest.approx(level, abs=0.01)
    assert float(budget.fed_ml[0]) == pytest.approx(lab.world.moved["add_media"], abs=0.01)
