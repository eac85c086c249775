"""What the journal's rows say of a dose and of a reactor, row by row."""

from dataclasses import asdict, replace
from typing import Any

import pytest

from hardware.chibio.resume import SPANS, ReactorHistory, replay
from hardware.errors import RecordingError
from hardware.pioreactor.doses import replay as units
from hardware.storage.doses import Ending, Given, dosed


def row(n: int, kind: str, reactor: str = "M0", **fields: Any) -> dict[str, Any]:
    return {"n": n, "kind": kind, "reactor": reactor, "time_s": 10.0 * n, **fields}


INTENT = {
    "sample": [60.0, 2], "feed_ml": 0.5, "waste_ml": 6.0, "carry_ml": 0.1, "doses": 1, "feed_duty": 0.01,
    "waste_duty": 0.1,
}  # fmt: skip


def test_nothing_is_known_of_a_reactor_without_rows_and_a_dose_may_have_given_nothing() -> None:
    known = {key: value for key, value in asdict(ReactorHistory()).items() if value == value}  # but for nan
    spans = {known.pop(key) for key in sorted(SPANS)}
    assert all(start != start and end != end for start, end in spans)
    assert {key: value for key, value in known.items() if value} == {"feed_pump": "Pump1"}
    assert {value for value in asdict(Ending(10.0)).values() if value == value} == {10.0, 0}
    assert Ending(100.0, 0.5, 6.0, 2, 0).repeats() == [(163.0, 0.5, 0.0), (226.0, 0.5, 0.0)]


def test_what_was_given_beside_says_by_which_pump_and_how_little():
    old = row(3, "given", at_s=398.0, feed_ml=0.6, waste_ml=0.6, why="without a dose")
    new = Given(398.0, 0.6, 0.1, 0.6, pump=3).row("without a dose")
    given = {"at_s": 398.0, "feed_ml": 0.6, "feed_low_ml": 0.1, "waste_ml": 0.6}
    assert new == given | {"pump": 3, "why": "without a dose"}
    (before,), (now,) = dosed([old]), dosed([row(3, "given", **new)])
    assert before == replace(now, pump=1)
    assert now.pump == 3


def test_a_resumed_run_counts_its_doses_on_and_knows_what_it_put_off() -> None:
    rows = [
        row(1, "intent", **INTENT, on_s=75.0),
        row(2, "intent", **INTENT | {"doses": 7, "carry_ml": 0.25, "sample": [120.0, 3]}, on_s=135.0),
        row(3, "temperature", temperature=33.5),
        row(4, "sample", doses=99, carry_ml=9.0),
        row(5, "intent", "M1", **INTENT | {"doses": 2}, on_s=140.0),
    ]
    for family in (replay(rows), units([entry | {"id": "run/1"} for entry in rows])):
        assert (family["M0"].doses, family["M0"].carry_ml, family["M0"].temperature) == (7, 0.25, 33.5)
        assert (family["M1"].doses, family["M1"].carry_ml) == (2, 0.1)


def test_a_resumed_run_knows_the_sample_and_the_start_of_its_newest_dose() -> None:
    known = replay([row(k, "intent", **INTENT | {"sample": [60.0 * k, k]}, on_s=75.0 * k) for k in (1, 2)])["M0"]
    assert (known.sample, known.on_s, known.open) == ((120.0, 2), 150.0, True)


def test_a_resumed_run_knows_when_a_unit_was_started_and_which_task_a_dose_was() -> None:
    rows = [
        row(1, "device", "pio01", boot="08:00", device_id="pio01"),
        row(2, "intent", "pio01", **INTENT, on_s=75.0, id="run/1"),
        row(3, "task", "pio01", id="run/1", job="add_media", task="a1"),
    ]
    known = units(rows)["pio01"]
    assert (known.boot, known.id, known.task, known.wasted) == ("08:00", "run/1", "a1", False)
    later = units([*rows, row(4, "device", "pio01", boot="09:30"), row(5, "temperature", "pio01", temperature=30.0)])
    assert later["pio01"].boot == "09:30"
    wasted = units([*rows, row(4, "task", "pio01", id="run/1", job="remove_waste", task="w1")])["pio01"]
    assert (wasted.task, wasted.wasted) == ("w1", True)
    assert units([*rows, row(4, "task", "pio01", id="run/0", job="remove_waste", task="w0")])["pio01"].task == "a1"


def test_what_later_rows_say_of_a_dose() -> None:
    rows = [row(1, "intent", **INTENT, on_s=75.0), row(2, "feed_on", on_s=76.0)]
    off = row(3, "command", path="/SetOutputOn/Pump1/0/M0", answer=204)
    waste_off = {**off, "path": "/SetOutputOn/Pump2/0/M0", "took_s": 0.5}
    never = None
    for later, expected in (
        ([off], (True, (30.0, 30.0), never)),
        ([off, {**off, "time_s": 50.0}], (True, (30.0, 30.0), never)),  # the first of them ended it
        ([{**off, "answer": "no answer"}], (True, never, never)),
        ([waste_off], (True, never, (29.5, 30.0))),
        ([off, row(4, "found", feed_off=None, waste_off=[31.0, 32.0])], (True, never, (31.0, 32.0))),
        ([row(3, "dose_end")], (False, never, never)),
        ([off, row(4, "intent", **INTENT, on_s=135.0)], (True, never, never)),
        ([row(3, "intent", **{**INTENT, "feed_ml": 0.0}, on_s=135.0)], (False, never, never)),
        ([row(3, "regulate", setpoint=0.5)], (False, never, never)),
        ([row(3, "sample", blank=1.0)], (True, never, never)),
    ):
        found = replay([*rows, *later])["M0"]
        ends = [None if end[1] != end[1] else end for end in (found.feed_off, found.waste_off)]
        assert (found.open, *ends) == expected
        assert found.blank != 1.0
    begun = replay([*rows, row(3, "command", path="/SetOutputOn/Pump2/1/M0", answer="no answer")])["M0"]
    assert begun.wasted  # it may run
    assert begun.feed_s == pytest.approx(0.63)
    assert begun.waste_s == pytest.approx(6.3)
    assert replay([row(1, "overflow_pump")])["M0"].overflow_pump_on
    assert not ReactorHistory().overflow_pump_on
    assert replay([row(1, "regulate", setpoint=0.5)])["M0"].handed_over == 0.5
    taken_back = replay([row(1, "regulate", setpoint=0.5), row(2, "regulate", setpoint=None)])["M0"]
    assert taken_back.handed_over != taken_back.handed_over
    nameless = {"n": 9, "kind": "overflow_pump"}
    for damaged in (row(9, "intent"), row(9, "regulate"), row(9, "device", blank="much"), nameless):
        with pytest.raises(RecordingError, match=r"row 9 \(.*\) is damaged .*; the file was changed by hand"):
            replay([damaged])
    assert replay([{"n": 1, "kind": "note"}]) == {}
