"""What became of a dose whose end nobody watched, case by case."""

import json
from dataclasses import replace

import pytest

from hardware.chibio.protocol import PERIOD_S, DeviceState, parse_state
from hardware.chibio.resume import ReactorHistory, conclude, repeats_until, replay
from hardware.errors import RecordingError
from hardware.storage.doses import REPEAT_S, Ending, dosed
from tests.hardware.script import state

OPEN = ReactorHistory(
    open=True, feed_ml=1.2, waste_ml=9.0, on_s=100.0, fed=True, seen_s=101.0, start_time="2026-01-01 00:00:00"
)


def found(feed: bool, waste: bool, start_time: str = OPEN.start_time) -> DeviceState:
    read = parse_state(json.dumps(state()).encode())
    return replace(read, pumps_on=(feed, waste, False, False), start_time=start_time, cycles=5)


@pytest.mark.parametrize(
    ("off_s", "times"), [(100.0, 0), (162.9, 0), (163.0, 1), (225.9, 1), (226.0, 2), (50.0, 0)]
)  # fmt: skip
def test_a_pump_left_on_begins_again_every_63_s(off_s: float, times: int) -> None:
    assert repeats_until(off_s, 100.0) == times
    assert REPEAT_S == PERIOD_S  # as the journal counts


@pytest.mark.parametrize(
    ("history", "read", "now_s", "feed_ml", "feed_times", "waste_times", "words"),
    [
        (OPEN, found(True, True), 1000.0, 1.2, 14, 14, "repeated 14 times, 16.80 mL"),
        (OPEN, found(True, False), 1000.0, 1.2, 14, 0, "repeated 14 times"),
        (replace(OPEN, feed_off=True), found(True, True), 1000.0, 1.2, 14, 14, "repeated 14"),  # answered, not done
        (replace(OPEN, feed_off=True), found(False, True), 1000.0, 1.2, 0, 14, "after its feed pump had been"),
        (OPEN, found(False, True), 1000.0, 1.2, 0, 14, "after its feed pump had been"),  # killed in its off command
        (replace(OPEN, fed=False), found(False, True), 1000.0, 0.0, 0, 14, "before its feed pump was switched on"),
        (replace(OPEN, fed=False), found(False, False), 1000.0, 0.0, 0, 0, "before its feed pump was switched on"),
        (OPEN, found(False, False), 1000.0, 1.2, 2, 2, "something else switched its pumps off"),  # until 231 s
        (OPEN, found(False, False), 170.0, 1.2, 1, 1, "something else switched its pumps off"),
        (replace(OPEN, seen_s=95.9), found(False, False), 1000.0, 1.2, 1, 1, "something else"),  # until 225.9 s
        (replace(OPEN, seen_s=96.0), found(False, False), 1000.0, 1.2, 2, 2, "something else"),  # until 226 s
        (replace(OPEN, feed_off=True), found(False, False), 1000.0, 1.2, 0, 2, "after its feed pump had been"),
        (OPEN, found(True, True, "another"), 1000.0, 1.2, 0, 0, "restarted since"),
        (OPEN, replace(found(False, False, " Waiting "), cycles=0), 1000.0, 1.2, 0, 0, "restarted since"),
        (replace(OPEN, start_time=""), found(True, True, "another"), 1000.0, 1.2, 14, 14, "repeated 14 times"),
    ],
)  # fmt: skip
def test_what_is_booked_and_said(
    history: ReactorHistory, read: DeviceState, now_s: float, feed_ml: float, feed_times: int, waste_times: int,
    words: str,
) -> None:  # fmt: skip
    ending, note = conclude(history, read, now_s, 120.0)
    assert (ending.on_s, ending.feed_ml, ending.waste_ml) == (100.0, feed_ml, 9.0)
    assert (ending.feed_times, ending.waste_times) == (feed_times, waste_times)
    assert note.startswith("a dose of 1.20 mL was left open")
    assert words in note


def test_repetitions_are_told_one_by_one_and_survive_the_journal() -> None:
    ending = Ending(10.0, 1.2, 9.0, 1, 2)
    assert ending.repeats() == [(73.0, 1.2, 9.0), (136.0, 0.0, 9.0)]
    assert Ending.of_row(json.loads(json.dumps(ending.row()))) == ending
    assert ending.row()["repeated_ml"] == 1.2


def test_every_dose_of_a_journal_in_the_order_of_time() -> None:
    def intent(n: int, name: str, on_s: float) -> dict[str, object]:
        return {
            "n": n,
            "kind": "intent",
            "reactor": name,
            "on_s": on_s,
            "feed_ml": 1.2,
            "waste_ml": 9.0,
            "sample": [0, 1],
        }

    rows = [
        intent(0, "M0", 10.0), {"n": 1, "kind": "feed_on", "reactor": "M0", "on_s": 11.0},
        intent(2, "M1", 12.0),  # its feed pump was never switched on
        {"n": 3, "kind": "dose_end", "reactor": "M0", **Ending(11.0, 0.7, 9.0).row()},
        intent(4, "M0", 70.0), {"n": 5, "kind": "feed_on", "reactor": "M0", "on_s": 71.0},
        intent(6, "M1", 72.0), {"n": 7, "kind": "feed_on", "reactor": "M1", "on_s": 73.0},
        {"n": 8, "kind": "dose_end", "reactor": "M0", **Ending(71.0, 1.2, 9.0, 2, 2).row()},
    ]  # fmt: skip
    assert [(d.n, d.reactor, d.at_s, d.feed_ml, d.again) for d in dosed(rows)] == [
        (0, "M0", 11.0, 0.7, False), (4, "M0", 71.0, 1.2, False), (6, "M1", 72.0, 1.2, False),
        (8, "M0", 134.0, 1.2, True), (8, "M0", 197.0, 1.2, True),
    ]  # fmt: skip
    assert replay(rows)["M1"].fed
    assert not replay(rows[:3])["M1"].fed
    with pytest.raises(RecordingError, match=r"row 4 \(intent\) is damaged"):
        dosed([*rows[:4], {"n": 4, "kind": "intent", "reactor": "M0"}])
