"""How a dose ended that nobody saw ending: times and volumes by hand, and the ledger of a journal."""

import json
from dataclasses import replace
from typing import Any

import pytest

from hardware.chibio.ending import Ending, repeats_until
from hardware.chibio.protocol import parse_state
from hardware.chibio.resume import Dosed, ReactorHistory, conclude, dosed, replay
from hardware.errors import RecordingError
from tests.hardware.script import state

OPEN = ReactorHistory(
    open=True, feed_ml=0.5, waste_ml=6.0, on_s=100.0, fed=True, start_time="2026-01-01 00:00:00", seen_s=110.0
)


@pytest.mark.parametrize(("after_s", "times"), [(-5.0, 0), (62.9, 0), (63.0, 1), (125.9, 1), (126.0, 2)])
def test_a_dose_begins_again_every_63_s(after_s: float, times: int) -> None:
    assert repeats_until(100.0 + after_s, 100.0) == times


def test_each_repetition_has_its_time_and_its_volumes() -> None:
    ending = Ending(100.0, 0.5, 6.0, feed_times=1, waste_times=3)
    assert ending.repeats() == [(163.0, 0.5, 6.0), (226.0, 0.0, 6.0), (289.0, 0.0, 6.0)]
    assert Ending(100.0, 0.5, 6.0, 2, 0).repeats() == [(163.0, 0.5, 0.0), (226.0, 0.5, 0.0)]
    assert Ending(100.0, 0.5, 6.0).repeats() == []
    assert ending.row() == {
        "verified_off": True, "repeated_ml": 0.5, "on_s": 100.0, "feed_ml": 0.5, "waste_ml": 6.0, "feed_times": 1,
        "waste_times": 3,
    }  # fmt: skip
    assert Ending.of_row(json.loads(json.dumps(ending.row()))) == ending


@pytest.mark.parametrize(
    ("known", "on", "now_s", "feed_ml", "times", "words"),
    [
        ({}, (1, 1), 162.9, 0.5, (0, 0), "left open; repeated 0 times, 0.00 mL"),
        ({}, (1, 1), 163.0, 0.5, (1, 1), "left open; repeated 1 times, 0.50 mL"),
        ({}, (1, 0), 300.0, 0.5, (3, 0), "left open; repeated 3 times, 1.50 mL"),
        ({"fed": False}, (1, 1), 300.0, 0.5, (3, 3), "left open; repeated 3 times"),
        ({}, (0, 1), 300.0, 0.5, (0, 3), "no medium followed"),
        ({"fed": False}, (0, 1), 300.0, 0.0, (0, 3), "no medium was given"),
        ({"fed": False}, (0, 0), 300.0, 0.0, (0, 0), "no medium was given"),
        ({}, (0, 0), 300.0, 0.5, (2, 2), "after a silence of 120 s if it was the board agent; repeated 2 times"),
        ({}, (0, 0), 200.0, 0.5, (1, 1), "repeated 1 times"),  # the silence was not over yet
        ({"seen_s": 158.9}, (0, 0), 999.0, 0.5, (2, 2), "repeated 2 times"),  # 158.9 + 120 + 10 = 288.9
        ({"seen_s": 159.0}, (0, 0), 999.0, 0.5, (3, 3), "repeated 3 times"),
        ({"feed_off": True}, (0, 0), 300.0, 0.5, (0, 2), "no medium followed"),
        ({"start_time": "earlier"}, (1, 1), 300.0, 0.5, (0, 0), "restarted"),
        ({"start_time": "earlier", "fed": False}, (0, 0), 300.0, 0.0, (0, 0), "restarted"),
        ({"start_time": ""}, (1, 1), 300.0, 0.5, (3, 3), "repeated 3 times"),  # of an earlier version: not known
    ],
)
def test_what_became_of_a_dose_left_open(
    known: dict[str, Any], on: tuple[int, int], now_s: float, feed_ml: float, times: tuple[int, int], words: str
) -> None:
    found = parse_state(json.dumps(state(Pump1__ON=on[0], Pump2__ON=on[1])).encode())
    ending, told = conclude(replace(OPEN, **known), found, now_s, 120.0)
    assert ending == Ending(100.0, feed_ml, 6.0, *times)
    assert words in told
    assert "0.50 mL was left open" in told


def test_a_device_that_remembers_no_experiment_was_restarted() -> None:
    found = replace(parse_state(json.dumps(state(Pump1__ON=1)).encode()), cycles=0, start_time="Waiting")
    assert conclude(replace(OPEN, start_time="Waiting"), found, 300.0, 120.0)[0].feed_times == 0


def row(n: int, kind: str, reactor: str = "M0", **fields: Any) -> dict[str, Any]:
    return {"n": n, "kind": kind, "reactor": reactor, "time_s": 10.0 * n, **fields}


INTENT = {"sample": [60.0, 2], "feed_ml": 0.5, "waste_ml": 6.0, "carry_ml": 0.1, "doses": 1}


def test_the_ledger_of_a_journal_counts_what_was_given() -> None:
    rows = [
        row(0, "device", device_id="7"),
        row(1, "intent", **INTENT, on_s=75.0),
        row(2, "feed_on", on_s=76.0),
        row(3, "intent", "M1", **INTENT, on_s=20.0),  # its feed pump was never switched on
        row(4, "dose_end", **Ending(76.0, 0.4, 5.0, 2, 1).row()),
        row(5, "dose_end", "M1", **Ending(20.0).row()),
        row(6, "intent", **{**INTENT, "feed_ml": 0.7}, on_s=300.0),
        row(7, "feed_on", on_s=301.0),  # open: counted whole
        row(8, "intent", "M1", **INTENT, on_s=310.0),
    ]
    assert dosed(rows) == [
        Dosed(3, "M1", 20.0, 0.0, 0.0),
        Dosed(1, "M0", 76.0, 0.4, 5.0),
        Dosed(4, "M0", 139.0, 0.4, 5.0, again=True),
        Dosed(4, "M0", 202.0, 0.4, 0.0, again=True),
        Dosed(6, "M0", 300.0, 0.7, 6.0),
    ]
    m0, m1 = (replay(rows)[name] for name in ("M0", "M1"))
    assert (m0.open, m0.fed, m0.feed_off, m0.feed_ml, m0.on_s, m0.carry_ml) == (True, True, False, 0.7, 301.0, 0.1)
    assert (m1.open, m1.fed, m1.seen_s) == (True, False, 80.0)
    for damaged in ({"feed_ml": "much"}, {"on_s": None}):
        with pytest.raises(RecordingError, match=r"row 1 \(intent\) is damaged"):
            dosed([rows[0], {**rows[1], **damaged}])


def test_what_later_rows_say_of_a_dose() -> None:
    rows = [row(1, "intent", **INTENT, on_s=75.0), row(2, "feed_on", on_s=76.0)]
    off = row(3, "command", path="/SetOutputOn/Pump1/0/M0", answer=204)
    for later, expected in (
        ([off], (True, True)),
        ([{**off, "answer": "no answer"}], (True, False)),
        ([{**off, "path": "/SetOutputOn/Pump2/0/M0"}], (True, False)),
        ([row(3, "dose_end")], (False, False)),
        ([off, row(4, "intent", **INTENT, on_s=135.0)], (True, False)),
        ([row(3, "intent", **{**INTENT, "feed_ml": 0.0}, on_s=135.0)], (False, False)),
        ([row(3, "regulate", setpoint=0.5)], (False, False)),
    ):
        found = replay([*rows, *later])["M0"]
        assert (found.open, found.feed_off) == expected
    assert replay([row(1, "guard")])["M0"].overflow_pump_on
    assert not ReactorHistory().overflow_pump_on
    assert replay([row(1, "regulate", setpoint=0.5)])["M0"].handed_over == 0.5
    taken_back = replay([row(1, "regulate", setpoint=0.5), row(2, "regulate", setpoint=None)])["M0"]
    assert taken_back.handed_over != taken_back.handed_over
    for damaged in (row(9, "intent"), row(9, "regulate"), row(9, "device", blank="much"), {"n": 9, "kind": "guard"}):
        with pytest.raises(RecordingError, match=r"row 9 \(.*\) is damaged .*; the file was changed by hand"):
            replay([damaged])
    assert replay([{"n": 1, "kind": "note"}]) == {}
