"""The judge of faults at the Pioreactor rig: a sound trial by hand passes, and every planted fault of it does not."""

from dataclasses import replace
from typing import Any

import pytest

from hardware.rig.vials import Pulse
from tests.campaigns.fault import REAL, Fault
from tests.campaigns.fault_table import by_name
from tests.campaigns.faults import FaultsConfig, all_cases
from tests.campaigns.outcome import Outcome, judged, table
from tests.campaigns.pioreactor_case import found_in
from tests.campaigns.pioreactor_faults import FAULTS, rig
from tests.campaigns.pioreactor_trial import FAULTED, WELL, Seen

STRUCK = 30.0
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


def outcome(seen: Seen, fault: Fault = FAULT) -> Outcome:
    return judged(found_in(seen, fault, "between", [STRUCK]), fault)


def wrong(seen: Seen, fault: Fault = FAULT) -> list[str]:
    return outcome(seen, fault).wrong


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
    found = outcome(sound())
    assert found.ok, found.wrong
    assert (found.doses, found.doses_doubled, found.rows, found.rows_lost) == (10, 0, 10, 0)
    assert found.detected_s == pytest.approx(6.0)  # from second 30 to the sample at 36
    assert (found.low_ml, found.high_ml, found.fed_ml) == pytest.approx((5.0, 5.0, 5.0))


def test_a_run_of_the_pump_without_a_request_is_seen() -> None:
    seen = sound()
    twice = replace(seen, pulses=(*seen.pulses, Pulse(FAULTED, "media", 26.0, 0.5, 0.5)))
    assert wrong(twice) == ["doses doubled"]
    assert not wrong(twice, replace(FAULT, foreign=1))
    cycled = replace(seen, pulses=(*seen.pulses, Pulse(FAULTED, "media", 26.0, 0.1, 0.1)))
    assert not wrong(cycled)


def test_a_request_while_another_is_open_is_seen() -> None:
    assert "dosed in doubt" in wrong(changed(sound(), "dose_end", 4, id="other"))
    assert "dose without an end" in wrong(changed(sound(), "dose_end", 9, id="other"))
    assert "an id twice" in wrong(changed(changed(sound(), "feed_on", 5, id="r/4"), "dose_end", 5, id="r/4"))


def test_the_truth_outside_the_record_is_seen() -> None:
    assert "volume not as booked" in wrong(vial(sound(), FAULTED, 100, fed_ml=6.0))
    assert "volume not as booked" in wrong(vial(sound(), FAULTED, 100, fed_ml=3.5))
    bounded = changed(sound(), "dose_end", 3, feed_ml=1.5)  # what is not known is counted whole
    assert not wrong(vial(bounded, FAULTED, 100, fed_ml=6.0))
    assert not wrong(vial(sound(), FAULTED, 100, fed_ml=6.0), replace(FAULT, flow=True))


def test_what_somebody_else_dosed_is_booked_in_a_row_of_its_own() -> None:
    more = vial(sound(), FAULTED, 100, fed_ml=5.5)
    given = {"kind": "given", "reactor": FAULTED, "wall": 40.0, "feed_ml": 0.5, "feed_low_ml": 0.5}
    assert wrong(more) == ["volume not as booked"]
    assert not wrong(replace(more, journal=[*more.journal, given]))


def test_a_lost_row_and_a_row_too_many_are_seen() -> None:
    seen = sound()
    without = replace(seen, rows={**seen.rows, FAULTED: seen.rows[FAULTED][:4] + seen.rows[FAULTED][5:]})
    assert wrong(without) == ["rows lost"]
    more = replace(seen, rows={**seen.rows, WELL: [*seen.rows[WELL], (9.5, 0.5)]})
    assert wrong(more) == ["rows doubled"]


def test_silence_is_seen() -> None:
    assert "not detected" in wrong(changed(sound(), "note", 0, note="something else"))
    assert "detected late" in wrong(sound(), replace(FAULT, within_s=-7.0))
    silent = replace(sound(), rows={unit: [(0.0, 0.5), (60.0, 0.5)] for unit in (FAULTED, WELL)})
    assert "no rows" in wrong(silent, replace(FAULT, minutes=1.0 / 60.0))


def test_cultures_and_pumps_are_judged_by_the_vials() -> None:
    assert "not held" in wrong(vial(sound(), FAULTED, 100, od=0.6))
    assert "neighbour strayed" in wrong(vial(vial(sound(), WELL, 50, od=0.6), WELL, 60, od=0.5))
    assert "pumps not off" in wrong(vial(sound(), WELL, 119, duty={"12": 100.0, "13": 0.0}))
    assert "overflow" in wrong(vial(sound(), FAULTED, 50, peak_ml=25.0))
    assert "client failed" in wrong(replace(sound(), status=1))
    assert "nothing is on record" in wrong(replace(sound(), journal=()))


def test_what_must_not_start_is_refused_with_one_line() -> None:
    fault = replace(FAULT, refused=True)
    refused = replace(sound(), status=1, told="INFO pass\nerror: a word; remedy\n", journal=())
    assert not wrong(refused, fault)
    assert "not detected" in wrong(replace(refused, told="error: something\n"), fault)
    assert "not refused" in wrong(replace(refused, status=0), fault)
    assert "not refused" in wrong(replace(refused, told="Traceback\nerror: a word\n"), fault)
    assert "dosed though refused" in wrong(replace(refused, journal=sound().journal), fault)


def test_every_fault_says_what_is_expected_and_when_it_comes() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(names) == len(set(names)) >= 26
    assert all(set(fault.moments) <= set(REAL) for fault in FAULTS)
    with pytest.raises(ValueError, match="faults = nothing: no such fault; allowed feed blocked.*client_killed"):
        by_name(["nothing"])
    with pytest.raises(ValueError, match="either"):
        replace(FAULT, why_not="and a reason")


def test_faults_of_both_families_are_cases_of_one_command() -> None:
    config = FaultsConfig(faults=("feed blocked", "queue_killed"), moments=("dose", "in"), controls=0)
    cases = [(case.fault, case.moment, case.guarded) for case in all_cases(config)]
    assert cases == [("feed blocked", "dose", True), ("queue_killed", "in", False)]
    every = all_cases(FaultsConfig(families=("pioreactor",)))
    assert {case.fault for case in every} == {fault.name for fault in FAULTS}
    assert len(every) == sum(len(fault.moments) for fault in FAULTS)  # no healthy runs
    assert sum(fault.often for fault in FAULTS) == 6


def test_the_table_of_the_rig_says_what_was_fed() -> None:
    head, _, row = table([outcome(sound())]).splitlines()
    cells = dict(zip(head.split(" | "), row.split(" | "), strict=True))
    assert (cells["told after, s"], cells["doses"], cells["times"]) == ("6.0", "10", "1")
    assert (cells["fed on record, mL"], cells["true, mL"]) == ("5.00 to 5.00", "5.00")
