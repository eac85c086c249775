"""What the journal's rows say of a dose and of a reactor, row by row."""

from dataclasses import asdict
from typing import Any

import pytest

from hardware.chibio.resume import ReactorHistory, replay
from hardware.errors import RecordingError
from hardware.storage.doses import Ending


def row(n: int, kind: str, reactor: str = "M0", **fields: Any) -> dict[str, Any]:
    return {"n": n, "kind": kind, "reactor": reactor, "time_s": 10.0 * n, **fields}


INTENT = {"sample": [60.0, 2], "feed_ml": 0.5, "waste_ml": 6.0, "carry_ml": 0.1, "doses": 1}


def test_nothing_is_known_of_a_reactor_without_rows_and_a_dose_may_have_given_nothing() -> None:
    known = {key: value for key, value in asdict(ReactorHistory()).items() if value == value}  # but for nan
    assert {key: value for key, value in known.items() if value} == {}
    assert set(asdict(Ending(10.0)).values()) == {10.0, 0}
    assert Ending(100.0, 0.5, 6.0, 2, 0).repeats() == [(163.0, 0.5, 0.0), (226.0, 0.5, 0.0)]


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
