"""The judge of faults at the Pioreactor rig: a sound trial by hand passes, and every planted fault of it does not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hardware.rig.vials import Pulse
from tests.campaigns.faults import Case, FaultsConfig, all_cases
from tests.campaigns.outcome import judged, table
from tests.campaigns.pioreactor_case import found_in
from tests.campaigns.pioreactor_faults import FAULTS, rig
from tests.campaigns.pioreactor_trial import FAULTED, WELL, Seen
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
    assert (cells["told after, s"], cells["doses"], cells["times"]) == ("6.0", "10", "1")
    assert (cells["fed on record, mL"], cells["true, mL"]) == ("5.00 to 5.00", "5.00")
