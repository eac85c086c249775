"""The judge of a deployment on the Pioreactor rig, on rows made by hand: what it measures, and what it must see."""

import copy
from typing import Any

import pytest

from tests.campaigns import rig_truth
from tests.campaigns.rig_truth import Limits, UnitTruth

SPEED, UNIT = 4.0, "pio01"  # 150 s of real time are ten minutes of the culture
LIMITS = Limits()
Row = dict[str, Any]


class Run:
    """A run of one unit from second 1000 to 1300: setpoint 0.8 for 100 s, then 0.5; a dose of 1.2 mL each 15 s.

    The true OD is 0.004 over the setpoint in the last 150 s and 0.02 over it before.
    """

    def __init__(self) -> None:
        self.journal: list[Row] = []
        self.truth: list[Row] = [self.vial(wall) for wall in range(990, 1301)]
        self.events: list[Row] = []
        self.say("decision", 995.0, row={"phase": -1, "setpoint": 0.8})
        for k, wall in enumerate(range(1000, 1300, 15)):
            phase = int(wall >= 1100)
            self.say("decision", float(wall), row={"phase": phase, "setpoint": (0.8, 0.5)[phase]})
            self.dose(f"turbidostat/run/pio01/{k + 1}", float(wall), 1.2, 1.203)
        self.say("sample", 1300.0)

    @staticmethod
    def vial(wall: int) -> Row:
        setpoint = 0.8 if wall < 1105 else 0.5  # the first decision after second 1100
        volume = {"volume_ml": 20.0, "peak_ml": 21.2, "duty": {"13": 0.0, "12": 0.0}}
        return {"wall": float(wall), "unit": UNIT, "od": setpoint + (0.004 if wall >= 1150 else 0.02), **volume}

    def say(self, kind: str, wall: float, **fields: Any) -> None:
        self.journal.append({"kind": kind, "wall": wall, "reactor": UNIT, **fields})

    def dose(self, name: str, wall: float, ml: float, given: float) -> None:
        """From intent to end, what the vendor told of it, and the pump's run 0.2 s after it."""
        self.say("intent", wall, feed_ml=ml, id=name)
        self.say("feed_on", wall, id=name)
        self.say("dose_end", wall + 4.0, feed_ml=ml, feed_low_ml=ml, feed_times=0, id=name, end="")
        self.events.append({"unit": UNIT, "event": "add_media", "volume_change": ml, "source_of_event": name})
        self.pump(wall + 0.2, given)

    def pump(self, start: float, ml: float, pump: str = "media") -> None:
        self.truth.append({"wall": start + 2.0, "unit": UNIT, "pump": pump, "start": start, "s": ml, "ml": ml})

    def judged(self) -> UnitTruth:
        spans = rig_truth.phases(self.journal, UNIT)
        held = tuple(rig_truth.held(span, self.truth, UNIT, SPEED) for span in spans)
        account = rig_truth.account(self.journal, self.truth, self.events, UNIT)
        return UnitTruth(UNIT, held, rig_truth.vial(self.truth, UNIT), account)

    def trouble(self) -> list[str]:
        return rig_truth.trouble(self.judged(), LIMITS, 20.0)

    def of(self, kind: str, k: int) -> Row:
        return [row for row in self.journal if row["kind"] == kind][k]


@pytest.fixture
def run() -> Run:
    return copy.deepcopy(SOUND)


SOUND = Run()


def test_a_setpoint_is_judged_by_the_true_od_of_its_window_and_of_its_last_ten_minutes(run: Run) -> None:
    first, second = run.judged().held
    assert (first.setpoint, second.setpoint) == (0.8, 0.5)
    assert first.minutes == pytest.approx(105.0 * 4.0 / 60.0)  # its end is the first decision of the next one
    assert (first.error_od, first.last_error_od) == pytest.approx((0.02, 0.02))
    assert second.minutes == pytest.approx(13.0)
    assert second.last_error_od == pytest.approx(0.004)
    assert second.error_od == pytest.approx((45 * 0.02 + 150 * 0.004) / 195)  # rows each second from 1105 to 1299
    assert (first.media_ml, second.media_ml) == pytest.approx((7 * 1.203, 13 * 1.203))


def test_an_error_to_both_sides_is_no_bias(run: Run) -> None:
    for row in run.truth:
        if "od" in row and row["wall"] >= 1150:
            row["od"] = 0.5 + (0.008 if row["wall"] % 2 else -0.008)
    last = run.judged().held[-1]
    assert (last.last_error_od, last.last_bias_od) == pytest.approx((0.008, 0.0))


def test_every_dose_is_matched_with_its_run_of_the_pump(run: Run) -> None:
    a = run.judged().account
    assert a is not None
    assert (a.asked, a.runs, a.without_intent, a.twice, a.missing) == (20, 20, 0, 0, 0)
    assert (a.error_mean_ml, a.error_max_ml, a.outside_ml) == pytest.approx((0.003, 0.003, 0.003))
    assert (a.given_ml, a.booked_ml) == pytest.approx((24.06, 24.0))
    assert a.total_pct == pytest.approx(0.06 / 24.06 * 100.0)
    assert (a.ids_repeated, a.ids_untold, a.foreign_events) == (0, 0, 0)


def test_a_sound_run_keeps_every_limit_but_that_of_its_first_window(run: Run) -> None:
    said = "pio01: mean |OD - setpoint| of the last 10 min at 0.8 is 0.0200 (allowed 0.01)"
    assert run.trouble() == [said]


def test_a_decision_without_a_dose_and_other_pumps_and_units_are_no_doses(run: Run) -> None:
    run.say("intent", 1299.0, feed_ml=0.0, id="turbidostat/run/pio01/20")
    run.pump(1299.0, 2.4, "waste")
    run.truth.append({**run.truth[-1], "pump": "media", "unit": "vendor"})
    run.events.append({**run.events[0], "unit": "vendor", "source_of_event": "dosing_automation:turbidostat"})
    run.events.append({**run.events[0], "event": "remove_waste"})
    run.truth.append({"wall": 1299.5, "error": "KeyError: 'unit'"})
    assert len(run.trouble()) == 1


def test_a_dose_that_runs_twice(run: Run) -> None:
    run.pump(1001.5, 1.2)
    account = run.judged().account
    assert account is not None
    assert (account.twice, account.without_intent) == (1, 0)
    assert "pio01: doses given twice: 1" in run.trouble()


@pytest.mark.parametrize("start", [990.0, 1010.0, 1299.0])  # before all, between two, after the last
def test_a_run_of_the_pump_without_an_intent(run: Run, start: float) -> None:
    run.pump(start, 0.2)
    account = run.judged().account
    assert account is not None
    assert (account.twice, account.without_intent) == (0, 1)
    assert "pio01: runs of the media pump without an intent: 1" in run.trouble()


def test_a_dose_that_was_never_given(run: Run) -> None:
    run.truth = [row for row in run.truth if row.get("start") != 1015.2]
    assert "pio01: doses of the journal without a run of the pump: 1" in run.trouble()


def test_a_dose_that_the_journal_knows_was_not_given_is_not_missed(run: Run) -> None:
    run.truth = [row for row in run.truth if row.get("start") != 1015.2]
    run.of("dose_end", 1).update(feed_ml=0.0, feed_low_ml=0.0)
    account = run.judged().account
    assert account is not None
    assert (account.missing, account.runs) == (0, 19)
    assert account.booked_ml == pytest.approx(19 * 1.2)


def test_a_dose_that_is_too_large_and_outside_of_the_driver_s_bound(run: Run) -> None:
    next(row for row in run.truth if row.get("start") == 1015.2)["ml"] = 1.27
    found = run.trouble()
    assert "pio01: a dose is 0.070 mL off (allowed 0.05)" in found
    assert "pio01: a dose is 0.070 mL outside of the driver's bound (allowed 0.05)" in found


def test_a_dose_of_uncertain_volume_inside_of_the_bound_is_off_all_the_same(run: Run) -> None:
    run.of("dose_end", 1)["feed_low_ml"] = 0.2
    next(row for row in run.truth if row.get("start") == 1015.2)["ml"] = 0.7
    found = [line for line in run.trouble() if "a dose is" in line]
    assert found == ["pio01: a dose is 0.500 mL off (allowed 0.05)"]


def test_a_dose_that_ended_early_by_the_journal_is_held_against_its_bound_alone(run: Run) -> None:
    run.of("dose_end", 1).update(feed_low_ml=0.2, end="0.70 of 1.20 mL told: ended early")
    run_of_it = next(row for row in run.truth if row.get("start") == 1015.2)
    run_of_it["ml"] = 0.7
    account = run.judged().account
    assert account is not None
    assert account.cut == 1
    assert (account.error_mean_ml, account.error_max_ml, account.outside_ml) == pytest.approx((0.003,) * 3)
    run_of_it["ml"] = 0.1
    assert "pio01: a dose is 0.100 mL outside of the driver's bound (allowed 0.05)" in run.trouble()
    run.of("dose_end", 1).update(feed_ml=1.5)  # and one that gave too much is off, whatever the journal says
    run_of_it["ml"] = 1.5
    assert "pio01: a dose is 0.300 mL off (allowed 0.05)" in run.trouble()


def test_every_dose_a_little_off_is_a_wrong_total(run: Run) -> None:
    for row in run.journal:
        if row["kind"] in ("intent", "dose_end"):
            row["feed_ml"] = 0.6
            row["feed_low_ml"] = 0.6
    for row in run.truth:
        if "pump" in row:
            row["ml"] = 0.645  # 7 % of it, each within 0.05 mL
    found = run.trouble()
    assert "pio01: 12.90 mL were given and 12.00 mL booked, +7.0 % (allowed 5)" in found
    assert not any("a dose is" in line for line in found)


def test_what_the_journal_books_beyond_its_doses_counts_in_the_total(run: Run) -> None:
    run.say("dose_end", 1299.0, feed_ml=6.0, feed_times=1, source="somebody")
    account = run.judged().account
    assert account is not None
    assert account.booked_ml == pytest.approx(30.0)
    assert any("30.00 mL booked" in line for line in run.trouble())


def test_an_open_dose_is_booked_whole_and_may_have_given_nothing(run: Run) -> None:
    run.say("intent", 1299.0, feed_ml=1.0, id="turbidostat/run/pio01/21")
    account = run.judged().account
    assert account is not None
    assert account.missing == 0
    assert (account.outside_ml, account.booked_ml) == pytest.approx((0.003, 25.0))
    run.pump(1299.5, 1.0)
    account = run.judged().account
    assert account is not None
    assert (account.without_intent, account.runs) == (0, 21)


def test_an_id_that_the_vendor_s_software_never_told(run: Run) -> None:
    seventh = next(row for row in run.events if row["source_of_event"].endswith("/7"))
    seventh["event"] = "remove_waste"  # its waste alone was
    assert "pio01: doses whose id is in none of the vendor's dosing events: 1" in run.trouble()


def test_an_event_with_an_id_of_no_dose(run: Run) -> None:
    run.events.append({**run.events[0], "source_of_event": "turbidostat/run/pio01/99"})
    assert "pio01: dosing events with an id of no dose: 1" in run.trouble()


def test_an_id_that_was_given_out_twice(run: Run) -> None:
    for kind in ("intent", "dose_end"):
        run.of(kind, 5)["id"] = run.of(kind, 4)["id"]
    assert "pio01: ids given to more than one dose: 1" in run.trouble()


def test_without_recorded_events_nothing_is_said_of_them(run: Run) -> None:
    account = rig_truth.account(run.journal, run.truth, None, UNIT)
    assert (account.ids_untold, account.foreign_events) == (None, None)


def test_an_offset_of_the_true_od(run: Run) -> None:
    for row in run.truth:
        if "od" in row:
            row["od"] += 0.0061
    assert "pio01: mean |OD - setpoint| of the last 10 min at 0.5 is 0.0101 (allowed 0.01)" in run.trouble()


def test_a_vial_that_fills_and_a_pump_that_is_on(run: Run) -> None:
    run.truth.append({**run.vial(1301), "peak_ml": 22.1, "duty": {"13": 100.0}})
    found = run.trouble()
    assert "pio01: 22.10 mL in the vial (allowed 20 + 2)" in found
    assert "pio01: a pump is on at the end" in found


def test_a_unit_of_which_nothing_is_on_record_keeps_nothing(run: Run) -> None:
    account = rig_truth.account(run.journal, run.truth, run.events, "pio02")
    found = UnitTruth("pio02", (), rig_truth.vial(run.truth, "pio02"), account)
    said = " ".join(rig_truth.trouble(found, LIMITS, 20.0))
    assert "no window" in said
    assert "no dose" in said
    assert "nan mL in the vial" in said


def test_a_window_that_no_truth_covers_is_not_kept(run: Run) -> None:
    run.truth = [row for row in run.truth if not ("od" in row and row["wall"] >= 1110)]
    assert any("at 0.5 is nan" in line for line in run.trouble())


def test_what_the_vendor_s_turbidostat_gives_after_the_hand_over_is_its_own(run: Run) -> None:
    run.say("regulate", 1298.0, setpoint=0.5)
    run.pump(1299.0, 1.0)
    account = run.judged().account
    assert account is not None
    assert (account.without_intent, account.runs) == (0, 20)


def test_the_vendor_s_windows_are_those_of_its_targets() -> None:
    told = ((10.0, 0.8), (20.0, 0.5), (35.0, None))
    rows = [{"wall": wall, "setpoint": setpoint} for wall, setpoint in told]
    found = [(span.setpoint, span.start, span.end) for span in rig_truth.targets(rows)]
    assert found == [(0.8, 10.0, 20.0), (0.5, 20.0, 35.0)]
    assert [span.setpoint for span in rig_truth.targets(rows[:2])] == [0.8]  # the last has no end on record
