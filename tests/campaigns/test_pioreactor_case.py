"""The judges of the Pioreactor rig: a sound run by hand passes, and everything that is planted in it is seen."""

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from hardware.rig.vials import Pulse
from tests.campaigns import rig_truth
from tests.campaigns.faults import Case, FaultsConfig, all_cases
from tests.campaigns.outcome import judged, table
from tests.campaigns.pioreactor_case import found_in
from tests.campaigns.pioreactor_faults import FAULTS, rig
from tests.campaigns.pioreactor_trial import FAULTED, WELL, Seen
from tests.campaigns.rig_truth import Limits, UnitTruth
from tests.hardware.pioreactor_bench import PACKAGES, need_the_rig

STRUCK = 30.0
CASES = all_cases(FaultsConfig(families=("pioreactor",)))
FAULT = rig("made_up", "", lambda t: None, by=("a word",))


def sound() -> Seen:
    """Ten samples of two units, 12 s apart, a dose of 0.5 mL for each of the sick one's; a word at the third."""
    journal: list[dict[str, Any]] = []
    pulses, rows, vials = [], {FAULTED: [], WELL: []}, {FAULTED: [], WELL: []}  # type: ignore[var-annotated]
    for k in range(10):
        wall = 12.0 * k
        for unit in (FAULTED, WELL):
            journal.append({"kind": "sample", "reactor": unit, "wall": wall, "sample_s": 60.0 * k})
            rows[unit].append((float(k), 0.5))
        if k == 3:
            journal.append({"kind": "note", "reactor": FAULTED, "wall": wall, "note": "a word on it"})
        journal.append({"kind": "feed_on", "reactor": FAULTED, "wall": wall + 0.1, "id": f"r/{k}"})
        pulses.append(Pulse(FAULTED, "media", wall + 0.5, 0.5, 0.5))
        end = {"kind": "dose_end", "reactor": FAULTED, "wall": wall + 2.0, "id": f"r/{k}", "feed_ml": 0.5}
        journal.append({**end, "feed_low_ml": 0.5})
    for second in range(120):
        for unit in (FAULTED, WELL):
            fed = 0.5 * min((second + 11) // 12, 10)
            vials[unit].append(
                {"wall": float(second), "od": 0.5, "fed_ml": fed, "peak_ml": 20.5, "duty": {"12": 0.0, "13": 0.0}}
            )
    return Seen(tuple(journal), rows, tuple(pulses), vials, "", 0, 5.0)


def changed(seen: Seen, kind: str, number: int, **values: Any) -> Seen:
    """The same with other values in the n-th row of a kind of the sick unit's journal."""
    at = [i for i, row in enumerate(seen.journal) if row["kind"] == kind and row["reactor"] == FAULTED][number]
    rows = [{**row, **values} if i == at else row for i, row in enumerate(seen.journal)]
    return replace(seen, journal=rows)


def vial(seen: Seen, unit: str, first: int, **values: Any) -> Seen:
    """The same with other values of a vial from a second on."""
    rows = [{**row, **values} if i >= first else row for i, row in enumerate(seen.vials[unit])]
    return replace(seen, vials={**seen.vials, unit: rows})


def test_a_sound_trial_passes_and_is_counted() -> None:
    found = judged(found_in(sound(), FAULT, "between", [STRUCK]), FAULT)
    assert found.ok, found.wrong
    assert (found.doses, found.doses_doubled, found.rows, found.rows_lost) == (10, 0, 10, 0)
    assert found.detected_s == pytest.approx(6.0)  # from second 30 to the sample at 36
    assert (found.low_ml, found.high_ml, found.fed_ml) == pytest.approx((5.0, 5.0, 5.0))


def pulse(seen: Seen, start: float, seconds: float) -> Seen:
    return replace(seen, pulses=(*seen.pulses, Pulse(FAULTED, "media", start, seconds, 0.5)))


def recorded(seen: Seen, unit: str, rows: list[tuple[float, float]]) -> Seen:
    return replace(seen, rows={**seen.rows, unit: rows})


def one_id_twice(seen: Seen) -> Seen:
    return changed(changed(seen, "feed_on", 5, id="r/4"), "dose_end", 5, id="r/4")


def given(seen: Seen) -> Seen:
    """Half a mL more in the vial, that somebody else dosed by the journal."""
    row = {"kind": "given", "reactor": FAULTED, "wall": 40.0, "feed_ml": 0.5, "feed_low_ml": 0.5}
    return replace(vial(seen, FAULTED, 100, fed_ml=5.5), journal=[*seen.journal, row])


def refused(seen: Seen, **values: Any) -> Seen:
    return replace(seen, **{"status": 1, "told": "INFO pass\nerror: a word; remedy\n", "journal": ()} | values)


REFUSED = {"refused": True}
PLANTED: dict[str, tuple[Callable[[Seen], Seen], dict[str, Any], list[str]]] = {
    # what is done to a sound trial, what is declared of its fault, and what is wrong then
    "one run more": (lambda s: pulse(s, 26.0, 0.5), {}, ["doses doubled"]),
    "one run more, of somebody": (lambda s: pulse(s, 26.0, 0.5), {"foreign": 1}, []),
    "a pin switched on and off": (lambda s: pulse(s, 26.0, 0.1), {}, []),
    "an end of another": (lambda s: changed(s, "dose_end", 4, id="other"), {}, ["dosed in doubt"]),
    "no last end": (lambda s: changed(s, "dose_end", 9, id="other"), {}, ["dose without an end"]),
    "one id twice": (one_id_twice, {}, ["an id twice"]),
    "more in the vial": (lambda s: vial(s, FAULTED, 100, fed_ml=6.0), {}, ["volume not as booked"]),
    "less in the vial": (lambda s: vial(s, FAULTED, 100, fed_ml=3.5), {}, ["volume not as booked"]),
    "more, pump not as told": (lambda s: vial(s, FAULTED, 100, fed_ml=6.0), {"flow": True}, []),
    "more, counted whole": (
        lambda s: vial(changed(s, "dose_end", 3, feed_ml=1.5), FAULTED, 100, fed_ml=6.0), {}, [],
    ),
    "more, booked as given": (given, {}, []),
    "a row lost": (lambda s: recorded(s, FAULTED, [*s.rows[FAULTED][:4], *s.rows[FAULTED][5:]]), {}, ["rows lost"]),
    "a row doubled": (lambda s: recorded(s, WELL, [*s.rows[WELL], (9.5, 0.5)]), {}, ["rows doubled"]),
    "rows far apart": (
        lambda s: recorded(s, FAULTED, [(0.0, 0.5), (60.0, 0.5)]), {"minutes": 1 / 60}, ["rows lost", "no rows"],
    ),
    "another word": (lambda s: changed(s, "note", 0, note="something else"), {}, ["not detected"]),
    "a word too late": (lambda s: s, {"within_s": -7.0}, ["detected late"]),
    "sick one astray at last": (lambda s: vial(s, FAULTED, 100, od=0.6), {}, ["not held"]),
    "well one astray once": (
        lambda s: vial(vial(s, WELL, 50, od=0.6), WELL, 60, od=0.5), {}, ["neighbour strayed"],
    ),
    "a pump on": (lambda s: vial(s, WELL, 119, duty={"12": 100.0, "13": 0.0}), {}, ["pumps not off"]),
    "too full": (lambda s: vial(s, FAULTED, 50, peak_ml=25.0), {}, ["overflow"]),
    "client failed": (lambda s: replace(s, status=1), {}, ["client failed"]),
    "nothing on record": (
        lambda s: replace(s, journal=()), {}, ["nothing is on record", "pumps not off", "not detected"],
    ),
    "refused": (refused, REFUSED, []),
    "refused for another reason": (lambda s: refused(s, told="error: something\n"), REFUSED, ["not detected"]),
    "let in": (lambda s: refused(s, status=0), REFUSED, ["not refused"]),
    "refused with a traceback": (
        lambda s: refused(s, told="Traceback\nerror: a word\n"), REFUSED, ["not refused"],
    ),
    "refused, and dosed": (lambda s: refused(s, journal=s.journal), REFUSED, ["dosed though refused"]),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_what_is_planted_in_a_sound_trial_is_wrong(name: str) -> None:
    plant, declares, said = PLANTED[name]
    fault = replace(FAULT, **declares)
    assert set(judged(found_in(plant(sound()), fault, "between", [STRUCK]), fault).wrong) == set(said)


@pytest.mark.campaign
@pytest.mark.xdist_group("pioreactor")  # one rig at a time
@pytest.mark.parametrize("package", PACKAGES)
@pytest.mark.parametrize("case", CASES, ids=[f"{case.fault}-{case.moment}" for case in CASES])
def test_every_fault_goes_as_declared_with_the_vendor_s_software(case: Case, package: str, tmp_path: Path) -> None:
    need_the_rig(PACKAGES[package])
    found = case.run(FaultsConfig(families=("pioreactor",), package=PACKAGES[package], kills=1), tmp_path)
    assert found.wrong == []


def test_faults_of_both_families_are_cases_of_one_command() -> None:
    config = FaultsConfig(faults=("feed blocked", "queue_killed"), moments=("dose", "in"), controls=0)
    cases = [(case.fault, case.moment, case.guarded) for case in all_cases(config)]
    assert cases == [("feed blocked", "dose", True), ("queue_killed", "in", False)]
    assert {case.fault for case in CASES} == {fault.name for fault in FAULTS}
    assert len(CASES) == sum(len(fault.moments) for fault in FAULTS)  # no healthy runs
    assert sum(fault.often for fault in FAULTS) == 6


def test_the_table_of_the_rig_says_what_was_fed() -> None:
    head, _, row = table([judged(found_in(sound(), FAULT, "between", [STRUCK]), FAULT)]).splitlines()
    cells = dict(zip(head.split(" | "), row.split(" | "), strict=True))
    assert (cells["reported after, s"], cells["doses"], cells["times"]) == ("6.0", "10", "1")
    assert (cells["fed on record, mL"], cells["true, mL"]) == ("5.00 to 5.00", "5.00")


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
        """From intent to end, and the pump's run 0.2 s after it."""
        self.say("intent", wall, feed_ml=ml, id=name)
        self.say("feed_on", wall, id=name)
        self.say("dose_end", wall + 4.0, feed_ml=ml, feed_low_ml=ml, feed_times=0, id=name, end="")
        self.pump(wall + 0.2, given)

    def pump(self, start: float, ml: float, pump: str = "media") -> None:
        self.truth.append({"wall": start + 2.0, "unit": UNIT, "pump": pump, "start": start, "s": ml, "ml": ml})

    def judged(self) -> UnitTruth:
        return rig_truth.found_in(self.journal, self.truth, UNIT, SPEED)

    def trouble(self) -> list[str]:
        return rig_truth.trouble(self.judged(), LIMITS, 20.0)

    def of(self, kind: str, k: int) -> Row:
        return [row for row in self.journal if row["kind"] == kind][k]

    def run_at(self, start: float) -> Row:
        return next(row for row in self.truth if row.get("start") == start)

    def account(self) -> dict[str, Any]:
        return asdict(rig_truth.account(self.journal, self.truth, UNIT))


@pytest.fixture
def run() -> Run:
    return copy.deepcopy(SOUND)


SOUND = Run()


def test_a_setpoint_is_judged_by_the_true_od_of_the_last_ten_minutes_of_its_window(run: Run) -> None:
    first, second = run.judged().held
    assert first == pytest.approx((0.8, 0.02))  # it ends with the first decision of the second
    assert second == pytest.approx((0.5, 0.004))
    for row in run.truth:
        if "od" in row and row["wall"] >= 1150:
            row["od"] = 0.5 + (0.008 if row["wall"] % 2 else -0.008)
    assert run.judged().held[-1][1] == pytest.approx(0.008)  # to both sides


def test_every_dose_of_a_sound_run_is_matched_and_only_its_first_window_is_not_held(run: Run) -> None:
    assert run.account() == pytest.approx(
        {"asked": 20, "runs": 20, "without_intent": 0, "twice": 0, "missing": 0, "cut": 0, "error_mean_ml": 0.003}
        | {"error_max_ml": 0.003, "outside_ml": 0.003, "given_ml": 24.06, "booked_ml": 24.0}
        | {"total_pct": 0.06 / 24.06 * 100.0, "ids_repeated": 0}
    )
    (line,) = run.trouble()
    assert "0.0200" in line


def others(run: Run) -> None:
    """A decision without a dose, and rows of other pumps and units."""
    run.say("intent", 1299.0, feed_ml=0.0, id="turbidostat/run/pio01/20")
    run.pump(1299.0, 2.4, "waste")
    run.truth.append({**run.truth[-1], "pump": "media", "unit": "pio02"})
    run.truth.append({"wall": 1299.5, "error": "KeyError: 'unit'"})


def never_given(run: Run) -> None:
    run.truth.remove(run.run_at(1015.2))


def known_as_not_given(run: Run) -> None:
    never_given(run)
    run.of("dose_end", 1).update(feed_ml=0.0, feed_low_ml=0.0)


def uncertain(ml: float, end: str = "") -> Callable[[Run], None]:
    """The second dose by the journal: 0.2 to 1.2 mL; what it really was."""

    def act(run: Run) -> None:
        run.of("dose_end", 1).update(feed_low_ml=0.2, end=end)
        run.run_at(1015.2)["ml"] = ml

    return act


def each_a_little_off(run: Run) -> None:
    for row in run.journal:
        if row["kind"] in ("intent", "dose_end"):
            row |= {"feed_ml": 0.6, "feed_low_ml": 0.6}
    for row in run.truth:
        row |= {"ml": 0.645} if "pump" in row else {}  # 7 % of it, each within 0.05 mL


def same_id_twice(run: Run) -> None:
    for kind in ("intent", "dose_end"):
        run.of(kind, 5)["id"] = run.of(kind, 4)["id"]


def open_dose(run: Run) -> None:
    run.say("intent", 1299.0, feed_ml=1.0, id="turbidostat/run/pio01/21")


def open_dose_that_ran(run: Run) -> None:
    open_dose(run)
    run.pump(1299.5, 1.0)


def after_the_hand_over(run: Run) -> None:
    run.say("regulate", 1298.0, setpoint=0.5)
    run.pump(1299.0, 1.0)


CUT = "0.70 of 1.20 mL reported: ended early"
VOLUMES = ("error_mean_ml", "given_ml", "booked_ml", "total_pct")  # which most of these change a little
TAMPERED: dict[str, tuple[Callable[[Run], None], dict[str, Any], int]] = {
    # what is done to a sound run: what differs in its account, and how many lines of trouble that gives
    "others": (others, {}, 0),
    "twice": (lambda run: run.pump(1001.5, 1.2), {"runs": 21, "twice": 1}, 1),
    "before all": (lambda run: run.pump(990.0, 0.2), {"runs": 21, "without_intent": 1}, 1),
    "between two": (lambda run: run.pump(1010.0, 0.2), {"runs": 21, "without_intent": 1}, 1),
    "after the last": (lambda run: run.pump(1299.0, 0.2), {"runs": 21, "without_intent": 1}, 1),
    "never given": (never_given, {"runs": 19, "missing": 1}, 2),
    "known as not given": (known_as_not_given, {"runs": 19, "booked_ml": 19 * 1.2}, 0),
    "too large": (lambda run: run.run_at(1015.2).update(ml=1.27), {"error_max_ml": 0.07, "outside_ml": 0.07}, 2),
    "inside of its bound": (uncertain(0.7), {"error_max_ml": 0.5}, 1),
    "cut short": (uncertain(0.7, CUT), {"cut": 1, "error_mean_ml": 0.003}, 0),
    "below its bound": (uncertain(0.1, CUT), {"cut": 1, "outside_ml": 0.1}, 1),
    "cut, and too large": (uncertain(1.5, CUT), {"error_max_ml": 0.3, "outside_ml": 0.3}, 2),
    "each a little off": (
        each_a_little_off, {"error_max_ml": 0.045, "outside_ml": 0.045, "given_ml": 12.9, "booked_ml": 12.0}, 1,
    ),
    "booked beside doses": (
        lambda run: run.say("dose_end", 1299.0, feed_ml=6.0, feed_times=1, source="somebody"), {"booked_ml": 30.0}, 1,
    ),
    "open": (open_dose, {"asked": 21, "booked_ml": 25.0}, 0),
    "open, and ran": (open_dose_that_ran, {"asked": 21, "runs": 21, "cut": 1}, 0),
    "one id twice": (same_id_twice, {"ids_repeated": 1}, 1),
    "after the hand-over": (after_the_hand_over, {}, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", TAMPERED)
def test_what_is_planted_is_in_the_account_alone_and_told_where_it_is_wrong(run: Run, name: str) -> None:
    plant, differs, lines = TAMPERED[name]
    sound = run.account()
    plant(run)
    found = run.account()
    assert {key: found[key] for key in differs} == pytest.approx(differs)
    rest = found.keys() - differs.keys() - {*VOLUMES}
    assert {key: found[key] for key in rest} == pytest.approx({key: sound[key] for key in rest})
    assert len(run.trouble()) == 1 + lines, run.trouble()


def test_an_offset_of_the_true_od_and_a_window_that_no_truth_covers_are_not_held(run: Run) -> None:
    for row in run.truth:
        if "od" in row:
            row["od"] += 0.0061
    assert run.judged().held[1][1] == pytest.approx(0.0101)
    assert len(run.trouble()) == 2
    run.truth = [row for row in run.truth if not ("od" in row and row["wall"] >= 1110)]
    assert math.isnan(run.judged().held[1][1])
    assert len(run.trouble()) == 2


def test_a_vial_that_fills_and_a_pump_that_is_on(run: Run) -> None:
    run.truth.append({**run.vial(1301), "peak_ml": 22.1, "duty": {"13": 100.0}})
    assert (run.judged().peak_ml, run.judged().pumps_off) == (22.1, False)
    assert len(run.trouble()) == 3


def test_a_unit_of_which_nothing_is_on_record_keeps_nothing(run: Run) -> None:
    found = rig_truth.found_in(run.journal, run.truth, "pio02", SPEED)
    assert found.held == ()
    assert math.isnan(found.peak_ml)
    assert len(rig_truth.trouble(found, LIMITS, 20.0)) == 4  # no window, no dose, no volume, no pump known to be off
